"""Reads captures of HCP."""

from __future__ import annotations

from busmaster.capture.telegrams import DECIMAL, ENQ, EOT, HEXADECIMAL, characters, checked, number
from busmaster.protocols._comms.capture import CommsDialect
from busmaster.protocols.hcp.codec import Read, Write
from busmaster.wire.checks import xor


class HcpDialect(CommsDialect):
    """AN00110: EOT n n STX d d ... A read has no checksum; that of a write covers the bytes after STX."""

    reset = EOT
    checked_read = 0
    reads, writes = Read, Write

    def node(self, field: bytes) -> int | None:
        return number(field[:1], 16, HEXADECIMAL) if field[0] == field[1] else None

    def element(self, field: bytes) -> str:
        element = number(field, 10, DECIMAL)
        return repr(characters(field)) if element is None else str(element)

    def request_fault(self, raw: bytes) -> str:
        return "" if raw[6] == ENQ else checked(raw, 4, xor)
