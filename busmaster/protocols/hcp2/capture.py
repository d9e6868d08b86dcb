"""Reads captures of HCP2."""

from __future__ import annotations

from busmaster.capture.telegrams import BEL, HEXADECIMAL, characters, checked, number
from busmaster.protocols._comms.capture import CommsDialect
from busmaster.protocols.hcp2.codec import Read, Write
from busmaster.wire.checks import xor


class Hcp2Dialect(CommsDialect):
    """AN00129: BEL h h STX e e ... The checksum of each request covers the bytes after BEL."""

    reset = BEL
    checked_read = 1
    reads, writes = Read, Write

    def node(self, field: bytes) -> int | None:
        return number(field, 16, HEXADECIMAL)

    def element(self, field: bytes) -> str:
        element = number(field, 16, HEXADECIMAL)
        return repr(characters(field)) if element is None else str(element)

    def request_fault(self, raw: bytes) -> str:
        return checked(raw, 1, xor)
