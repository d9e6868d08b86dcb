"""The meaning of a point's value: names, display, report by exception, and alarm limits."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from math import isfinite
from typing import Annotated, Any

from busmaster.contract.arguments import Between
from busmaster.errors import InvalidCommand


class MeansNothing(InvalidCommand):
    """An invalid meaning. `field`: the field concerned; `fault`: its error."""

    def __init__(self, field: str, fault: str) -> None:
        self.field = field
        self.fault = fault
        super().__init__(f"{field}: {fault}")


BIT_NAME = re.compile(r"[^\W\d][\w-]*")
MOST_DIGITS = 15
"""A float has no more significant digits."""
SHARE = 0.01
"""Default hysteresis as a share of the range between low and high."""
OF_QUANTITIES = {
    "precision": "",
    **dict.fromkeys(("low", "high", "hysteresis"), "; for each of its changes, and these alone, write deadband = 0"),
}
"""Fields that are not allowed for numbers that have names, and the remedy."""


class Named(int):
    """A whole number with a name. It counts, compares and is stored as the number, and prints with both.

    `label`: the label of the number, or the names of the bits that are set: "READY|FAULT".
    """

    label: str

    def __new__(cls, number: int, label: str) -> Named:
        self = super().__new__(cls, number)
        self.label = label
        return self

    def __str__(self) -> str:
        return f"{int(self)} {self.label}".rstrip()


@dataclass(frozen=True, slots=True, kw_only=True)
class Meaning:
    """The meaning of a point's value. Raises MeansNothing, an InvalidCommand, for an invalid combination.

        status = replace(drive.point("11"), meaning=Meaning(bits={"READY": 0, "FAULT": 3}))
        group.add(status, *status.bits)

    All but `heartbeat` is in the unit of the value.
    """

    precision: Annotated[int | None, Between(0, MOST_DIGITS)] = None
    """How many decimals are displayed. Stored values are not rounded."""
    bits: Mapping[str, int] = field(default_factory=dict)
    """Names of the word's bits, 0 the lowest, each a point of its own: `bits = { READY = 0, FAULT = 3 }`."""
    labels: Mapping[int, str] = field(default_factory=dict)
    """Names of whole numbers: `labels = { 0 = "off", 1 = "run" }`."""
    deadband: Annotated[float | None, Between(0, self_checked=True)] = None
    """Outputs get a value only if it differs by more than this from the last one that they got; 0: every change."""
    heartbeat: Annotated[float | None, Between(unit="s")] = None
    """Longest time after which outputs get a value even if it has not changed; more than 0."""
    low: float | None = None
    """A value below it begins an alarm."""
    high: float | None = None
    """A value above it begins an alarm."""
    hysteresis: float | None = None
    """How far a value must be back for its alarm to end. By default a hundredth of the range from `low` to `high`, or
    of the only limit."""
    alarm_if_set: tuple[str, ...] = ()
    """Bits that begin an alarm while they are 1, by their names in `bits`: `alarm_if_set = ["FAULT"]`."""
    alarm_if_clear: tuple[str, ...] = ()
    """Bits that begin an alarm while they are 0, likewise."""

    def __post_init__(self) -> None:
        for name, fault in self.faults():
            raise MeansNothing(name, fault)

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield the faults, each with the name of its field."""
        yield from self._faults_of_names()
        for name in ("precision", "deadband", "heartbeat", "low", "high", "hysteresis"):
            value = getattr(self, name)
            # A bool is an int: `high = true` in LINE.toml would be a limit of 1.
            if value is not None and (isinstance(value, bool) or not isfinite(value)):
                yield name, f"must be a finite number, not {value}"
        if self.precision is not None and not 0 <= self.precision <= MOST_DIGITS:
            yield "precision", f"is 0 to {MOST_DIGITS} decimals, not {self.precision}"
        if self.deadband is not None and not self.deadband >= 0:
            yield "deadband", f"is 0 or more, not {self.deadband}"
        if self.heartbeat is not None and not self.heartbeat > 0:
            yield "heartbeat", f"is more than 0 seconds, not {self.heartbeat}; leave it out for none"
        yield from self._faults_of_limits()

    def _faults_of_names(self) -> Iterator[tuple[str, str]]:
        if self.bits and self.labels:
            yield "labels", "a number has bits or labels, not both: bits are of words"
        for name, instead in OF_QUANTITIES.items() if self.bits or self.labels else ():
            if getattr(self, name) is not None:
                yield name, f"is for quantities, and this number has {'bits' if self.bits else 'labels'}{instead}"
        if (self.bits or self.labels) and self.deadband:
            yield "deadband", "of a number with names is 0: every change is reported"
        holders: dict[int, str] = {}
        for name, bit in self.bits.items():
            if not BIT_NAME.fullmatch(name):
                yield "bits", f"the name of a bit begins with a letter and is of letters, digits, _ and -, not {name!r}"
            if type(bit) is not int or bit < 0:
                yield "bits", f"{name} must be the number of a bit, 0 for the lowest, not {bit!r}"
            elif holders.setdefault(bit, name) != name:
                yield "bits", f"{name} and {holders[bit]} are the same bit, {bit}"
        for field_name, other in (("alarm_if_set", ()), ("alarm_if_clear", self.alarm_if_set)):
            for name in getattr(self, field_name):
                if name not in self.bits:
                    yield field_name, f"{name!r} is not the name of a bit: name it in bits too"
                elif name in other:
                    yield field_name, f"{name} is in alarm_if_set too, and would always be an alarm"
        for number, label in self.labels.items():
            if type(number) is not int:
                yield "labels", f"are of whole numbers, not of {number!r}"
            if not label or not label.isprintable():
                yield "labels", f"the label of {number} is a text on one line, not {label!r}"

    def _faults_of_limits(self) -> Iterator[tuple[str, str]]:
        low, high, hysteresis = self.low, self.high, self.hysteresis
        if low is not None and high is not None and low >= high:
            yield "low", f"{low} must be below high, which is {high}"
        if hysteresis is None:
            return
        if not hysteresis >= 0:
            yield "hysteresis", f"is 0 or more, not {hysteresis}"
        elif not self.watched:
            yield "hysteresis", "is of low and high: write one of them, or leave it out"
        elif low is not None and high is not None and hysteresis >= high - low:
            yield "hysteresis", f"must be less than the {high - low:.10g} between low and high, not {hysteresis}"

    @property
    def watched(self) -> bool:
        """Return True if it has a limit that can cause an alarm."""
        return self.low is not None or self.high is not None

    @property
    def margin(self) -> float:
        """Return the hysteresis."""
        if self.hysteresis is not None:
            return self.hysteresis
        if self.low is not None and self.high is not None:
            return SHARE * (self.high - self.low)
        return SHARE * abs(self.low or self.high or 0.0)

    def of_bit(self, name: str) -> Meaning:
        """Return the meaning of one of its bits: its alarm is above false, or below true."""
        return Meaning(
            deadband=self.deadband,
            heartbeat=self.heartbeat,
            high=0 if name in self.alarm_if_set else None,
            low=1 if name in self.alarm_if_clear else None,
            # The default margin is 0.01 for `low=1`: an alarm would never end, because a bit does not reach 1.01.
            hysteresis=0 if name in (*self.alarm_if_set, *self.alarm_if_clear) else None,
        )

    @property
    def by_exception(self) -> bool:
        """Return True if outputs get only changes."""
        return self.deadband is not None or self.heartbeat is not None

    @property
    def names(self) -> bool:
        """Return True if values, or bits of them, have names."""
        return bool(self.bits or self.labels)

    def number_of(self, label: str) -> int:
        """Return the number with this label. Raises InvalidCommand, with all labels, if none or several have it."""
        found = [number for number, name in self.labels.items() if name == label]
        if len(found) != 1:
            known = ", ".join(f"{name!r}" for name in self.labels.values())
            raise InvalidCommand(
                f"{label!r} is the label of {'no' if not found else 'more than one'} value: use {known}"
            )
        return found[0]

    def named(self, value: Any) -> Any:
        """Return the value with its names; unchanged if it has none, or names from its protocol."""
        # A list, a text or a fraction has no name.
        # `//` and not `int`, which raises an error for nan and infinity; neither equals its quotient.
        if not isinstance(value, int | float) or value != value // 1:
            return value
        number = int(value)
        if self.labels:
            return Named(number, self.labels[number]) if number in self.labels else value
        if isinstance(value, Enum):
            return value
        return Named(number, "|".join(name for name, bit in self.bits.items() if number >> bit & 1))


PLAIN = Meaning()
"""The meaning of a point without one."""


def bit_of(value: Any, bit: int) -> bool:
    """Return True if a bit of a word is set, or a number is among flags. Raises ValueError for other values."""
    number = value.value if isinstance(value, Enum) else value
    # Some protocols return flags as a set of numbers.
    if isinstance(number, frozenset | set):
        return bit in number
    if not isinstance(number, int | float) or not isfinite(number) or number != int(number):
        raise ValueError("it is not a word")
    return bool(int(number) >> bit & 1)
