"""When callers give up: until when a request must have been sent, and until when it must be over (R12)."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from itertools import count
from math import inf, nextafter

from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.transaction import ENDED, Transaction

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
        self._deadlines.expiry = nextafter(self._heap[0][0], inf) if self._heap else inf
