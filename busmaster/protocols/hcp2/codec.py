"""HCP2 (AN00129): nodes 0-255, elements 1-255, both as two upper-case hexadecimal characters.

    write   BEL h h STX e e data ETX check      answered by ACK or NAK
    read    BEL h h STX e e ENQ check           answered by STX e e data ETX check, or NAK

The checksum of a request is the exclusive-or of everything after BEL, that of a reply of everything after STX.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from busmaster.contract.profile import Profile
from busmaster.protocols._comms.codec import CHECKED, LINE, OTHER_LINES, TIMINGS, ReadElement, WriteElements
from busmaster.wire.checks import xor
from busmaster.wire.readers import BEL, ENQ, ETX, STX

LAST_ELEMENT = 255
REFUSED_REFERENCE = (
    "a MicroFlex accepts this element only in {} control mode with {} set to host; on other controllers it is read-only"
)
"""AN00129, notes to the elements of a MicroFlex."""


@dataclass(frozen=True, slots=True)
class Read(ReadElement):
    """Read element 1-255: a float."""

    last: ClassVar[int] = LAST_ELEMENT

    @staticmethod
    @lru_cache(maxsize=4096)
    def encode(address: int, element: int) -> tuple[bytes, bytes]:
        header = STX + b"%02X" % element
        # A checksum of the bytes after STX would fit AN00129's example too: for node 2, node and STX cancel out.
        body = b"%02X%b" % (address, header) + ENQ
        return BEL + body + bytes((xor(body),)), header


@dataclass(frozen=True, slots=True)
class Write(WriteElements):
    """Write elements 1-255. The node decides which ones are writable: controllers differ."""

    last: ClassVar[int] = LAST_ELEMENT
    hints: ClassVar[Mapping[int, str]] = {
        116: REFUSED_REFERENCE.format("current", "TORQUERESOURCE"),
        118: REFUSED_REFERENCE.format("speed", "SPEEDRESOURCE"),
    }

    @staticmethod
    def encode(address: int, element: int, text: bytes) -> bytes:
        body = b"%02X\x02%02X%b" % (address, element, text) + ETX
        return BEL + body + bytes((xor(body),))


PROFILE = Profile(
    name="hcp2",
    title="Host Comms Protocol 2",
    addresses=range(256),
    line=LINE,
    timings=TIMINGS,
    probe=Read(1),
    sync_reads=tuple(Read(element) for element in CHECKED),
    other_lines=OTHER_LINES,
    shares_line_with=frozenset({"hcp"}),  # nodes of one ignore the telegrams of the other
)
