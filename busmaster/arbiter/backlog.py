"""What waits for the line: four strict classes, and one slot in eight for the lower ones (R9). A class is in order of
arrival or of deadlines. The writes to each node are in order: none overtakes another of the same program, retries
included (R7).
"""

from __future__ import annotations

import heapq
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from itertools import count, islice
from typing import Protocol, TypeAlias

from busmaster.arbiter.clients import Hold, LineClient, turn_of
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.transaction import BACKGROUND, PARKED, POLL, QUEUED, Phase, Priority, Transaction

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
        # What does not suit is put back with its old key, and so keeps its place among equals.
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
        # Swept in bulk: to remove each cancelled request from the middle of the heap would cost a search each time.
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

    def keep_turn(self, transaction: Transaction) -> None:
        """Note that what was popped last is not sent: where clients take turns, it was no turn of its client."""

    def pick(self, priority: Priority, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Take out the first of the first few of a class that suits, or return None; the others keep their places."""
        return self.queues[priority].pick(suits)

    def take(self, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Take out one that suits, of whatever class, or return None: for what has to be asked now in any case."""
        for queue in self.queues:
            # Bounded: with ten thousand requests waiting, an unbounded search would take longer than an exchange.
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

    def let_pass(self, transaction: Transaction) -> None:
        """Have one that waits be sent although its sequence may not begin: a stop waits behind it."""

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
                self._streak = 0  # nobody was kept waiting, so nobody is overdue a slot
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


class Writes:
    """Of one line. `queues` holds each node's writes that are not over; those behind the first of a client are parked.

    A sequence that holds the line is a client of its own.
    """

    def __init__(self, backlog: Backlog) -> None:
        self.queues: defaultdict[NodeRecord, deque[Transaction]] = defaultdict(deque)
        self.backlog = backlog

    def is_first(self, write: Transaction) -> bool:
        """Return whether no earlier write of its client to its node is under way."""
        return self.queues[write.node][0] is write or self.first_of(write.node, turn_of(write.client)) is write

    def first_of(self, node: NodeRecord, client: LineClient) -> Transaction | None:
        """Return the first write of a client to a node, or None."""
        return next((write for write in self.queues.get(node, ()) if turn_of(write.client) is client), None)

    def waiting_of(self, transaction: Transaction) -> int:
        """Return how many like this one wait that are its client's: no client has another's room (R12)."""
        waiting = self.backlog.waiting_of(transaction.priority, transaction.client)
        if transaction.writes:
            client = turn_of(transaction.client)
            waiting = max(waiting, sum(turn_of(write.client) is client for write in self.queues[transaction.node]))
        return waiting

    def parked_of(self, node: NodeRecord, hold: Hold) -> Iterator[Transaction]:
        """Yield the writes of a sequence that are parked."""
        return (write for write in self.queues.get(node, ()) if write.client is hold and write.phase is PARKED)

    def park(self, write: Transaction) -> None:
        """Have the write wait behind an earlier write to its node, and lend that one its class."""
        write.phase = PARKED
        # The one that it waits for has been queued before it, so it is still there.
        first = self.first_of(write.node, turn_of(write.client))
        assert first is not None
        # They may not change places (R7), and the higher class is not to wait until the lower one has its turn.
        if first.priority > write.priority and first.phase is QUEUED:
            self.backlog.promote(first, write.priority)
        if write.stop and first.phase is QUEUED:
            self.backlog.let_pass(first)

    def forget_empty(self) -> None:
        """Keep no queue of a node to which nothing is written: it may be gone. One that is asked gets a new one."""
        for node in [node for node, waiting in self.queues.items() if not waiting]:
            del self.queues[node]

    def over(self, write: Transaction) -> None:
        """Note that the write has ended: the next one of its client to its node may go."""
        writes = self.queues[write.node]
        if writes and writes[0] is write:
            writes.popleft()
        elif write in writes:
            writes.remove(write)
        if writes:
            self.wake(write.node, turn_of(write.client))

    def wake(self, node: NodeRecord, client: LineClient) -> None:
        """Have the first write of a client to a node go next, if it is parked."""
        first = self.first_of(node, client)
        if first is not None and first.phase is PARKED:
            self.backlog.push_front(first)
