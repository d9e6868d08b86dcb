"""Report by exception: of what is polled, outputs are told what is news by the meaning of its point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from busmaster import Point, Quality, Sample, Snapshot
from busmaster.errors import BusError

ROUNDING = 1e-6
"""Seconds by which two moments of a grid may seem nearer to each other than they are."""


class Told(NamedTuple):
    """What was told last of a point, when it was due, and when it was asked for."""

    value: Any
    quality: Quality
    error: type[BusError] | None
    due: float
    asked: float


class News:
    """What outputs were told of one poll group, and so what is news to them.

    A value is news where it is further than the deadband from what was told last, where its quality is another one,
    as when it could not be read and when it can be again, and where the heartbeat is over. A point whose meaning has
    neither deadband nor heartbeat always is. `outdated` says whether what was asked for at that time has become stale
    or bad since, which an output may have told: what is read then is news, though it be the same value.
    """

    def __init__(self, outdated: Callable[[Point[Any], float], bool] = lambda *_: False) -> None:
        self._outdated = outdated
        self._told: dict[Point[Any], Told] = {}

    def of(self, snapshot: Snapshot) -> Snapshot:
        """Return the cycle with what is news of it."""
        if not any(point.meaning.by_exception for point in snapshot.samples):
            return snapshot
        due = snapshot.due
        news = {
            point: sample
            for point, sample in snapshot.samples.items()
            if not point.meaning.by_exception or self._is_news(point, sample, due)
        }
        return replace(snapshot, samples=news)

    def forget(self) -> None:
        """Let everything be news once more."""
        self._told.clear()

    def _is_news(self, point: Point[Any], sample: Sample[Any], due: float) -> bool:
        told, error = self._told.get(point), None if sample.error is None else type(sample.error)
        heartbeat = point.meaning.heartbeat
        if (
            told is not None
            and (told.quality, told.error) == (sample.quality, error)
            and (heartbeat is None or due - told.due < heartbeat - ROUNDING)
            and not differs(told.value, sample.value, point.meaning.deadband or 0)
            and not self._outdated(point, told.asked)
        ):
            return False
        asked = sample.finished if sample.started is None else sample.started
        self._told[point] = Told(sample.value, sample.quality, error, due, asked)
        return True


def differs(before: Any, now: Any, deadband: float) -> bool:
    """Return whether two values are further from each other than the deadband; of runs, whether any two are."""
    if type(before) is tuple and type(now) is tuple and len(before) == len(now):
        return any(differs(one, other, deadband) for one, other in zip(before, now, strict=True))
    if before == now or (before != before and now != now):  # two NaN are alike
        return False
    numbers = isinstance(before, int | float) and isinstance(now, int | float)
    return not (numbers and abs(now - before) <= deadband)
