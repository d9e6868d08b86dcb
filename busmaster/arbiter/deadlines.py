"""The deadlines of one line, and the times at which callers stop waiting (R12)."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from itertools import count
from math import inf, nextafter

from busmaster.arbiter.transaction import ENDED, Transaction


class _Other:
    """A deadline that seldom changes. The earliest one is updated when it is set, not at every exchange."""

    def __set_name__(self, owner: type[Deadlines], name: str) -> None:
        self._name = name

    def __get__(self, deadlines: Deadlines, owner: type[Deadlines]) -> float:
        return deadlines.each[self._name]

    def __set__(self, deadlines: Deadlines, due: float) -> None:
        # Found when a deadline changes and not when it is read: `poll_timeout` reads it after every byte.
        deadlines.each[self._name] = due
        deadlines.earliest_other = min(deadlines.each.values())


class Deadlines:
    """Deadlines in the arbiter's time; inf if not set."""

    __slots__ = ("each", "earliest_other", "line")

    schedule = _Other()
    """The next poll is due."""
    expiry = _Other()
    """The first queued request's `start_within` expires."""
    failing = _Other()
    """The next batch of requests of an unusable line is to fail."""
    health = _Other()
    """A dead node's next probe, or the end of a suspension."""
    hold = _Other()
    """A sequence has held the line for its maximum time."""
    delayed = _Other()
    """A transaction that had to wait may be sent."""
    sequence = _Other()
    """A sequence that had to wait for the owner's time may begin."""

    def __init__(self) -> None:
        self.line = inf
        """The state of the line ends: a window, an inter-byte timeout, a holdoff or a resynchronisation."""
        self.each: dict[str, float] = {}
        """All others, by name."""
        self.earliest_other = inf
        self.schedule = self.expiry = self.failing = self.health = self.hold = self.delayed = self.sequence = inf


SLACK = 64
"""Entries of ended transactions kept in addition to twice the number of queued ones."""


class Expiries:
    """The transactions of one line with a `start_by` or a `finish_by`. An action exactly at that time is in time."""

    __slots__ = ("_deadlines", "_heap", "_order")

    def __init__(self, deadlines: Deadlines) -> None:
        self._deadlines = deadlines
        self._heap: list[tuple[float, int, Transaction]] = []
        self._order = count()

    def expect(self, transaction: Transaction, waiting: int) -> None:
        """Remember when a caller stops waiting. `waiting`: number of queued transactions."""
        # Ended transactions are not removed one by one, which would search the heap at the end of each request.
        if len(self._heap) > 2 * waiting + SLACK:
            self._heap = [entry for entry in self._heap if entry[2].phase is not ENDED]
            heapq.heapify(self._heap)
        for moment in {transaction.start_by, transaction.finish_by} - {inf}:
            heapq.heappush(self._heap, (moment, next(self._order), transaction))
        self._set_deadline()

    def due(self, now: float) -> Iterator[Transaction]:
        """Remove and yield the unfinished transactions of which one of the two times has passed."""
        heap = self._heap
        # Most requests end before their time. They are removed when they are first, which costs no search.
        while heap and (heap[0][0] < now or heap[0][2].phase is ENDED):
            transaction = heapq.heappop(heap)[2]
            if transaction.phase is not ENDED:
                yield transaction
        self._set_deadline()

    def _set_deadline(self) -> None:
        # Just after that time, which is still in time. A fixed nanosecond would be lost on a clock that is months old.
        self._deadlines.expiry = nextafter(self._heap[0][0], inf) if self._heap else inf
