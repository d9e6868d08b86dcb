"""Checksums. Which bytes they cover is the protocol's business."""

from __future__ import annotations

FIRST_PRINTABLE = 0x20


def xor(data: bytes) -> int:
    """Return the check of HCP and HCP2: exclusive-or of all bytes.

    Half of all frames get a control character, so never search for it.
    """
    check = 0
    for byte in data:
        check ^= byte
    return check


def bcc(data: bytes) -> int:
    """Return the check of Mentor II: exclusive-or of all bytes, plus 32 where that would be a control character."""
    check = xor(data)
    return check if check >= FIRST_PRINTABLE else check + FIRST_PRINTABLE


def sum16(data: bytes) -> int:
    """Return the check of MSC: sum of all bytes, 16 bits. No legal packet overflows them."""
    return sum(data) & 0xFFFF


def sum8(data: bytes) -> int:
    """Return the check of DC104: sum of all bytes modulo 256."""
    return sum(data) & 0xFF


__all__ = [
    "FIRST_PRINTABLE",
    "bcc",
    "sum8",
    "sum16",
    "xor",
]
