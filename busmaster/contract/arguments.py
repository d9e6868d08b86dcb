"""What callers hand in: a number is taken for what it is, or refused in words before anything is sent; and of a name
that is none, the nearest is told.

True is no number here, although Python lets it pass for 1: it is what a mistyped call leaves behind.
"""

from __future__ import annotations

import difflib
import operator
from collections.abc import Iterable
from math import inf, nan
from numbers import Real
from typing import NamedTuple, SupportsIndex

from busmaster.errors import InvalidCommand


class Between(NamedTuple):
    """The least and the most that a number may be, bounds included: beside its type, in `Annotated`."""

    least: float
    most: float = inf


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


def is_decimal(text: str) -> bool:
    """Return whether a text is a whole number without a sign, in digits as the command line takes them."""
    return text.isascii() and text.isdigit()


def nearest(name: str, known: Iterable[str]) -> str:
    """Return what may have been meant by a name that is not known: "did you mean 'hcp2'?", or else all that are."""
    known = tuple(known)
    near = difflib.get_close_matches(name, known, n=1)
    if near:
        return f"did you mean {near[0]!r}?"
    return f"there are {', '.join(known)}" if known else "there are none"


def guess(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'hcp2'?" for the end of a message, or nothing where no known name is near."""
    near = difflib.get_close_matches(name, tuple(known), n=1)
    return f"; did you mean {near[0]!r}?" if near else ""
