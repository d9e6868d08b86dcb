"""A plain read, which is most of what is asked: said again and again in the same words, but for its number. They are
worked out once at either end.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

from busmaster.app.service.failures import REFUSED
from busmaster.app.service.messages import BEFORE_NUMBER, read, words
from busmaster.app.service.telling import protocol_of
from busmaster.ext import Command

KEPT = 1024
"""Reads whose words are kept, the last that were asked, whoever asked."""
SHORT = 256
"""Characters of a message whose words are kept: no read takes more."""

END = f"}}}}{BEFORE_NUMBER}"
"""With what the words of a plain read end, before its number: nothing is behind its command."""


class PlainRead(NamedTuple):
    """A read of which nothing is said but what it reads, and where. Its command is built, and so checked."""

    protocol: str
    address: int
    command: Command[Any]


@lru_cache(KEPT)
def words_of(protocol: str, address: int, command: Command[Any]) -> str:
    """Return how a plain read is said, up to its number.

    Raises InvalidCommand for a command that the protocol does not have.
    """
    said = protocol_of(protocol).write_down(command)
    return words("request", {"protocol": protocol, "address": address, "command": said})


def plain_read_of(message: str | bytes) -> tuple[int, PlainRead] | None:
    """Return the number of a message that is a plain read, and that; None for any other, and for a bad one."""
    if not isinstance(message, str) or len(message) > SHORT:
        return None
    said, _, rest = message.rpartition(END)
    digits = rest[:-1]
    if not digits.isdecimal():
        return None
    number = int(digits)
    asked = _asked_in(said) if rest == f"{number}}}" else None
    return None if asked is None else (number, asked)


@lru_cache(KEPT)
def _asked_in(said: str) -> PlainRead | None:
    """Return the plain read that is asked in these words, up to END, whatever its number; None if none is."""
    try:
        message = read(f"{said}}}}}}}")
        params = message["params"]
        if message.keys() != {"jsonrpc", "method", "params"} or message["method"] != "request":
            return None
        if params.keys() != {"protocol", "address", "command"}:
            return None
        command = protocol_of(params["protocol"]).read_back(params["command"])
    except REFUSED:  # what is wrong with it is said where every message is understood
        return None
    return None if command.writes else PlainRead(params["protocol"], params["address"], command)


__all__ = ["PlainRead", "plain_read_of", "words_of"]
