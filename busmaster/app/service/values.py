"""How values and events are written: as text on one line, and as JSON."""

from __future__ import annotations

import enum
import json
import math
from collections.abc import Callable
from collections.abc import Set as AbstractSet
from datetime import UTC, datetime
from decimal import Decimal
from typing import Any

from busmaster import Health, Quality, Sample, Snapshot
from busmaster.app.service.record import WriteRecord
from busmaster.events import (
    AlarmChanged,
    BusEvent,
    LineChanged,
    MaxReplyDelayRaised,
    NodeChanged,
    PortFailed,
    RepliesLate,
)
from busmaster.ext import Named


def number_text(value: float) -> str:
    """Return the shortest exact text, without an exponent: 12.5, -0.0001, 1234.

    Whole numbers are without ".0", zero without a sign.
    """
    if isinstance(value, int):
        return str(int(value))
    if not math.isfinite(value):
        return str(value)
    text = repr(value)
    if "e" in text:
        text = format(Decimal(text), "f")
    text = text.removesuffix(".0")
    return "0" if text == "-0" else text


def rounded_text(value: float, precision: int) -> str:
    """Return the number as people are shown it, with so many decimals; zero without a sign."""
    text = f"{value:.{precision}f}"
    return text.removeprefix("-") if text.startswith("-") and not text.strip("-0.") else text


def word_text(word: enum.Flag) -> str:
    """Return the number and the names of the bits that are set: `65 PROGRAM_RUNNING|AUTO_START_ENABLED`."""
    return f"{word.value} {'|'.join(set_bits(word))}".rstrip()


def set_bits(word: enum.Flag) -> list[str]:
    """Return the names of the bits that are set, and those that have no name as one number in hex."""
    names, rest = [], word.value
    for member in type(word):
        if word.value & member.value == member.value:
            names.append(str(member.name))
            rest &= ~member.value
    return [*names, hex(rest)] if rest else names


def value_text(value: Any, precision: int | None = None) -> str:
    """Return one value on one line, a number with so many decimals, all if `precision` is None.

    A set of numbers (flags that are on) becomes `0,5,31`, or `none`. Names follow the numbers of words and labels.
    """
    match value:
        case None:
            return "-"
        case Named():
            return str(value)
        case enum.Flag():
            return word_text(value)
        case enum.Enum():
            return f"{number_text(value.value)} {value.name}"
        case int() | float():
            return number_text(value) if precision is None else rounded_text(value, precision)
        case AbstractSet():
            return ",".join(str(number) for number in sorted(value)) or "none"
        case list() | tuple():
            return ",".join(value_text(item, precision) for item in value)
        case _:
            return str(value)


def json_value(value: Any) -> Any:
    """Return a value as JSON has it.

    Words become numbers, sets and runs lists, whole numbers lose their fraction, and NaN and infinity become null.
    """
    match value:
        case enum.Enum():
            return json_value(value.value)
        case bool() | int():
            return int(value)
        case float():
            if not math.isfinite(value):
                return None
            # Above 2**53 a float does not distinguish adjacent whole numbers.
            return int(value) if value.is_integer() and abs(value) < 2**53 else value
        case AbstractSet():
            return sorted(value)
        case list() | tuple():
            return [json_value(item) for item in value]
        case _:
            return value


def json_line(**fields: Any) -> str:
    """Return the fields as one line of JSON. What JSON has no word for is written as text."""
    return json.dumps(fields, ensure_ascii=False, default=str)


def micros(moment: float) -> float:
    """Round a time in seconds to the microsecond; further digits are noise."""
    return round(moment, 6)


def utc(moment: float, digits: str = "milliseconds") -> str:
    """Return a time in seconds since 1970 as UTC text, to the millisecond or to the `digits` that `isoformat` knows."""
    return datetime.fromtimestamp(moment, UTC).isoformat(timespec=digits).replace("+00:00", "Z")


def cycle_fields(snapshot: Snapshot, time_of: Callable[[float], float]) -> dict[str, Any]:
    """Return one cycle as a JSON object; `time_of` makes its times, to the microsecond, of the bus's."""

    def at(moment: float) -> float:
        return micros(time_of(moment))

    return {
        "group": snapshot.group,
        "cycle": snapshot.cycle,
        "due": at(snapshot.due),
        "started": None if snapshot.started is None else at(snapshot.started),
        "finished": at(snapshot.finished),
        "missed": snapshot.missed,
        "samples": {point.key: sample_fields(sample) for point, sample in snapshot.samples.items()},
    }


def sample_fields(sample: Sample[Any]) -> dict[str, Any]:
    """Return a value, or its error, with its quality and whether it is late.

    Where they exist, the name of the value and a hint are added.
    """
    fields: dict[str, Any] = {
        "quality": sample.quality.value,
        "value": json_value(sample.value),
        "error": None if sample.error is None else sample.error.what,
        "late": sample.quality is Quality.LATE,
    }
    if sample.error is not None and sample.error.hint:
        fields["hint"] = sample.error.hint
    return {**fields, **name_fields(sample.value)}


def name_fields(value: Any) -> dict[str, Any]:
    """Return the name of a number: its `label`, or the `names` of the set bits of a word."""
    match value:
        case Named():
            return {"label": value.label}
        case enum.Flag():
            return {"names": set_bits(value)}
        case enum.Enum():
            return {"label": value.name}
        case _:
            return {}


def write_fields(record: WriteRecord) -> dict[str, Any]:
    """One write as a JSON object."""
    return {
        **record._asdict(),
        "time": micros(record.time),
        "before": json_value(record.before),
        "value": json_value(record.value),
        "outcome": record.outcome.value,
        "error": record.error or None,
        "took": micros(record.took),
        "id": record.id or None,
    }


def event_text(event: BusEvent) -> str:
    """Return the text of an event for users, as a sentence; "" for other events."""
    match event:
        case NodeChanged() if event.before is not Health.UNKNOWN or event.after is not Health.UP:
            return f"{event.node.label} is {event.after.value}, was {event.before.value}"
        case MaxReplyDelayRaised():
            return (
                f"{event.node.label} replied after {event.age * 1000:.0f} ms; "
                f"maximum reply delay raised to {event.max_reply_delay * 1000:.0f} ms"
            )
        case RepliesLate():
            return (
                f"{event.node.label} replies after {event.age * 1000:.0f} ms, later than its reply window of "
                f"{event.window * 1000:g} ms; its values are marked late"
            )
        case LineChanged():
            return f"the line is {event.change.value}" + (f": {event.cause}" if event.cause else "")
        case AlarmChanged():
            return event.text
        case PortFailed():
            return f"cannot connect: {event.cause}" + (f"; {event.hint}" if event.hint else "")
        case _:
            return ""
