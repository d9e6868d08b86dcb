"""Alarms: values that left what they must not leave, each told when it begins and when it ends, and not in between."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from busmaster.arbiter.events import Event
from busmaster.bus.points import Point
from busmaster.bus.samples import Sample

Side: TypeAlias = Literal["low", "high"]


@dataclass(frozen=True, slots=True)
class AlarmChanged:
    """A polled value is above `high` or below `low` of its point (`active`), or no longer.

    `limit` is the one that it crossed, `bound` that limit. `value` is None where it ended as the point is polled no
    more.
    """

    point: Point[Any]
    limit: Side
    bound: float
    value: float | None
    active: bool

    @property
    def text(self) -> str:
        """It in a sentence."""
        crossed = f"{'above' if self.limit == 'high' else 'below'} its {self.limit} of {self._text(self.bound)}"
        if self.active:
            return f"{self.point.key} = {self._text(self.value)} is {crossed}"
        how = "is polled no more" if self.value is None else f"is back at {self._text(self.value)}"
        return f"{self.point.key} {how}, was {crossed}"

    def _text(self, value: float | None) -> str:
        return f"{value:.10g} {self.point.unit}".rstrip()


BusEvent: TypeAlias = Event | AlarmChanged
"""What a bus tells: of its line and nodes, and of what it polls."""


class Alarms:
    """Those of one line. `tell` is called with each that begins or ends.

    A value that could not be read neither begins an alarm nor ends one.
    """

    def __init__(self, tell: Callable[[AlarmChanged], None]) -> None:
        self._tell = tell
        self._active: dict[Point[Any], AlarmChanged] = {}

    @property
    def active(self) -> tuple[AlarmChanged, ...]:
        return tuple(self._active.values())

    def look(self, points: Iterable[Point[Any]], samples: Mapping[Point[Any], Sample[Any]]) -> None:
        """Tell what the samples of these points begin and end."""
        for point in points:
            sample = samples.get(point)
            if sample is not None and sample.error is None and isinstance(sample.value, int | float):
                self._look(point, sample.value)

    def forget(self, points: Iterable[Point[Any]]) -> None:
        """End the alarms of points that are polled no more."""
        for point in points:
            if point in self._active:
                self._end(point, None)

    def _look(self, point: Point[Any], value: float) -> None:
        meaning, active = point.meaning, self._active.get(point)
        if active is not None and not _holds(active.limit, point, value):
            self._end(point, value)
            active = None
        if active is not None:
            return
        if meaning.high is not None and value > meaning.high:
            self._begin(AlarmChanged(point, "high", meaning.high, value, True))
        elif meaning.low is not None and value < meaning.low:
            self._begin(AlarmChanged(point, "low", meaning.low, value, True))

    def _begin(self, alarm: AlarmChanged) -> None:
        self._active[alarm.point] = alarm
        self._tell(alarm)

    def _end(self, point: Point[Any], value: float | None) -> None:
        began = self._active.pop(point)
        self._tell(AlarmChanged(began.point, began.limit, began.bound, value, False))


def _holds(limit: Side, point: Point[Any], value: float) -> bool:
    """Return whether a value is not yet back: one that is no number is not."""
    meaning = point.meaning
    if limit == "high":
        return meaning.high is not None and not value <= meaning.high - meaning.margin
    return meaning.low is not None and not value >= meaning.low + meaning.margin
