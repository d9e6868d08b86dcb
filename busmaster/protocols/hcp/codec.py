"""HCP (AN00110): nodes 0-15 as one upper-case hexadecimal character sent twice, elements 1-99 as two decimal digits.

    write   EOT n n STX d d data ETX check      answered by ACK or NAK
    read    EOT n n STX d d ENQ                 answered by STX d d data ETX check, or NAK

Every checksum is the exclusive-or of everything after STX; a read request has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from busmaster.contract.profile import Profile
from busmaster.protocols._comms.codec import CHECKED, LINE, OTHER_LINES, TIMINGS, ReadElement, WriteElements
from busmaster.wire.checks import xor
from busmaster.wire.readers import ENQ, EOT, ETX, STX

LAST_ELEMENT = 99


@dataclass(frozen=True, slots=True)
class Read(ReadElement):
    """Read element 1-99: a float."""

    last: ClassVar[int] = LAST_ELEMENT

    @staticmethod
    @lru_cache(maxsize=4096)
    def encode(address: int, element: int) -> tuple[bytes, bytes]:
        header = STX + b"%02d" % element
        return _reset(address) + header + ENQ, header


@dataclass(frozen=True, slots=True)
class Write(WriteElements):
    """Write elements 1-99."""

    last: ClassVar[int] = LAST_ELEMENT

    @staticmethod
    def encode(address: int, element: int, text: bytes) -> bytes:
        body = b"%02d%b" % (element, text) + ETX
        return _reset(address) + STX + body + bytes((xor(body),))


def _reset(address: int) -> bytes:
    return EOT + b"%X" % address * 2  # sent twice, which protects a read: it has no checksum


PROFILE = Profile(
    name="hcp",
    title="Host Comms Protocol",
    addresses=range(16),
    line=LINE,
    timings=TIMINGS,
    probe=Read(1),
    sync_reads=tuple(Read(element) for element in CHECKED),
    other_lines=OTHER_LINES,
    checked_requests=False,
    shares_line_with=frozenset({"hcp2"}),  # nodes of one ignore the telegrams of the other
)
