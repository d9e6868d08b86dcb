"""When a dead node is asked whether it is back (R11)."""

from __future__ import annotations

from math import inf

from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.health import DOWN, NodeRecord, ProbeBudget
from busmaster.arbiter.transaction import BACKGROUND, Transaction

IDLE_PROBE_EVERY = 0.8
"""Seconds between two probes that are not paid for: on a line that has nothing else to do they delay nobody."""


class Probes:
    """The probes of one line: one at a time, each paid from the budget. Sets the deadline of the next."""

    def __init__(self, deadlines: Deadlines, nodes: list[NodeRecord], now: float) -> None:
        self.budget = ProbeBudget(now)
        self.nodes = nodes
        self._deadlines = deadlines
        self._running: Transaction | None = None
        self._free_at = -inf
        """When the next probe need not be paid for, if the line has nothing else to do."""

    def plan(self) -> None:
        """Set the deadline of the next probe."""
        if self._running is not None:
            self._deadlines.health = inf
            return
        down = self._down()
        # A probe of a dead node is expected to fail, and a failed attempt costs the lateness: that, not the window, is
        # what it takes of the line.
        self.budget.probe = max((node.lateness for node in down), default=0.0)
        due = min(map(_due, down), default=inf)
        free = min((max(self._free_at, node.suspended_until) for node in down), default=inf)
        self._deadlines.health = min(due, free)

    def next(self, now: float, usable: bool, idle: bool) -> Transaction | None:
        """Return the probe of the node in turn, if the line is `usable`, and the budget allows it or it is free."""
        down = [node for node in self.nodes if node.health is DOWN and node.suspended_until <= now]
        if self._running is not None or not down or not usable:
            self._put_off(now)
            return None
        # Of those that are due the one that has waited longest, so that none is forgotten when the budget is short.
        node = min(down, key=lambda node: (node.probe_at > now, node.probed_at))
        cost = node.lateness
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
        """Pay for a caller's request to a dead node, if the budget holds that beside the probe that is due. Returns
        whether it did."""
        # The probe that is due keeps its share: else a caller that asks a dead node again and again would spend all
        # there is, and the other dead ones would never be found to be back.
        due = max((n.lateness for n in self.nodes if n.health is DOWN and n.probe_at <= now), default=0.0)
        return self.budget.take(cost, now, due)

    def alive(self, node: NodeRecord, now: float) -> None:
        """Note that a dead node was heard: it will answer its probe, which therefore costs nothing."""
        node.probe_at = min(node.probe_at, now)
        self.budget.refund(node.lateness)
        self.plan()

    def over(self, probe: Transaction) -> None:
        """Note that this transaction has ended; it may have been the probe that was out."""
        if probe is self._running:
            self._running = None
            self.plan()

    def _is_free(self, node: NodeRecord, now: float, idle: bool) -> bool:
        """Return whether nobody waits, nothing is due before the probe is over, or nobody lives whom it could delay."""
        if not idle or now < self._free_at:
            return False
        return now + node.lateness < self._deadlines.schedule or all(other.health is DOWN for other in self.nodes)

    def _probe(self, node: NodeRecord, cost: float, now: float) -> Transaction:
        probe = Transaction(node, node.profile.probe, priority=BACKGROUND, retries=0, probe=True)
        probe.probe_cost = cost
        probe.queued = now
        node.counters.probes += 1
        self._running = probe
        self._deadlines.health = inf
        return probe

    def _put_off(self, now: float) -> None:
        """Look again when the next probe is due; a free one may have to wait for the line to be idle."""
        self.plan()
        # Never a time that is past: the owner would call again at once, and find the same.
        if self._deadlines.health <= now:
            due = min((due for due in map(_due, self._down()) if due > now), default=inf)
            self._deadlines.health = min(due, now + IDLE_PROBE_EVERY)

    def _down(self) -> list[NodeRecord]:
        return [node for node in self.nodes if node.health is DOWN]


def _due(node: NodeRecord) -> float:
    """Return when this dead node's probe is due, if it must be paid for."""
    return max(node.probe_at, node.suspended_until)
