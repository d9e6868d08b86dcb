"""Whole numbers as arguments: what the binary protocols (MSC, DC104) pack into bytes."""

from __future__ import annotations

import operator
from typing import SupportsIndex

from busmaster.errors import InvalidCommand


def whole_number(value: SupportsIndex, lowest: int, highest: int, what: str) -> int:
    """`value` as an int. Raises InvalidCommand, naming it `what`, unless it is a whole number in lowest..highest."""
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool):
        raise InvalidCommand(f"{what} must be a whole number, not {value!r}")
    if not lowest <= number <= highest:
        raise InvalidCommand(f"{what} must be {lowest} to {highest}, not {number}")
    return number
