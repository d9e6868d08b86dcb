"""What waits for the line: four strict classes, and one slot in eight for the lower ones (R9)."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterator
from itertools import count, islice

from busmaster.arbiter.transaction import BACKGROUND, POLL, QUEUED, Phase, Priority, Transaction

SHARE = 7
"""Consecutive exchanges of higher classes after which a waiting lower class gets one slot."""
SLACK = 64
"""Entries of ended transactions that a queue may hold beside as many live ones."""
SEARCHED = 256
"""Entries of a class among which one is searched that serves as a check (R15)."""
LOOKED_AT = 8
"""Waiting transactions of a class among which one is picked that may go before the first (R15)."""


class _Fifo:
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

    def discard(self) -> None:
        """Give up the place of one that waits no longer; it is swept out later."""
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


class _EarliestDeadlineFirst:
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

    def discard(self) -> None:
        """Give up the place of one that waits no longer; it is swept out later."""
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


class Backlog:
    """The waiting transactions of all classes. A transaction in it has the phase QUEUED."""

    __slots__ = ("_rotated", "_rotated_before", "_streak", "_streak_before", "queues")

    def __init__(self) -> None:
        self.queues = (_Fifo(), _Fifo(), _EarliestDeadlineFirst(), _EarliestDeadlineFirst())
        self._streak = 0
        self._rotated = BACKGROUND
        self._streak_before, self._rotated_before = 0, BACKGROUND

    def __len__(self) -> int:
        urgent, command, poll, background = self.queues
        return urgent.live + command.live + poll.live + background.live

    def waiting(self, priority: Priority) -> int:
        """Return how many transactions of this class wait."""
        return self.queues[priority].live

    def push(self, transaction: Transaction) -> None:
        """Put a transaction at the back of its class (of its deadline, in POLL and BACKGROUND)."""
        transaction.phase = QUEUED
        self.queues[transaction.priority].push(transaction)

    def push_front(self, transaction: Transaction) -> None:
        """Put a transaction at the front of its class, as a write whose turn came while an earlier one was not over."""
        transaction.phase = QUEUED
        self.queues[transaction.priority].push_front(transaction)

    def discard(self, transaction: Transaction, phase: Phase) -> None:
        """Take a queued transaction out and give it another phase."""
        transaction.phase = phase
        self.queues[transaction.priority].discard()

    def restore(self, transaction: Transaction) -> None:
        """Put back what was popped last: it is the next to be popped, and its class keeps its turn."""
        self._streak, self._rotated = self._streak_before, self._rotated_before
        self.push_front(transaction)

    def pick(self, priority: Priority, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Take out the first of the first few of a class that suits, or return None; the others keep their places."""
        return self.queues[priority].pick(suits)

    def take(self, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Take out one that suits, of whatever class, or return None: for what has to be asked now in any case."""
        for queue in self.queues:
            found = next((t for t in islice(queue.entries(), SEARCHED) if t.phase is QUEUED and suits(t)), None)
            if found is not None:
                queue.remove(found)
                return found
        return None

    def promote(self, transaction: Transaction, priority: Priority) -> None:
        """Move a transaction to the front of a higher class: a write that a write of that class must not overtake."""
        self.queues[transaction.priority].remove(transaction)
        transaction.priority = priority
        self.push_front(transaction)

    def pop(self) -> Transaction | None:
        """Take out the next to go, or return None.

        URGENT goes first, always; below it a waiting lower class gets every eighth slot.
        """
        urgent, command, poll, background = self.queues
        self._streak_before = self._streak
        self._rotated_before = self._rotated
        if urgent.live:
            # Not counted as a higher class that had its turn: a stop waits for nobody's fairness. R9's bounds of the
            # lower classes therefore hold below sustained urgent traffic only.
            return urgent.pop()
        if command.live:
            if not poll.live and not background.live:
                self._streak = 0  # nobody was kept waiting, so nobody is owed a slot
            elif self._streak >= SHARE:
                return self._lower_slot()
            else:
                self._streak += 1
            return command.pop()
        if poll.live:
            if not background.live:
                self._streak = 0
            elif self._streak >= SHARE:
                self._streak = 0
                return background.pop()
            else:
                self._streak += 1
            return poll.pop()
        self._streak = 0
        return background.pop() if background.live else None

    def _lower_slot(self) -> Transaction:
        """Take out the next of POLL and BACKGROUND, which have turns if both wait."""
        self._streak = 0
        _, _, poll, background = self.queues
        if poll.live and (self._rotated is BACKGROUND or not background.live):
            self._rotated = POLL
            return poll.pop()
        self._rotated = BACKGROUND
        return background.pop()

    def drain(self) -> list[Transaction]:
        """Take out everything that waits, in order of class; the backlog is empty afterwards."""
        drained = [transaction for queue in self.queues for transaction in queue]
        self.queues = (_Fifo(), _Fifo(), _EarliestDeadlineFirst(), _EarliestDeadlineFirst())
        return drained
