"""A plain read, which is most of what is asked: said again and again in the same words, but for its number. They are
worked out once at either end.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any, NamedTuple

from busmaster.contract.exchange import Command
from busmaster.service.failures import REFUSED
from busmaster.service.messages import read, words
from busmaster.service.telling import protocol_of

KEPT = 1024
"""Reads whose words are kept, the last that were asked, whoever asked."""
SHORT = 256
"""Characters of words that are kept: no read takes more."""
_PLAIN = re.compile(rf'(.{{,{SHORT}}}\}}\}}),"id":(0|[1-9][0-9]{{,15}})\}}')
"""A message that ends with its command, or its options, and its number."""


class PlainRead(NamedTuple):
    """A read of which nothing is said but what it reads, and where. Its command is built, and so checked."""

    protocol: str
    address: int
    command: Command[Any]


@lru_cache(KEPT)
def words_of(asked: PlainRead) -> str:
    """Return how it is said, up to its number. Raises InvalidCommand for a command that its protocol does not have."""
    command = protocol_of(asked.protocol).write_down(asked.command)
    return words("request", {"protocol": asked.protocol, "address": asked.address, "command": command})


def plain_read_of(message: str | bytes) -> tuple[int, PlainRead] | None:
    """Return the number of a message that is a plain read, and that; None for any other, and for a bad one."""
    if not isinstance(message, str) or (found := _PLAIN.fullmatch(message)) is None:
        return None
    said, number = found.groups()
    asked = _said_so(said)
    return None if asked is None else (int(number), asked)


@lru_cache(KEPT)
def _said_so(said: str) -> PlainRead | None:
    try:
        message = read(f"{said}}}")  # the number behind the words changes nothing of them
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
