"""Alarms: values outside their limits. An alarm is reported when it begins and when it ends, and not in between."""

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
    """A polled value is above `high` or below `low` of its point (`active`), or has returned.

    `limit`: the limit that was crossed; `bound`: its value. `value` is None if the alarm ended because the point is no
    longer watched. For a bit whose 1 is an alarm, `limit` is "high" and `bound` False; for a bit whose 0 is an alarm,
    "low" and True.
    """

    point: Point[Any]
    limit: Side
    bound: float
    value: float | None
    active: bool

    @property
    def name(self) -> str:
        """Kind of alarm: "high" or "low" for a number; "set" or "clear" for a bit."""
        if isinstance(self.bound, bool):
            return "set" if self.limit == "high" else "clear"
        return self.limit

    @property
    def text(self) -> str:
        """Describe the change in a sentence, with the value and its unit."""
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
"""Events of a bus: of its line, its nodes and its polled values."""


class Alarms:
    """The alarms of one line. `notify` is called with each change.

    A value that could not be read neither begins nor ends an alarm.
    """

    def __init__(self, notify: Callable[[AlarmChanged], None]) -> None:
        self.states: Mapping[Point[Any], AlarmChanged | None] = {}
        """The alarm of each watched point, or None. Replaced as a whole, so that it can be read from any thread."""
        self._notify = notify
        self._groups: Counter[Point[Any]] = Counter()
        """Number of poll groups that watch each point."""

    def watch(self, points: Iterable[Point[Any]]) -> None:
        """Watch these points for one more poll group, until `forget`."""
        self._groups.update(points)

    def look(self, points: Iterable[Point[Any]], samples: Mapping[Point[Any], Sample[Any]]) -> None:
        """Report the alarms that begin or end with the samples of these points."""
        changed: dict[Point[Any], AlarmChanged | None] = {}
        changes: list[AlarmChanged] = []
        for point in points:
            sample = samples.get(point)
            if sample is None or sample.error is not None or not isinstance(sample.value, int | float):
                continue
            before = self.states.get(point)
            # Hysteresis: a value at its limit would otherwise begin and end an alarm with each cycle.
            if before is not None and _holds(before.limit, point, sample.value):
                continue
            now = _begun(point, sample.value)
            # First: a value can jump from one side to the other, which ends one alarm and begins another.
            if before is not None:
                changes.append(replace(before, value=sample.value, active=False))
            if now is not None:
                changes.append(now)
            # Also once without an alarm: outputs list each watched point, with the state that it has.
            if before is not None or now is not None or point not in self.states:
                changed[point] = now
        # The same object if nothing has changed: MQTT compares by identity whether it has anything to publish.
        self._become({**self.states, **changed} if changed else self.states, changes)

    def forget(self, points: Iterable[Point[Any]]) -> None:
        """Stop watching these points for one poll group. Ends the alarms of points that no other group watches."""
        points = tuple(points)
        self._groups.subtract(points)
        # Without zero counts, in which the test below would still find the point.
        self._groups = +self._groups
        gone = {point: self.states[point] for point in points if point in self.states and point not in self._groups}
        if gone:
            ended = [replace(alarm, value=None, active=False) for alarm in gone.values() if alarm is not None]
            self._become({point: alarm for point, alarm in self.states.items() if point not in gone}, ended)

    def _become(self, states: Mapping[Point[Any], AlarmChanged | None], changes: Iterable[AlarmChanged]) -> None:
        self.states = states
        for alarm in changes:
            self._notify(alarm)


def _begun(point: Point[Any], value: float) -> AlarmChanged | None:
    """Return the alarm that a value begins, or None."""
    low, high = point.meaning.low, point.meaning.high
    if isinstance(value, bool):  # a bit: its alarm is "above false" or "below true"
        low, high = None if low is None else bool(low), None if high is None else bool(high)
    if high is not None and value > high:
        return AlarmChanged(point, "high", high, value, active=True)
    if low is not None and value < low:
        return AlarmChanged(point, "low", low, value, active=True)
    return None


def _holds(limit: Side, point: Point[Any], value: float) -> bool:
    """Return True if a value has not returned within its limit. A value that is not a number has not returned."""
    meaning = point.meaning
    if limit == "high":
        return meaning.high is not None and not value <= meaning.high - meaning.margin
    return meaning.low is not None and not value >= meaning.low + meaning.margin
