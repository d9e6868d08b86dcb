"""Whether a transaction may be sent now: the one place that knows (R6, R7, R11, R12).

It is asked when a request comes, when a poll is due, when a transaction is the next to go, and when a read may go
before it. Two things are decided elsewhere: whose turn it is and whether a sequence may begin, by `Backlog`; whether
its answer could be taken for one that is overdue, by `Choice`.
"""

from __future__ import annotations

import enum
from typing import NamedTuple

from busmaster.arbiter.backlog import Writes
from busmaster.arbiter.health import DOWN
from busmaster.arbiter.transaction import QUEUED, Transaction, make_error, name_error, too_late
from busmaster.errors import BusError, NodeDown, Refused

SUSPENDED = "suspended for maintenance"
PROBED = "down: it is probed, its polls wait"
RETURNING = "back, and its on_return hook is still running"
REFUSED_AGAIN = "refused again and again: polled every 10 s"
UNANSWERED = "down: no answer for a while"


class Eligible(enum.Enum):
    """A transaction that does not end: it may be sent, or may be later."""

    OK = "ok"
    IF_PAID = "if paid"
    """Its node is down: the budget of probes pays for it, or it ends."""
    WAITS = "waits"
    """It is queued, and an earlier write of its client to its node is not over (R7)."""


OK, IF_PAID, WAITS = Eligible


class Rejected(NamedTuple):
    """A transaction that ends, with this error."""

    error: BusError


def eligibility(
    transaction: Transaction, now: float, writes: Writes, fault: BusError | None = None
) -> Eligible | Rejected:
    """Return whether the transaction may be sent now. `fault`: why the line cannot be used. Nothing is changed."""
    node = transaction.node
    if fault is not None:
        return Rejected(name_error(fault, transaction))
    if transaction.start_by < now and (  # queued right now, it is in time: its caller's clock was read earlier
        transaction.finish_by <= now or (transaction.queued < now and not transaction.attempts)
    ):
        return Rejected(too_late(transaction, now))
    if transaction.writes and transaction.phase is QUEUED and not writes.is_first(transaction):
        return WAITS
    if now < node.suspended_until:
        return Rejected(make_error(NodeDown, SUSPENDED, transaction))
    if transaction.poll is not None:
        if node.health is DOWN:
            return Rejected(make_error(NodeDown, PROBED, transaction))
        if node.holds:
            return Rejected(make_error(NodeDown, RETURNING, transaction))
        if now < transaction.refused_until:
            return Rejected(make_error(Refused, REFUSED_AGAIN, transaction))
    elif node.health is DOWN and not (transaction.probe_cost or transaction.probe):
        return IF_PAID
    return OK


def unpaid(transaction: Transaction) -> Rejected:
    """Return how a transaction ends for which the budget of probes does not pay."""
    return Rejected(make_error(NodeDown, UNANSWERED, transaction))
