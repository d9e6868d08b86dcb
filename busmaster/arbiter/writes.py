"""The writes to each node, in order: none overtakes another, retries included (R7)."""

from __future__ import annotations

from collections import defaultdict, deque

from busmaster.arbiter.backlog import Backlog
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.transaction import PARKED, QUEUED, Transaction


class Writes:
    """Of one line. `queues` holds each node's writes that are not over; those behind the first are parked."""

    def __init__(self, backlog: Backlog) -> None:
        self.queues: defaultdict[NodeRecord, deque[Transaction]] = defaultdict(deque)
        self._backlog = backlog

    def is_first(self, write: Transaction) -> bool:
        """Return whether no earlier write to its node is under way."""
        return self.queues[write.node][0] is write

    def park(self, write: Transaction) -> None:
        """Have the write wait behind an earlier write to its node, and lend that one its class."""
        write.phase = PARKED
        first = self.queues[write.node][0]
        # They may not change places (R7), and the higher class is not to wait until the lower one has its turn.
        if first.priority > write.priority and first.phase is QUEUED:
            self._backlog.promote(first, write.priority)

    def forget_empty(self) -> None:
        """Keep no queue of a node to which nothing is written: it may be gone. One that is asked gets a new one."""
        for node in [node for node, waiting in self.queues.items() if not waiting]:
            del self.queues[node]

    def over(self, write: Transaction) -> None:
        """Note that the write has ended: the next one of its node may go."""
        writes = self.queues[write.node]
        if writes and writes[0] is write:
            writes.popleft()
            if writes and writes[0].phase is PARKED:
                self._backlog.push_front(writes[0])
        elif write in writes:
            writes.remove(write)
