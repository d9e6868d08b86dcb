"""Frames for unit 17 as the Modbus specification writes them. Their CRC is calculated apart from what is tested."""

from __future__ import annotations

from tests.testing.modbus import crc

UNIT = 0x11


def frame(text: str) -> bytes:
    """The bytes of a text in hexadecimal, and their CRC."""
    body = bytes.fromhex(text)
    return body + crc(body)
