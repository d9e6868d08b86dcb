"""The queues of which the backlog is made: in order of arrival, or of deadlines."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterator
from itertools import count
from typing import Protocol

from busmaster.arbiter.transaction import QUEUED, Transaction

SLACK = 64
"""Entries of ended transactions that a queue may hold beside as many live ones."""
LOOKED_AT = 8
"""Waiting transactions of a class among which one is picked that may go before the first (R15)."""


class Queue(Protocol):
    """Transactions that wait, in the order in which they are to go. Ended ones are skipped."""

    live: int
    """How many wait."""

    def push(self, transaction: Transaction, /) -> None: ...
    def push_front(self, transaction: Transaction, /) -> None: ...
    def pop(self) -> Transaction: ...
    def pick(self, suits: Callable[[Transaction], bool], /) -> Transaction | None: ...
    def discard(self, transaction: Transaction, /) -> None: ...
    def remove(self, transaction: Transaction, /) -> None: ...
    def entries(self) -> Iterator[Transaction]: ...
    def __iter__(self) -> Iterator[Transaction]: ...


class Fifo:
    """First in, first out. Ended transactions are skipped, and swept out before they pile up."""

    __slots__ = ("_entries", "live")

    def __init__(self) -> None:
        self._entries: deque[Transaction] = deque()
        self.live = 0

    def push(self, transaction: Transaction) -> None:
        """Add a transaction at the back."""
        self._entries.append(transaction)
        self.live += 1

    def push_front(self, transaction: Transaction) -> None:
        """Add a transaction at the front."""
        self._entries.appendleft(transaction)
        self.live += 1

    def pop(self) -> Transaction:
        """Take out the first that waits. Raises IndexError if none does."""
        while True:
            transaction = self._entries.popleft()
            if transaction.phase is QUEUED:
                self.live -= 1
                return transaction

    def pick(self, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Take out the first of the first few that suits, or return None."""
        passed: list[Transaction] = []
        found = None
        # Only the first few: equal polls by the hundred must not be searched for an unlike one at every exchange.
        while self.live > len(passed) and len(passed) < LOOKED_AT and found is None:
            transaction = self._entries.popleft()
            if transaction.phase is not QUEUED:
                continue
            if suits(transaction):
                found = transaction
                self.live -= 1
            else:
                passed.append(transaction)
        self._entries.extendleft(reversed(passed))
        return found

    def discard(self, transaction: Transaction) -> None:
        """Give up the place of a transaction that waits no longer; it is swept out later."""
        # A caller that gives up must be free at once, however long the queue is, so its place is only given up, and
        # swept later. Without the sweep, callers that always give up would fill the memory of a line that never gets
        # to them.
        self.live -= 1
        if len(self._entries) > 2 * self.live + SLACK:
            self._entries = deque(self)

    def remove(self, transaction: Transaction) -> None:
        """Take out this transaction at once, wherever in the queue it is."""
        self._entries.remove(transaction)
        self.live -= 1

    def entries(self) -> Iterator[Transaction]:
        """Return all that is in the queue, ended ones too, in no order."""
        return iter(self._entries)

    def __iter__(self) -> Iterator[Transaction]:
        return (t for t in self._entries if t.phase is QUEUED)


class EarliestDeadlineFirst:
    """By `Transaction.deadline`, then in the order of arrival."""

    __slots__ = ("_entries", "_order", "live")

    def __init__(self) -> None:
        self._entries: list[tuple[float, int, Transaction]] = []
        self._order = count()
        self.live = 0

    def push(self, transaction: Transaction) -> None:
        """Add a transaction at its deadline, behind those that have the same one."""
        heapq.heappush(self._entries, (transaction.deadline, next(self._order), transaction))
        self.live += 1

    def push_front(self, transaction: Transaction) -> None:
        """Add a transaction before all others, and give it the deadline of the first."""
        # The first of all whatever its deadline, or a write would go behind what it had its turn before. The negative
        # number puts it before the one that has the same deadline, and the last one put back before the others.
        transaction.deadline = self._entries[0][0] if self._entries else transaction.deadline
        heapq.heappush(self._entries, (transaction.deadline, -next(self._order), transaction))
        self.live += 1

    def pick(self, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Take out the first of the first few that suits, or return None."""
        passed: list[tuple[float, int, Transaction]] = []
        found = None
        while self.live > len(passed) and len(passed) < LOOKED_AT and found is None:
            entry = heapq.heappop(self._entries)
            if entry[2].phase is not QUEUED:
                continue
            if suits(entry[2]):
                found = entry[2]
                self.live -= 1
            else:
                passed.append(entry)
        for entry in passed:
            heapq.heappush(self._entries, entry)
        return found

    def pop(self) -> Transaction:
        """Take out the one with the earliest deadline. Raises IndexError if none waits."""
        while True:
            transaction = heapq.heappop(self._entries)[2]
            if transaction.phase is QUEUED:
                self.live -= 1
                return transaction

    def discard(self, transaction: Transaction) -> None:
        """Give up the place of a transaction that waits no longer; it is swept out later."""
        self.live -= 1
        if len(self._entries) > 2 * self.live + SLACK:
            self._entries = [entry for entry in self._entries if entry[2].phase is QUEUED]
            heapq.heapify(self._entries)

    def remove(self, transaction: Transaction) -> None:
        """Take out this transaction at once, wherever in the queue it is."""
        self._entries = [entry for entry in self._entries if entry[2] is not transaction]
        heapq.heapify(self._entries)
        self.live -= 1

    def entries(self) -> Iterator[Transaction]:
        """Return all that is in the queue, ended ones too, in no order."""
        return (transaction for _, _, transaction in self._entries)

    def __iter__(self) -> Iterator[Transaction]:
        return (t for _, _, t in sorted(self._entries, key=lambda e: e[:2]) if t.phase is QUEUED)
