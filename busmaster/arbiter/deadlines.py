"""The table of deadlines of one line; and when callers give up: until when a request must have been sent, and until
when it must be over (R12).
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from itertools import count
from math import inf, nextafter

from busmaster.arbiter.transaction import ENDED, Transaction


class _Other:
    """A deadline that seldom changes: which of them is the earliest is found then, and not at every exchange."""

    def __set_name__(self, owner: type[Deadlines], name: str) -> None:
        self._name = name

    def __get__(self, deadlines: Deadlines, owner: type[Deadlines]) -> float:
        return deadlines.each[self._name]

    def __set__(self, deadlines: Deadlines, due: float) -> None:
        # Found when a deadline changes and not when it is read: `poll_timeout` reads it after every byte.
        deadlines.each[self._name] = due
        deadlines.earliest_other = min(deadlines.each.values())


class Deadlines:
    """When what is due, in the arbiter's time; inf when it is not set."""

    __slots__ = ("each", "earliest_other", "line")

    schedule = _Other()
    """The next poll is due."""
    expiry = _Other()
    """The first queued request's `start_within` runs out."""
    failing = _Other()
    """More of what waited for a line that can no longer be used is to fail."""
    health = _Other()
    """A dead node's next probe, or the end of a suspension."""
    hold = _Other()
    """The line has been held for one sequence of requests for as long as it may be."""
    sequence = _Other()
    """A sequence may begin that had to wait because others held the line before."""

    def __init__(self) -> None:
        self.line = inf
        """The state of the line ends: a window, an inter-byte timeout, a holdoff, a resynchronisation."""
        self.each: dict[str, float] = {}
        """All others, by name."""
        self.earliest_other = inf
        self.schedule = self.expiry = self.failing = self.health = self.hold = self.sequence = inf


SLACK = 64
"""Entries of ended transactions that are kept beside twice as many as wait."""


class Expiries:
    """The transactions of one line with a `start_by` or a `finish_by`. Both are met by what happens right at them."""

    __slots__ = ("_deadlines", "_heap", "_order")

    def __init__(self, deadlines: Deadlines) -> None:
        self._deadlines = deadlines
        self._heap: list[tuple[float, int, Transaction]] = []
        self._order = count()

    def expect(self, transaction: Transaction, waiting: int) -> None:
        """Remember when the caller of a transaction gives up; `waiting` is how many transactions wait."""
        # Ended transactions are not removed one by one, which would search the heap at the end of each request.
        if len(self._heap) > 2 * waiting + SLACK:
            self._heap = [entry for entry in self._heap if entry[2].phase is not ENDED]
            heapq.heapify(self._heap)
        for moment in {transaction.start_by, transaction.finish_by} - {inf}:
            heapq.heappush(self._heap, (moment, next(self._order), transaction))
        self._set_deadline()

    def due(self, now: float) -> Iterator[Transaction]:
        """Take out the transactions that have not ended and whose time, one of the two, is over."""
        heap = self._heap
        while heap and (heap[0][0] < now or heap[0][2].phase is ENDED):
            transaction = heapq.heappop(heap)[2]
            if transaction.phase is not ENDED:
                yield transaction
        self._set_deadline()

    def _set_deadline(self) -> None:
        # Behind the moment, which is still in time. A fixed nanosecond is lost in a clock that is months old.
        self._deadlines.expiry = nextafter(self._heap[0][0], inf) if self._heap else inf
