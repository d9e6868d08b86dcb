"""How values and results are printed: plain lines, or one JSON object a line, each flushed."""

from __future__ import annotations

import enum
import json
import math
import sys
from collections.abc import Iterable
from collections.abc import Set as AbstractSet
from decimal import Decimal
from typing import Any


def number_text(value: float) -> str:
    """Shortest exact, without an exponent: 12.5, -0.0001, 1234; whole numbers without ".0", zero without a sign."""
    if isinstance(value, int):
        return str(int(value))
    if not math.isfinite(value):
        return str(value)
    text = format(Decimal(repr(value)), "f")
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def word_text(word: enum.Flag) -> str:
    """The number and the names of the bits that are set: `65 PROGRAM_RUNNING|AUTO_START_ENABLED`."""
    number: int = word.value
    names, rest = [], number
    for member in type(word):
        if number & member.value == member.value:
            names.append(str(member.name))
            rest &= ~member.value
    if rest:
        names.append(hex(rest))
    return f"{number} {'|'.join(names)}" if names else str(number)


def value_text(value: Any) -> str:
    """One value on one line. A set of numbers (flags that are on) as `0,5,31`, or `none`."""
    match value:
        case None:
            return "-"
        case enum.Flag():
            return word_text(value)
        case enum.Enum():
            return f"{number_text(value.value)} {value.name}"
        case int() | float():
            return number_text(value)
        case AbstractSet():
            return ",".join(str(number) for number in sorted(value)) or "none"
        case list() | tuple():
            return ",".join(value_text(item) for item in value)
        case _:
            return str(value)


def json_value(value: Any) -> Any:
    """The same for JSON: words as numbers, sets and runs as lists, whole numbers without a fraction, NaN as null."""
    match value:
        case enum.Enum():
            return json_value(value.value)
        case bool() | int():
            return int(value)
        case float():
            if not math.isfinite(value):
                return None
            return int(value) if value.is_integer() and abs(value) < 2**53 else value
        case AbstractSet():
            return sorted(value)
        case list() | tuple():
            return [json_value(item) for item in value]
        case _:
            return value


def json_line(**fields: Any) -> str:
    return json.dumps(fields, ensure_ascii=False)


def emit(*lines: str) -> None:
    """Print to standard output and flush. Raises BrokenPipeError when nobody reads it any more."""
    emit_all(lines)


def emit_all(lines: Iterable[str]) -> None:
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()


def note(line: str) -> None:
    """A line for the person, on standard error."""
    print(f"busmaster: {line}", file=sys.stderr, flush=True)
