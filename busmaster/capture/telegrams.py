"""Common parts of listeners to character protocols: telegrams of printable characters, ended by ETX and a checksum."""

from __future__ import annotations

from collections.abc import Callable

from busmaster.contract.frames import Direction, Frame, Kind
from busmaster.wire.characters import made_of

STX, ETX, EOT, ENQ, ACK, BEL, BS, NAK = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x15
SPACE = 0x20
_LONGEST_FIELD = 90
"""Far more than any telegram contains (60), so that one that is too long is still recognised as a whole."""
ANSWERS = {ACK: Kind.ACK, NAK: Kind.NAK, EOT: Kind.EOT}
DECIMAL = made_of(b"0123456789")
HEXADECIMAL = made_of(b"0123456789ABCDEF")


def field_end(data: bytes, start: int) -> int:
    """Return where the printable characters from `start` end: at a control character, or at the end of the data."""
    for position in range(start, len(data)):
        if data[position] < SPACE:
            return position
    return len(data)


def closed_size(data: bytes, start: int) -> int:
    """Return `Dialect.size` of a telegram with data from `start` that is ended by ETX and a checksum."""
    end = field_end(data, start)
    if end - start > _LONGEST_FIELD:
        return -start - _LONGEST_FIELD
    if end < len(data) and data[end] != ETX:
        return -end
    return end + 2 if end + 2 <= len(data) else 0


def checked(raw: bytes, start: int, check: Callable[[bytes], int]) -> str:
    """Return the fault of the checksum (the last byte) of the bytes from `start` on; "" if it is correct."""
    right = check(raw[start:-1])
    return "" if raw[-1] == right else f"bad checksum {raw[-1]:02X}, not {right:02X}"


def characters(field: bytes) -> str:
    """Return the characters of a field as text."""
    return field.decode("ascii", "backslashreplace")


def came_back(raw: bytes) -> Frame:
    """Return a whole request that the host received as noise: an undeclared or a different echo."""
    return Frame(Kind.NOISE, Direction.NODE, raw, fault="a request, received")


def number(field: bytes, base: int, digits: bytes) -> int | None:
    """Return the number of these characters, or None if one is not among `digits` (a table of `made_of`)."""
    return int(field, base) if field.translate(digits) == field else None


__all__ = [
    "ACK",
    "ANSWERS",
    "BEL",
    "BS",
    "DECIMAL",
    "ENQ",
    "EOT",
    "ETX",
    "HEXADECIMAL",
    "NAK",
    "SPACE",
    "STX",
    "came_back",
    "characters",
    "checked",
    "closed_size",
    "field_end",
    "number",
]
