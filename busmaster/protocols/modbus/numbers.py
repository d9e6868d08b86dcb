"""Numbers in registers: integers and floats of 16, 32 and 64 bits, in either order of their words."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

from busmaster.contract.arguments import whole_number
from busmaster.errors import InvalidCommand

FORMS = {
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
"""The kinds of numbers, with their formats for `struct`."""


@dataclass(frozen=True, slots=True)
class Number:
    """The form of a number in registers: most significant word first, or last if `swapped`.

    Within a word the most significant byte is always first. Raises InvalidCommand for a kind that does not exist.
    """

    kind: str = "uint16"
    swapped: bool = False

    def __post_init__(self) -> None:
        if self.kind not in FORMS:
            raise InvalidCommand(f"there is no kind of number {self.kind!r}: use {', '.join(FORMS)}")

    @property
    def registers(self) -> int:
        """Number of registers of one number."""
        return struct.calcsize(f">{FORMS[self.kind]}") // 2

    def decode(self, words: Sequence[int]) -> int | float:
        """Return the number in these words. There must be `registers` of them."""
        if self.swapped:
            words = words[::-1]
        number: int | float = struct.unpack(f">{FORMS[self.kind]}", struct.pack(f">{len(words)}H", *words))[0]
        return number

    def encode(self, value: float) -> tuple[int, ...]:
        """Return the words for a value. Raises InvalidCommand for one that does not fit."""
        if self.kind.startswith("float"):
            data = self._float(value)
        else:
            signed, bits = not self.kind.startswith("u"), 16 * self.registers
            low = -(2 ** (bits - 1)) if signed else 0
            number = whole_number(value, low, low + 2**bits - 1, f"a value of {self.kind}")  # type: ignore[arg-type]  # or refused
            data = number.to_bytes(bits // 8, "big", signed=signed)
        words: tuple[int, ...] = struct.unpack(f">{self.registers}H", data)
        return words[::-1] if self.swapped else words

    def _float(self, value: float) -> bytes:
        try:
            if not isinstance(value, bool) and math.isfinite(value):
                return struct.pack(f">{FORMS[self.kind]}", value)
        except (TypeError, OverflowError):
            pass
        raise InvalidCommand(f"{value!r} cannot be sent as {self.kind}")
