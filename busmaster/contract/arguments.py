"""Checks of arguments, numbers and names: invalid ones raise InvalidCommand before anything is sent.

True is not accepted as a number, although Python treats it as 1: it is usually the result of a wrong call.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable
from math import inf, nan
from numbers import Real
from typing import Any, NamedTuple, SupportsIndex

from busmaster.errors import InvalidCommand

HIGHEST_PORT = 65535
LONGEST_NUMBER = 20
"""Maximum number of digits of a number in a text. Python rejects numbers with some thousands."""


class Between(NamedTuple):
    """The least and the most that a number may be, bounds included, and its unit: beside its type, in `Annotated`.

    Of a text, `most` is the largest number of characters. The reader of a file rejects other values. If `self_checked`,
    the class that has the number does so itself, with a more specific message.
    """

    least: float = -inf
    most: float = inf
    unit: str = ""
    self_checked: bool = False


class Parsed(NamedTuple):
    """How the value of an attribute is made of what a file has for it: beside the attribute's type, in `Annotated`.

    `parse` gets a value of the type `given`, by default that of the attribute, and raises InvalidCommand for one that
    it rejects. `shown` is what the reference calls that type. `written` returns what a file would have for a value.
    """

    parse: Callable[[Any], Any]
    given: Any = None
    shown: str = ""
    written: Callable[[Any], object] | None = None


def whole_number(value: SupportsIndex, lowest: int, highest: int, what: str) -> int:
    """Return `value` as an int. Raises InvalidCommand with the name `what` unless it is a whole number in this
    range."""
    # nearly all values are ints, which need no conversion
    number = value if type(value) is int else _index(value, what)
    if not lowest <= number <= highest:
        raise InvalidCommand(f"{what} must be {lowest} to {highest}, not {number}")
    return number


def _index(value: SupportsIndex, what: str) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool):
        raise InvalidCommand(f"{what} must be a whole number, not {value!r}")
    return number


def seconds(value: object, what: str) -> float:
    """Return `value` as a float. Raises InvalidCommand with the name `what` unless it is a finite time of 0 s or
    more."""
    if type(value) is float:  # nearly all values are floats: other number types cost more to check than all the rest
        number = value
    else:
        number = nan if isinstance(value, bool) or not isinstance(value, Real) else _float(value)
    if not 0 <= number < inf:
        raise InvalidCommand(f"{what} is a time of 0 s or more, not {value!r}")
    return number


def _float(value: Real) -> float:
    try:
        return float(value)
    except OverflowError:  # a whole number of some hundred digits
        return inf


def is_decimal(text: str) -> bool:
    """Return True if a text is a whole number without a sign, of at most 20 digits, as on the command line."""
    return text.isascii() and text.isdigit() and len(text) <= LONGEST_NUMBER


def host_and_port(text: str) -> tuple[str, int]:
    """Return the host and the port of `HOST:PORT`. Raises InvalidCommand."""
    host, colon, port = text.rpartition(":")
    if not colon or not host or not is_decimal(port) or int(port) > HIGHEST_PORT:
        raise InvalidCommand(f"a TCP address is written HOST:PORT, like 127.0.0.1:5020, not {text!r}")
    return host.strip("[]"), int(port)


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that was probably meant, or None."""
    try:
        import difflib  # only a wrong name needs it
    except OSError:  # no free descriptor: the error is raised without a guess
        return None
    return next(iter(difflib.get_close_matches(name, list(known), n=1)), None)


def guess(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" for the end of a message, or nothing if no known name is near."""
    near = nearest(name, known)
    return "" if near is None else f"; did you mean {near!r}?"


def meant(name: str, known: Iterable[str]) -> str:
    """Return "did you mean 'x'?" or, if no known name is near, "there are x, y"."""
    known = tuple(known)
    near = nearest(name, known)
    if near is not None:
        return f"did you mean {near!r}?"
    return f"there are {', '.join(known)}" if known else "there are none"


__all__ = [
    "Between",
    "Parsed",
    "guess",
    "is_decimal",
    "meant",
    "nearest",
    "seconds",
    "whole_number",
]
