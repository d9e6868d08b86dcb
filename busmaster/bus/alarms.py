"""Alarms: values that left what they must not leave, each told when it begins and when it ends, and not in between."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

from busmaster.arbiter.events import Event
from busmaster.bus.points import Point
from busmaster.bus.samples import Sample

Side: TypeAlias = Literal["low", "high"]


@dataclass(frozen=True, slots=True)
class AlarmChanged:
    """A polled value is above `high` or below `low` of its point (`active`), or no longer.

    `limit` is the one that it crossed, `bound` that limit. `value` is None where it ended as the point is watched no
    more. Of a bit whose 1 is an alarm, `limit` is "high" and `bound` False; of one whose 0 is an alarm, "low" and True.
    """

    point: Point[Any]
    limit: Side
    bound: float
    value: float | None
    active: bool

    @property
    def name(self) -> str:
        """What is the alarm: "high" or "low" for a number; "set" or "clear" for a bit."""
        if isinstance(self.bound, bool):
            return "set" if self.limit == "high" else "clear"
        return self.limit

    @property
    def text(self) -> str:
        """Say in a sentence what began or ended, with the value and its unit."""
        if isinstance(self.bound, bool):
            return self._text_of_bit()
        crossed = f"{'above' if self.limit == 'high' else 'below'} its {self.limit} of {self._text(self.bound)}"
        if self.active:
            return f"{self.point.key} = {self._text(self.value)} is {crossed}"
        how = "is watched no more" if self.value is None else f"is back at {self._text(self.value)}"
        return f"{self.point.key} {how}, was {crossed}"

    def _text_of_bit(self) -> str:
        alarming = self.name
        calm = "clear" if alarming == "set" else "set"
        if self.active:
            return f"{self.point.key} is {alarming}"
        how = "is watched no more" if self.value is None else f"is {calm} again"
        return f"{self.point.key} {how}, was {alarming}"

    def _text(self, value: float | None) -> str:
        return f"{value:.10g} {self.point.unit}".rstrip()


BusEvent: TypeAlias = Event | AlarmChanged
"""What a bus tells: of its line and nodes, and of what it polls."""


class Alarms:
    """Those of one line. `tell` is called with each that begins or ends.

    A value that could not be read neither begins an alarm nor ends one.
    """

    def __init__(self, tell: Callable[[AlarmChanged], None]) -> None:
        self.states: Mapping[Point[Any], AlarmChanged | None] = {}
        """The alarm of each point that was looked at, None for none. Replaced whole, so that any thread may look."""
        self._tell = tell
        self._groups: Counter[Point[Any]] = Counter()
        """In how many poll groups each point is watched."""

    def watch(self, points: Iterable[Point[Any]]) -> None:
        """Note that one more poll group watches these points, until it calls `forget`."""
        self._groups.update(points)

    def look(self, points: Iterable[Point[Any]], samples: Mapping[Point[Any], Sample[Any]]) -> None:
        """Tell what the samples of these points begin and end."""
        changed: dict[Point[Any], AlarmChanged | None] = {}
        told: list[AlarmChanged] = []
        for point in points:
            sample = samples.get(point)
            if sample is None or sample.error is not None or not isinstance(sample.value, int | float):
                continue
            before = self.states.get(point)
            if before is not None and _holds(before.limit, point, sample.value):
                continue
            now = _begun(point, sample.value)
            if before is not None:
                told.append(replace(before, value=sample.value, active=False))
            if now is not None:
                told.append(now)
            if before is not None or now is not None or point not in self.states:
                changed[point] = now
        self._become({**self.states, **changed} if changed else self.states, told)

    def forget(self, points: Iterable[Point[Any]]) -> None:
        """Note that a poll group no longer watches these points, and end the alarms of those that no other does."""
        points = tuple(points)
        self._groups.subtract(points)
        self._groups = +self._groups
        gone = {point: self.states[point] for point in points if point in self.states and point not in self._groups}
        if gone:
            ended = [replace(alarm, value=None, active=False) for alarm in gone.values() if alarm is not None]
            self._become({point: alarm for point, alarm in self.states.items() if point not in gone}, ended)

    def _become(self, states: Mapping[Point[Any], AlarmChanged | None], told: Iterable[AlarmChanged]) -> None:
        self.states = states
        for alarm in told:
            self._tell(alarm)


def _begun(point: Point[Any], value: float) -> AlarmChanged | None:
    """Return the alarm that a value begins, None if it begins none."""
    low, high = point.meaning.low, point.meaning.high
    if isinstance(value, bool):  # a bit, of which a bound says "above false" or "below true"
        low, high = None if low is None else bool(low), None if high is None else bool(high)
    if high is not None and value > high:
        return AlarmChanged(point, "high", high, value, active=True)
    if low is not None and value < low:
        return AlarmChanged(point, "low", low, value, active=True)
    return None


def _holds(limit: Side, point: Point[Any], value: float) -> bool:
    """Return whether a value is not yet back: one that is no number is not."""
    meaning = point.meaning
    if limit == "high":
        return meaning.high is not None and not value <= meaning.high - meaning.margin
    return meaning.low is not None and not value >= meaning.low + meaning.margin
