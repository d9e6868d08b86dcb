"""Numbers in the form of the HCP and HCP2 documents: decimal text with at most 4 decimals."""

from __future__ import annotations

import math
from collections.abc import Iterable
from decimal import ROUND_HALF_UP, Decimal
from functools import lru_cache
from typing import SupportsFloat

from busmaster.contract.exchange import FrameError
from busmaster.errors import InvalidCommand
from busmaster.wire.characters import made_of

LONGEST_NUMBER = 20
"""Characters of one value. A controller returns at most this many, so a longer value could never be read back."""
LONGEST_LIST = 60
"""Characters of a telegram's data field, commas included."""

_FOURTH_DECIMAL = Decimal("0.0001")
_TOO_BIG = 10**LONGEST_NUMBER
_NUMBER_CHARACTERS = made_of(b"0123456789+-.eE ")


def format_number(value: SupportsFloat) -> str:
    """Return the shortest text with at most 4 decimals: "123.456", ".5", "-.0001", "0"; no exponent, no "-0".

    The fifth decimal is rounded half away from zero, based on Python's decimal text of the value. Raises InvalidCommand
    for NaN, infinity, values that are not numbers, and values that need more than 20 characters.
    """
    if isinstance(value, bool):  # usually a wrong call or message; it would be sent as 1 or 0
        raise InvalidCommand(f"{value!r} is not a number: write {int(value)} if that is meant")
    if not hasattr(value, "__float__"):  # text has none, but float() would accept it
        raise InvalidCommand(f"{value!r} is not a number")
    number = int(value) if isinstance(value, int) else float(value)
    if -_TOO_BIG < number < _TOO_BIG:
        text = str(number) if isinstance(number, int) else _format_float(number)
        if len(text) <= LONGEST_NUMBER:
            return text
    raise InvalidCommand(f"a value must be a finite number of at most {LONGEST_NUMBER} characters")


@lru_cache(maxsize=1024)
def _format_float(value: float) -> str:
    text = f"{Decimal(repr(value)).quantize(_FOURTH_DECIMAL, ROUND_HALF_UP):f}".rstrip("0").rstrip(".")
    if text.startswith("0."):
        return text[1:]
    if text.startswith("-0"):
        return "-" + text[2:] if len(text) > len("-0") else "0"
    return text


def format_list(values: Iterable[SupportsFloat]) -> str:
    """Join values for consecutive elements with commas. Raises InvalidCommand for more than 60 characters."""
    text = ",".join(map(format_number, values))
    if len(text) > LONGEST_LIST:
        raise InvalidCommand(
            f"{len(text)} characters of data do not fit one telegram of {LONGEST_LIST}: write fewer values at a time"
        )
    return text


def parse_number(field: bytes) -> float:
    """Return the value of a reply's data field: sign, digits, fraction, and optional exponent.

    Surrounding spaces are ignored. Raises FrameError for anything else, such as "nan", "1_0" or an empty field.
    """
    if field.translate(_NUMBER_CHARACTERS) == field:  # float() alone would accept "1_0"
        try:
            value = float(field)
        except ValueError:
            pass
        else:
            if math.isfinite(value):
                return value
    raise FrameError(f"{field!r} is not a number")


__all__ = [
    "LONGEST_LIST",
    "LONGEST_NUMBER",
    "format_list",
    "format_number",
    "parse_number",
]
