"""What waited when the line could no longer be used: all of it fails, a bounded piece at a time.

It is taken out at once, so that none of it is sent any more, whatever becomes of the line meanwhile. But a thousand
callers told in one callback would hold up the loop that owns the line, and perhaps others: what is left over is due at
once, so that the owner calls again when it has seen to its other ports.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from math import inf

from busmaster.arbiter.backlog import Backlog
from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.endings import make_error
from busmaster.arbiter.transaction import FAILING, ON_WIRE, PARKED, Transaction
from busmaster.errors import BusError

AT_ONCE = 32
"""Transactions that fail in one call."""


class FailingTransactions:
    """The transactions of one line that are to fail. Each gets the fault for which it was added, however late."""

    __slots__ = ("_deadlines", "_left")

    def __init__(self, deadlines: Deadlines) -> None:
        self._deadlines = deadlines
        self._left: deque[tuple[Transaction, BusError]] = deque()

    def __len__(self) -> int:
        return len(self._left)

    def add(self, transactions: Iterable[Transaction], fault: BusError) -> None:
        """Have `next` hand these transactions out with `fault`, behind those that are there."""
        for transaction in transactions:
            transaction.phase = FAILING
            self._left.append((transaction, fault))

    def next(self, now: float) -> Iterator[tuple[Transaction, BusError]]:
        """Hand out at most AT_ONCE transactions, each with an error of its own, and set the deadline of the others.

        A transaction that has ended meanwhile, since its caller has gone, is left out.
        """
        left = self._left
        piece = [left.popleft() for _ in range(min(AT_ONCE, len(left)))]
        self._deadlines.failing = now if left else inf
        for transaction, fault in piece:
            if transaction.phase is FAILING:
                yield transaction, make_error(type(fault), fault.what, transaction)


def take_out(queues: Iterable[deque[Transaction]], backlog: Backlog) -> list[Transaction]:
    """Empty the backlog and each node's queue of writes, except for what is on the wire. Returns what was taken out."""
    taken: list[Transaction] = []
    for writes in queues:
        if writes:
            taken += (write for write in writes if write.phase is PARKED)
            on_wire = [write for write in writes if write.phase is ON_WIRE]
            writes.clear()
            writes += on_wire
    return taken + backlog.drain()
