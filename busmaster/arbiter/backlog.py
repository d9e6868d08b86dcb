"""What waits for the line: four strict classes, and one slot in eight for the lower ones (R9)."""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from typing import TypeAlias

from busmaster.arbiter.clients import LineClient
from busmaster.arbiter.queues import EarliestDeadlineFirst, Fifo, Queue
from busmaster.arbiter.transaction import BACKGROUND, POLL, QUEUED, Phase, Priority, Transaction

SHARE = 7
"""Consecutive exchanges of higher classes after which a waiting lower class gets one slot."""
SEARCHED = 256
"""Entries of a class among which one is searched that serves as a check (R15)."""
Queues: TypeAlias = tuple[Queue, Queue, Queue, Queue]


class Backlog:
    """The waiting transactions of all classes. A transaction in it has the phase QUEUED."""

    __slots__ = ("_rotated", "_rotated_before", "_streak", "_streak_before", "_urgent_yields", "queues")

    def __init__(self) -> None:
        self.queues: Queues = new_queues()
        self._urgent_yields = False
        """Whether a lower class goes before what waits in URGENT, which is other programs' alone."""
        self._streak = 0
        self._rotated = BACKGROUND
        self._streak_before, self._rotated_before = 0, BACKGROUND

    def __len__(self) -> int:
        urgent, command, poll, background = self.queues
        return urgent.live + command.live + poll.live + background.live

    def waiting(self, priority: Priority) -> int:
        """Return how many transactions of this class wait."""
        return self.queues[priority].live

    def waiting_of(self, priority: Priority, client: LineClient | None) -> int:
        """Return how many transactions of this class wait that are this client's."""
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
        self.queues[transaction.priority].discard(transaction)

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
        # Not discarded and left to be swept: it is QUEUED all the time, and would be served from its old place too.
        self.queues[transaction.priority].remove(transaction)
        transaction.priority = priority
        self.push_front(transaction)

    def pop(self, now: float) -> Transaction | None:
        """Take out the next to go at the time `now`, or return None.

        URGENT goes first, always; below it a waiting lower class gets every eighth slot.
        """
        urgent, command, poll, background = self.queues
        self._streak_before = self._streak
        self._rotated_before = self._rotated
        if urgent.live and not self._urgent_yields:
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
        self.queues = new_queues()
        return drained


def new_queues() -> Queues:
    """Return an empty queue for each class."""
    return Fifo(), Fifo(), EarliestDeadlineFirst(), EarliestDeadlineFirst()
