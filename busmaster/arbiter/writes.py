"""The writes to each node, in order: none overtakes another of the same program, retries included (R7)."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator

from busmaster.arbiter.backlog import Backlog
from busmaster.arbiter.clients import Hold, LineClient, turn_of
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.transaction import PARKED, QUEUED, Transaction


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
        first = self.first_of(write.node, turn_of(write.client))
        assert first is not None
        # They may not change places (R7), and the higher class is not to wait until the lower one has its turn.
        if first.priority > write.priority and first.phase is QUEUED:
            self.backlog.promote(first, write.priority)

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
