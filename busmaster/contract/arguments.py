"""What callers hand in as numbers: taken for what it is, or refused in words before anything is sent.

True is no number here, although Python lets it pass for 1: it is what a mistyped call leaves behind.
"""

from __future__ import annotations

import operator
from math import inf, nan
from numbers import Real
from typing import SupportsIndex

from busmaster.errors import InvalidCommand


def whole_number(value: SupportsIndex, lowest: int, highest: int, what: str) -> int:
    """Return `value` as an int. Raises InvalidCommand, naming it `what`, unless it is a whole number in that range."""
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool):
        raise InvalidCommand(f"{what} must be a whole number, not {value!r}")
    if not lowest <= number <= highest:
        raise InvalidCommand(f"{what} must be {lowest} to {highest}, not {number}")
    return number


def seconds(value: object, what: str) -> float:
    """Return `value` as a float. Raises InvalidCommand, naming it `what`, unless it is a finite time of 0 s or more."""
    number = nan if isinstance(value, bool) or not isinstance(value, Real) else float(value)
    if not 0 <= number < inf:
        raise InvalidCommand(f"{what} is a time of 0 s or more, not {value!r}")
    return number
