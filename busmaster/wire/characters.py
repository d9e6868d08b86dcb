"""Which characters a field is made of."""

from __future__ import annotations


def made_of(characters: bytes) -> bytes:
    """Return a table for `bytes.translate` that changes every byte but these: a field of them alone stays as it is.

    This takes a third of the time of deleting them and looking for a rest.
    """
    return bytes(byte if byte in characters else byte ^ 0xFF for byte in range(256))


__all__ = [
    "made_of",
]
