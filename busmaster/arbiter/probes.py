"""Probes of dead nodes, and the effect of each attempt on its node's health and maximum reply delay (R3, R11)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import inf

from busmaster.arbiter import health
from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.events import Event, MaxReplyDelayLowered, NodeChanged
from busmaster.arbiter.health import DOWN, UNKNOWN, Health, NodeRecord, ProbeBudget
from busmaster.arbiter.transaction import BACKGROUND, Transaction

IDLE_PROBE_EVERY = 0.8
"""Seconds between two free probes: on a line with nothing else to do they delay no request."""


class Probes:
    """The probes of one line: one at a time, each paid from the budget. Sets the deadline of the next."""

    def __init__(self, deadlines: Deadlines, nodes: list[NodeRecord], now: float) -> None:
        self.budget = ProbeBudget(now)
        self.nodes = nodes
        self._deadlines = deadlines
        self._running: Transaction | None = None
        self._free_at = -inf
        """When the next probe is free, if the line has nothing else to do."""

    def plan(self) -> None:
        """Set the deadline of the next probe."""
        if self._running is not None:
            self._deadlines.health = inf
            return
        down = self._down()
        # A probe of a dead node is expected to fail. A failed attempt costs the maximum reply delay and not the window.
        self.budget.probe = max((node.max_reply_delay for node in down), default=0.0)
        due = min(map(_due, down), default=inf)
        # Also if nothing is due: whether the line is idle then is checked when the deadline expires.
        free = min((max(self._free_at, node.suspended_until) for node in down), default=inf)
        self._deadlines.health = min(due, free)

    def next(self, now: float, usable: bool, idle: bool) -> Transaction | None:
        """Return the next probe, if the line is `usable` and the probe is paid or free, else None."""
        down = [node for node in self.nodes if node.health is DOWN and node.suspended_until <= now]
        if self._running is not None or not down or not usable:
            self._put_off(now)
            return None
        # The due node that has waited longest, so that no node is skipped when the budget is short.
        node = min(down, key=lambda node: (node.probe_at > now, node.probed_at))
        cost = node.max_reply_delay
        if self._is_free(node, now, idle):
            self._free_at = now + IDLE_PROBE_EVERY
            cost = 0.0
        elif node.probe_at > now:
            self._put_off(now)
            return None
        elif not self.budget.take(cost, now):
            due = now + self.budget.wait_for(cost, now)
            self._deadlines.health = min(due, self._free_at) if self._free_at > now else due
            return None
        return self._probe(node, cost, now)

    def spare(self, cost: float, now: float) -> bool:
        """Pay for a caller's request to a dead node, if the budget also holds the due probe. Returns True if paid."""
        # The due probe keeps its share. Otherwise a caller that keeps sending requests to a dead node would use the
        # whole budget, and the return of the other dead nodes would not be noticed.
        due = max((n.max_reply_delay for n in self.nodes if n.health is DOWN and n.probe_at <= now), default=0.0)
        return self.budget.take(cost, now, due)

    def alive(self, node: NodeRecord, now: float) -> None:
        """Note that a dead node has transmitted. Its next probe will be answered, so the cost is refunded."""
        node.probe_at = min(node.probe_at, now)
        # The refund is the cost of a probe without a reply.
        self.budget.refund(node.max_reply_delay)
        self.plan()

    def ended(self, probe: Transaction) -> None:
        """Note that a transaction has ended. It may have been the running probe."""
        # Identity and not equality: a caller may have sent the same command to the same node.
        if probe is self._running:
            self._running = None
            self.plan()

    def _is_free(self, node: NodeRecord, now: float, idle: bool) -> bool:
        """Return True if the line is idle and no poll is due during the probe, or if all nodes are DOWN."""
        if not idle or now < self._free_at:
            return False
        return now + node.max_reply_delay < self._deadlines.schedule or all(
            other.health is DOWN for other in self.nodes
        )

    def _probe(self, node: NodeRecord, cost: float, now: float) -> Transaction:
        probe = Transaction(node, node.profile.probe, priority=BACKGROUND, retries=0, probe=True)
        # Refunded, less the time it took, if the node replies.
        probe.probe_cost = cost
        probe.queued = now
        node.counters.probes += 1
        self._running = probe
        self._deadlines.health = inf
        return probe

    def _put_off(self, now: float) -> None:
        """Set the deadline to the next due probe. A free one may have to wait until the line is idle."""
        self.plan()
        # Never a time in the past: the owner would call again immediately without any change.
        if self._deadlines.health <= now:
            due = min((due for due in map(_due, self._down()) if due > now), default=inf)
            self._deadlines.health = min(due, now + IDLE_PROBE_EVERY)

    def _down(self) -> list[NodeRecord]:
        return [node for node in self.nodes if node.health is DOWN]


def _due(node: NodeRecord) -> float:
    """Return when the paid probe of this dead node is due."""
    return max(node.probe_at, node.suspended_until)


class NodeWatch:
    """Reports changes of health in `events`, and plans the probes of dead nodes, for one line."""

    def __init__(
        self, nodes: list[NodeRecord], probes: Probes, events: deque[Event], jitter: Callable[[], float]
    ) -> None:
        self._nodes = nodes
        self._probes = probes
        self._events = events
        self._jitter = jitter

    def failed(self, node: NodeRecord, now: float) -> None:
        """Handle a transaction that failed without a reply of its node."""
        before = node.health
        health.note_failure(node, now, self._jitter)
        self._report(node, before)

    def heard(self, node: NodeRecord, now: float) -> None:
        """Handle a reply of a node that was not UP."""
        before = node.health
        flaps = health.flaps(node, now)
        health.note_success(node, now)
        new, node.budgeted = node.budgeted, False
        # A reply of a new node proves nothing about the others. Otherwise a client that keeps naming one would have the
        # budget filled faster forever.
        if before is DOWN and not (flaps or new):
            # The others may be back too. A flapping node proves nothing about them.
            self._probes.budget.node_returned(now)
            for other in self._nodes:
                if other.health is DOWN:
                    other.probe_at = min(other.probe_at, now)
        self._report(node, before)

    def is_worth_a_retry(self, transaction: Transaction) -> bool:
        """Return False while the node fails, or for a poll of a node that never replied, which must not delay
        start-up."""
        node = transaction.node
        if node.health is UNKNOWN:
            return transaction.poll is None
        return not node.failures and node.health is not DOWN

    def lower_max_reply_delay(self, transaction: Transaction, now: float) -> None:
        """Restore a node's maximum reply delay after an hour of prompt replies."""
        node = transaction.node
        if transaction.late:
            node.max_reply_delay_until = now + health.CALM_MAX_REPLY_DELAY
        elif now > node.max_reply_delay_until:
            node.restore_max_reply_delay()
            self._events.append(MaxReplyDelayLowered(node, node.max_reply_delay))

    def _report(self, node: NodeRecord, before: Health) -> None:
        if node.health is not before:
            returning = before is DOWN and node.has_hook
            # The polls wait for the hook: it may write the parameters that the polled values depend on.
            node.holds += returning
            self._events.append(NodeChanged(node, before, node.health, returning))
        self._probes.plan()
