"""What each attempt says of its node: its health, its lateness, and what follows of them (R3, R11)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from busmaster.arbiter import health
from busmaster.arbiter.events import Event, LatenessLowered, NodeChanged
from busmaster.arbiter.health import DOWN, UNKNOWN, Health, NodeRecord
from busmaster.arbiter.probes import Probes
from busmaster.arbiter.transaction import Transaction


class NodeWatch:
    """Of one line: it tells changes by `events`, and has `probes` see to those that are dead."""

    def __init__(
        self, nodes: list[NodeRecord], probes: Probes, events: deque[Event], jitter: Callable[[], float]
    ) -> None:
        self._nodes = nodes
        self._probes = probes
        self._events = events
        self._jitter = jitter

    def failed(self, node: NodeRecord, now: float) -> None:
        """Note that a transaction failed for want of its node's answer."""
        before = node.health
        health.note_failure(node, now, self._jitter)
        self._report(node, before)

    def heard(self, node: NodeRecord, now: float) -> None:
        """Note an answer of a node that was not known to be well."""
        before = node.health
        flaps = health.flaps(node, now)
        health.note_success(node, now)
        new, node.budgeted = node.budgeted, False
        # That a new node replies says nothing of the others: else a client that names one again and again would have
        # the budget filled faster for ever.
        if before is DOWN and not (flaps or new):
            # the others may be back too; a flapping node tells nothing about them
            self._probes.budget.node_returned(now)
            for other in self._nodes:
                if other.health is DOWN:
                    other.probe_at = min(other.probe_at, now)
        self._report(node, before)

    def is_worth_a_retry(self, transaction: Transaction) -> bool:
        """Return False while the node fails, or for a poll of one never heard, which may not hold up a line's start."""
        node = transaction.node
        if node.health is UNKNOWN:
            return transaction.poll is None
        return not node.failures and node.health is not DOWN

    def lower_lateness(self, transaction: Transaction, now: float) -> None:
        """Put a node's lateness back to what it was, when an hour of prompt replies has passed since it was raised."""
        node = transaction.node
        if transaction.late:
            node.lateness_until = now + health.CALM_LATENESS
        elif now > node.lateness_until:
            node.restore_lateness()
            self._events.append(LatenessLowered(node, node.lateness))

    def _report(self, node: NodeRecord, before: Health) -> None:
        if node.health is not before:
            returning = before is DOWN and node.has_hook
            node.holds += returning
            self._events.append(NodeChanged(node, before, node.health, returning))
        self._probes.plan()
