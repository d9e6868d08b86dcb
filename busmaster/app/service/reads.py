"""Plain reads, which are the most frequent requests. Their text is the same each time except for the number, so it is
encoded once and decoded once.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

from busmaster.app.service.encoding import protocol_of
from busmaster.app.service.failures import REFUSED
from busmaster.app.service.messages import BEFORE_NUMBER, read, words
from busmaster.ext import Command

KEPT = 1024
"""Number of the latest reads, of all clients, whose texts are stored."""
SHORT = 256
"""Longest message whose text is stored, in characters: no read is longer."""

END = f"}}}}{BEFORE_NUMBER}"
"""End of a plain read's text, before its number. Nothing follows its command."""


class PlainRead(NamedTuple):
    """A read without any options. Its command is built, and so checked."""

    protocol: str
    address: int
    command: Command[Any]


@lru_cache(KEPT)
def words_of(protocol: str, address: int, command: Command[Any]) -> str:
    """Return the text of a plain read, up to its number.

    Raises InvalidCommand for a command that the protocol does not have.
    """
    form = protocol_of(protocol).write_down(command)
    return words("request", {"protocol": protocol, "address": address, "command": form})


def plain_read_of(message: str | bytes) -> tuple[int, PlainRead] | None:
    """Return the number of a message that is a plain read, and that; None for any other, and for a bad one."""
    if not isinstance(message, str) or len(message) > SHORT:
        return None
    head, _, rest = message.rpartition(END)
    digits = rest[:-1]
    if not digits.isdecimal():
        return None
    number = int(digits)
    asked = _asked_in(head) if rest == f"{number}}}" else None
    return None if asked is None else (number, asked)


@lru_cache(KEPT)
def _asked_in(text: str) -> PlainRead | None:
    """Return the plain read in this text, up to END, without its number; None if it is not a plain read."""
    try:
        message = read(f"{text}}}}}}}")
        params = message["params"]
        if message.keys() != {"jsonrpc", "method", "params"} or message["method"] != "request":
            return None
        if params.keys() != {"protocol", "address", "command"}:
            return None
        command = protocol_of(params["protocol"]).read_back(params["command"])
    except REFUSED:  # the error is reported where all other messages are decoded
        return None
    return None if command.writes else PlainRead(params["protocol"], params["address"], command)


__all__ = ["PlainRead", "plain_read_of", "words_of"]
