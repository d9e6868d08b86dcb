"""Character sets of fields."""

from __future__ import annotations


def made_of(characters: bytes) -> bytes:
    """Return a table for `bytes.translate` that changes all bytes except these: a valid field stays unchanged.

    This takes a third of the time of deleting them and checking for a rest.
    """
    return bytes(byte if byte in characters else byte ^ 0xFF for byte in range(256))


__all__ = [
    "made_of",
]
