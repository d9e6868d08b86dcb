"""Decides whether a transaction may be sent now (R6, R7, R11, R12). No other place decides this for a caller's request.

A rule that rejects or delays requests is one condition here. docs/adding-a-rule.md shows how to add one.

It is called when a request arrives, when a poll is due, when a transaction is next, and when a read may go before it.
Two decisions are made elsewhere: whose turn it is and whether a sequence may begin (`Backlog`), and whether the reply
could be mistaken for an overdue one (`Choice`). Sync reads have no caller, and are sent without this decision.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from math import inf
from typing import NamedTuple, TypeAlias

from busmaster.arbiter.backlog import Writes
from busmaster.arbiter.health import DOWN
from busmaster.arbiter.transaction import QUEUED, Transaction, make_error, name_error, too_late
from busmaster.errors import BusError, NodeDown, Refused

SUSPENDED = "suspended for maintenance"
PROBED = "not responding: polling suspended, retrying in the background"
RETURNING = "back, and its on_return hook is still running"
REFUSED_AGAIN = "refused repeatedly: polled every 10 s"
UNANSWERED = "not responding: the request was not sent, retrying in the background"


class Eligible(enum.Enum):
    """A transaction that may be sent now."""

    OK = "ok"
    IF_PAID = "if paid"
    """Its node is DOWN: it is sent if the probe budget pays for it, else it fails."""


OK, IF_PAID = Eligible


class Wait(NamedTuple):
    """A transaction that is evaluated again at this time, in seconds. Until then it is in no class queue."""

    until: float


BEHIND_WRITE = Wait(inf)
"""An earlier write of its client to its node is unfinished (R7). Its end ends the wait."""


class Rejected(NamedTuple):
    """A transaction that fails with this error."""

    error: BusError


Eligibility: TypeAlias = Eligible | Wait | Rejected


def eligibility(
    transaction: Transaction, now: float, writes: Writes, fault: Callable[[], BusError] | None = None
) -> Eligibility:
    """Return whether the transaction may be sent now. Changes nothing. `fault` returns why the line is unusable."""
    node = transaction.node
    if fault is not None:
        return Rejected(name_error(fault(), transaction))
    # `start_by` limits only the first attempt: a retry belongs to a request that was sent in time.
    if transaction.start_by < now and (  # a request queued now is in time: its caller read the clock earlier
        transaction.finish_by <= now or (transaction.queued < now and not transaction.attempts)
    ):
        return Rejected(too_late(transaction, now))
    if transaction.writes and transaction.phase is QUEUED and not writes.is_first(transaction):
        return BEHIND_WRITE
    if now < node.suspended_until:
        return Rejected(make_error(NodeDown, SUSPENDED, transaction))
    if transaction.poll is not None:
        # Each request to a dead node costs its maximum reply delay. A poll is not worth that, once per period.
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
    """Return the result for a transaction that the probe budget does not pay for."""
    return Rejected(make_error(NodeDown, UNANSWERED, transaction))
