"""The queues of one line: four strict classes, with one slot in eight for the lower ones (R9).

A class is ordered by arrival or by deadline. The writes to each node are ordered too: none overtakes another of the
same program, retries included (R7).
"""

from __future__ import annotations

import heapq
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from itertools import count, islice
from math import inf
from typing import Protocol, TypeAlias

from busmaster.arbiter.clients import Hold, LineClient, turn_of
from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.transaction import BACKGROUND, PARKED, POLL, QUEUED, Phase, Priority, Transaction

SLACK = 64
"""Entries of ended transactions that a queue may hold in addition to as many live ones."""
LOOKED_AT = 8
"""Queued transactions of a class that are examined for one that can go before the first (R15)."""


class Queue(Protocol):
    """Queued transactions, in the order in which they are to be sent. Ended ones are skipped."""

    live: int
    """Number of queued transactions."""

    def push(self, transaction: Transaction, /) -> None: ...
    def push_front(self, transaction: Transaction, /) -> None: ...
    def pop(self) -> Transaction: ...
    def pick(self, suits: Callable[[Transaction], bool], /) -> Transaction | None: ...
    def discard(self, transaction: Transaction, /) -> None: ...
    def remove(self, transaction: Transaction, /) -> None: ...
    def entries(self) -> Iterator[Transaction]: ...
    def __iter__(self) -> Iterator[Transaction]: ...


class Fifo:
    """First in, first out. Ended transactions are skipped, and removed in bulk."""

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
        """Remove and return the first transaction. Raises IndexError if there is none."""
        while True:
            transaction = self._entries.popleft()
            if transaction.phase is QUEUED:
                self.live -= 1
                return transaction

    def pick(self, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Remove and return the first suitable one among the first LOOKED_AT, or None."""
        passed: list[Transaction] = []
        found = None
        # Only the first few: with hundreds of equal polls queued, a full search at every exchange would be too slow.
        while self.live > len(passed) and len(passed) < LOOKED_AT and found is None:
            transaction = self._entries.popleft()
            if transaction.phase is not QUEUED:
                continue
            if suits(transaction):
                found = transaction
                self.live -= 1
            else:
                passed.append(transaction)
        # Back in front, in the same order: a request that was only examined keeps its place.
        self._entries.extendleft(reversed(passed))
        return found

    def discard(self, transaction: Transaction) -> None:
        """Release the place of a transaction that has left the queue. The entry is removed later."""
        # A cancelled caller must be free at once, however long the queue is, so the entry is removed later in bulk.
        # Without that, callers that always cancel would fill the memory.
        self.live -= 1
        if len(self._entries) > 2 * self.live + SLACK:
            self._entries = deque(self)

    def remove(self, transaction: Transaction) -> None:
        """Remove this transaction immediately, wherever it is in the queue."""
        self._entries.remove(transaction)
        self.live -= 1

    def entries(self) -> Iterator[Transaction]:
        """Return all entries, including ended ones, in any order."""
        return iter(self._entries)

    def __iter__(self) -> Iterator[Transaction]:
        return (t for t in self._entries if t.phase is QUEUED)


class EarliestDeadlineFirst:
    """Ordered by `Transaction.deadline`, then by arrival."""

    __slots__ = ("_entries", "_order", "live")

    def __init__(self) -> None:
        self._entries: list[tuple[float, int, Transaction]] = []
        self._order = count()
        self.live = 0

    def push(self, transaction: Transaction) -> None:
        """Add a transaction at its deadline, behind those with the same deadline."""
        heapq.heappush(self._entries, (transaction.deadline, next(self._order), transaction))
        self.live += 1

    def push_front(self, transaction: Transaction) -> None:
        """Add a transaction before all others, and give it the deadline of the first."""
        # First whatever its deadline, or a write would be sent after a write that it preceded. The negative number puts
        # it before equal deadlines, and the last one put back before the others.
        transaction.deadline = self._entries[0][0] if self._entries else transaction.deadline
        heapq.heappush(self._entries, (transaction.deadline, -next(self._order), transaction))
        self.live += 1

    def pick(self, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Remove and return the first suitable one among the first LOOKED_AT, or None."""
        # Unsuitable ones are put back with their old key, so they keep their place among equals.
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
        """Remove and return the transaction with the earliest deadline. Raises IndexError if there is none."""
        while True:
            transaction = heapq.heappop(self._entries)[2]
            if transaction.phase is QUEUED:
                self.live -= 1
                return transaction

    def discard(self, transaction: Transaction) -> None:
        """Release the place of a transaction that has left the queue. The entry is removed later."""
        self.live -= 1
        # Removed in bulk: removing each cancelled request from the middle of the heap would cost a search each time.
        if len(self._entries) > 2 * self.live + SLACK:
            self._entries = [entry for entry in self._entries if entry[2].phase is QUEUED]
            heapq.heapify(self._entries)

    def remove(self, transaction: Transaction) -> None:
        """Remove this transaction immediately, wherever it is in the queue."""
        self._entries = [entry for entry in self._entries if entry[2] is not transaction]
        heapq.heapify(self._entries)
        self.live -= 1

    def entries(self) -> Iterator[Transaction]:
        """Return all entries, including ended ones, in any order."""
        return (transaction for _, _, transaction in self._entries)

    def __iter__(self) -> Iterator[Transaction]:
        return (t for _, _, t in sorted(self._entries, key=lambda e: e[:2]) if t.phase is QUEUED)


SHARE = 7
"""Consecutive exchanges of higher classes after which a waiting lower class gets one slot."""
SEARCHED = 256
"""Entries of a class that are searched for a read that can replace a sync read (R15)."""
Queues: TypeAlias = tuple[Queue, Queue, Queue, Queue]


class Backlog:
    """The queued transactions of all classes. Each has the phase QUEUED."""

    __slots__ = ("_rotated", "_rotated_before", "_streak", "_streak_before", "_urgent_yields", "queues")

    def __init__(self) -> None:
        self.queues: Queues = new_queues()
        self._urgent_yields = False
        """True if a lower class goes before URGENT, which then holds only requests of other programs."""
        self._streak = 0
        self._rotated = BACKGROUND
        self._streak_before, self._rotated_before = 0, BACKGROUND

    def __len__(self) -> int:
        urgent, command, poll, background = self.queues
        return urgent.live + command.live + poll.live + background.live

    def waiting(self, priority: Priority) -> int:
        """Return the number of queued transactions of this class."""
        return self.queues[priority].live

    def waiting_of(self, priority: Priority, client: LineClient | None) -> int:
        """Return the number of queued transactions of this class and client."""
        return self.queues[priority].live

    def push(self, transaction: Transaction) -> None:
        """Append a transaction to its class (by deadline in POLL and BACKGROUND)."""
        transaction.phase = QUEUED
        self.queues[transaction.priority].push(transaction)

    def push_front(self, transaction: Transaction) -> None:
        """Put a transaction at the front of its class, for example a write that waited for an earlier write."""
        transaction.phase = QUEUED
        self.queues[transaction.priority].push_front(transaction)

    def discard(self, transaction: Transaction, phase: Phase) -> None:
        """Remove a queued transaction and set its phase."""
        transaction.phase = phase
        self.queues[transaction.priority].discard(transaction)

    def restore(self, transaction: Transaction) -> None:
        """Put back the transaction that was popped last. It is popped next, and its class keeps its turn."""
        self._streak, self._rotated = self._streak_before, self._rotated_before
        self.push_front(transaction)

    def keep_turn(self, transaction: Transaction) -> None:
        """Note that the transaction popped last is not sent. Used if clients take turns: its client keeps its turn."""

    def pick(self, priority: Priority, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Remove and return the first suitable one among the first of a class, or None. The others keep their
        places."""
        return self.queues[priority].pick(suits)

    def take(self, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Remove and return a suitable transaction of any class, or None. For a request that must be sent now."""
        for queue in self.queues:
            # Bounded: with ten thousand requests waiting, an unbounded search would take longer than an exchange.
            # In any order and not the first by deadline: the read only has to prove that replies match, and is due
            # anyway.
            found = next((t for t in islice(queue.entries(), SEARCHED) if t.phase is QUEUED and suits(t)), None)
            if found is not None:
                queue.remove(found)
                return found
        return None

    def promote(self, transaction: Transaction, priority: Priority) -> None:
        """Move a transaction to the front of a higher class, because a write of that class must not overtake it."""
        # Removed immediately: it stays QUEUED, so an entry left behind would be served a second time.
        self.queues[transaction.priority].remove(transaction)
        transaction.priority = priority
        self.push_front(transaction)

    def let_pass(self, transaction: Transaction) -> None:
        """Send a transaction although its sequence may not begin: a stop is queued behind it."""

    def pop(self, now: float) -> Transaction | None:
        """Remove and return the next transaction at the time `now`, or None.

        URGENT always goes first. Below it, a waiting lower class gets every eighth slot.
        """
        urgent, command, poll, background = self.queues
        # `restore` needs them: a transaction that R15 holds back has not used a slot.
        self._streak_before = self._streak
        self._rotated_before = self._rotated
        if urgent.live and not self._urgent_yields:
            # Not counted as a slot of a higher class: a stop must not wait for fairness. R9's bounds for the lower
            # classes therefore hold only below sustained urgent traffic.
            return urgent.pop()
        if command.live:
            if not poll.live and not background.live:
                self._streak = 0  # no lower class was waiting, so none is due a slot
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
        """Remove and return the next of POLL and BACKGROUND, which alternate if both have requests."""
        self._streak = 0
        _, _, poll, background = self.queues
        if poll.live and (self._rotated is BACKGROUND or not background.live):
            self._rotated = POLL
            return poll.pop()
        self._rotated = BACKGROUND
        return background.pop()

    def drain(self) -> list[Transaction]:
        """Remove and return all transactions, in order of class."""
        drained = [transaction for queue in self.queues for transaction in queue]
        self.queues = new_queues()
        return drained


def new_queues() -> Queues:
    """Return an empty queue for each class."""
    return Fifo(), Fifo(), EarliestDeadlineFirst(), EarliestDeadlineFirst()


class Delayed:
    """The transactions of one line that may not be sent before a time of their own. Each has the phase PARKED.

    A write also stays in its node's queue of writes, so that no later write overtakes it.
    """

    __slots__ = ("_deadlines", "_heap", "_most", "_order", "_places", "live")

    def __init__(self, deadlines: Deadlines) -> None:
        self._deadlines = deadlines
        self._heap: list[tuple[float, int, Transaction]] = []
        self._most = SLACK
        """Number of entries at which those that have ended are removed."""
        self._order = count()
        self._places: dict[Transaction, int] = {}
        """The latest entry of each. The end of another write may release a delayed write, which is then added again."""
        self.live = 0
        """Number of entries, including those that have ended in the meantime."""

    def add(self, transaction: Transaction, until: float) -> None:
        """Set a transaction aside until this time, in seconds."""
        transaction.phase = PARKED
        if self.live >= self._most:
            # In bulk: at each addition, 900 waiting requests would block the line for 50 ms.
            self._keep([entry for entry in self._heap if self._is_delayed(entry)])
        self._places[transaction] = place = next(self._order)
        heapq.heappush(self._heap, (until, place, transaction))
        self._changed()

    def due(self, now: float) -> list[Transaction]:
        """Remove and return the transactions that may be sent now, in order. Those that have ended are left out."""
        due: list[Transaction] = []
        while self._heap and self._heap[0][0] <= now:
            entry = heapq.heappop(self._heap)
            if self._is_delayed(entry):
                due.append(entry[2])
            if self._places.get(entry[2]) == entry[1]:
                del self._places[entry[2]]
        self._changed()
        return due

    def waiting_of(self, priority: Priority, client: LineClient | None) -> int:
        """Return the number of delayed transactions of this class and client."""
        who = turn_of(client)
        return sum(t.priority is priority and turn_of(t.client) is who for t in self._places if t.phase is PARKED)

    def of(self, hold: Hold) -> list[Transaction]:
        """Return the delayed transactions of a sequence."""
        return [delayed for delayed in self._places if delayed.client is hold and delayed.phase is PARKED]

    def drain(self) -> list[Transaction]:
        """Remove and return all transactions, of which the writes are in a queue of writes too."""
        left = [delayed for delayed in self._places if delayed.phase is PARKED]
        self._keep([])
        return left

    def _is_delayed(self, entry: tuple[float, int, Transaction]) -> bool:
        return entry[2].phase is PARKED and self._places.get(entry[2]) == entry[1]

    def _keep(self, entries: list[tuple[float, int, Transaction]]) -> None:
        heapq.heapify(entries)
        self._heap = entries
        self._places = {transaction: place for _, place, transaction in entries}
        self._changed()
        self._most = 2 * self.live + SLACK

    def _changed(self) -> None:
        self.live = len(self._heap)
        self._deadlines.delayed = self._heap[0][0] if self._heap else inf


class Writes:
    """The writes of one line. `queues`: the unfinished writes of each node. Those behind the first of a client are
    parked.

    A sequence that holds the line counts as a client of its own.
    """

    def __init__(self, backlog: Backlog) -> None:
        self.queues: defaultdict[NodeRecord, deque[Transaction]] = defaultdict(deque)
        self.backlog = backlog

    def is_first(self, write: Transaction) -> bool:
        """Return True if no earlier write of its client to its node is unfinished."""
        # The cheap comparison first: usually one program writes to a node.
        return self.queues[write.node][0] is write or self.first_of(write.node, turn_of(write.client)) is write

    def first_of(self, node: NodeRecord, client: LineClient) -> Transaction | None:
        """Return the first write of a client to a node, or None."""
        return next((write for write in self.queues.get(node, ()) if turn_of(write.client) is client), None)

    def waiting_of(self, transaction: Transaction) -> int:
        """Return how many queued transactions count against the same limit. Each client has its own limit (R12)."""
        waiting = self.backlog.waiting_of(transaction.priority, transaction.client)
        if transaction.writes:
            client = turn_of(transaction.client)
            # Parked writes are in no class queue. Without this sum, a program could queue any number of writes to one
            # node.
            waiting = max(waiting, sum(turn_of(write.client) is client for write in self.queues[transaction.node]))
        return waiting

    def parked_of(self, node: NodeRecord, hold: Hold) -> Iterator[Transaction]:
        """Yield the parked writes of a sequence."""
        return (write for write in self.queues.get(node, ()) if write.client is hold and write.phase is PARKED)

    def park(self, write: Transaction) -> None:
        """Park a write behind an earlier write to its node, and raise that one to its class."""
        write.phase = PARKED
        # the earlier write was queued before, so it is still there
        # Per client and not per node: a program must not be able to block another program's writes with its own.
        first = self.first_of(write.node, turn_of(write.client))
        assert first is not None
        # R7: they must keep their order, and the write of the higher class must not wait for a turn of the lower class.
        if first.priority > write.priority:
            if first.phase is QUEUED:
                self.backlog.promote(first, write.priority)
            elif first.phase is PARKED:  # it is delayed, and in no class queue
                first.priority = write.priority
        if write.stop and first.phase is QUEUED:
            self.backlog.let_pass(first)

    def forget_empty(self) -> None:
        """Remove empty queues, which may belong to removed nodes. A node gets a new one with its next write."""
        # A list: the dictionary must not change while it is iterated.
        for node in [node for node, waiting in self.queues.items() if not waiting]:
            del self.queues[node]

    def ended(self, write: Transaction) -> None:
        """Handle the end of a write: the next write of its client to its node may be sent."""
        # The write that has ended is nearly always the first one. A superseded or cancelled write can be anywhere.
        writes = self.queues[write.node]
        if writes and writes[0] is write:
            writes.popleft()
        elif write in writes:
            writes.remove(write)
        if writes:
            self.wake(write.node, turn_of(write.client))

    def wake(self, node: NodeRecord, client: LineClient) -> None:
        """Queue the first write of a client to a node, if it is parked."""
        first = self.first_of(node, client)
        if first is not None and first.phase is PARKED:
            self.backlog.push_front(first)
