"""Report by exception: outputs get only values that differ by the deadband, or are due by the heartbeat."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from busmaster import BusError, Point, Quality, Sample, Snapshot

ROUNDING = 1e-6
"""Seconds by which two moments of a grid may seem nearer to each other than they are."""


class Sent(NamedTuple):
    """The last reported value of a point, its due time, and the time of its request."""

    value: Any
    quality: Quality
    error: type[BusError] | None
    due: float
    asked: float


class News:
    """The last values that outputs got from one poll group, to find the values to report.

    A value is reported in three cases: it differs from the last one by more than the deadband, its quality has changed,
    or the heartbeat time has passed. A point without deadband and heartbeat is always reported. `outdated` returns
    whether a value that was requested at that time has since become stale or bad, which an output may have reported.
    Then the next value is reported, even if it is the same.
    """

    def __init__(self, outdated: Callable[[Point[Any], float], bool] = lambda *_: False) -> None:
        self._outdated = outdated
        self._sent: dict[Point[Any], Sent] = {}

    def of(self, snapshot: Snapshot) -> Snapshot:
        """Return the cycle with only the values to report."""
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
        self._sent.clear()

    def _is_news(self, point: Point[Any], sample: Sample[Any], due: float) -> bool:
        sent, error = self._sent.get(point), None if sample.error is None else type(sample.error)
        heartbeat = point.meaning.heartbeat
        if (
            sent is not None
            and (sent.quality, sent.error) == (sample.quality, error)
            and (heartbeat is None or due - sent.due < heartbeat - ROUNDING)
            and not differs(sent.value, sample.value, point.meaning.deadband or 0)
            and not self._outdated(point, sent.asked)
        ):
            return False
        asked = sample.finished if sample.started is None else sample.started
        self._sent[point] = Sent(sample.value, sample.quality, error, due, asked)
        return True


def differs(before: Any, now: Any, deadband: float) -> bool:
    """Return whether two values are further from each other than the deadband; of runs, whether any two are."""
    if type(before) is tuple and type(now) is tuple and len(before) == len(now):
        return any(differs(one, other, deadband) for one, other in zip(before, now, strict=True))
    if before == now or (before != before and now != now):  # two NaN are alike
        return False
    numbers = isinstance(before, int | float) and isinstance(now, int | float)
    return not (numbers and abs(now - before) <= deadband)
