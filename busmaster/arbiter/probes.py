"""When a dead node is asked whether it is back (R11)."""

from __future__ import annotations

from math import inf

from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.health import DOWN, LONGEST_BUDGET_WAIT, NodeRecord, ProbeBudget
from busmaster.arbiter.transaction import BACKGROUND, Transaction

IDLE_PROBE_EVERY = 0.8
"""Seconds between two probes of a node on a line that has nothing else to do, and line time saved up."""
IDLE_TOKENS = 0.4
"""Line time, in seconds, that must be saved up for that: what a busy line spares for probes is not spent so."""


class Probes:
    """The probes of one line: one at a time, each paid from the budget. Sets the deadline of the next."""

    def __init__(self, deadlines: Deadlines, nodes: list[NodeRecord], now: float) -> None:
        self.budget = ProbeBudget(now)
        self.nodes = nodes
        self._deadlines = deadlines
        self._running: Transaction | None = None

    def plan(self) -> None:
        """Set the deadline of the next probe."""
        if self._running is not None:
            self._deadlines.health = inf
            return
        down = [node for node in self.nodes if node.health is DOWN]
        self.budget.probe = max((node.lateness for node in down), default=0.0)
        self._deadlines.health = min((max(_earliest(node), node.suspended_until) for node in down), default=inf)

    def next(self, now: float, usable: bool, idle: bool) -> Transaction | None:
        """The probe of the node whose turn it is, if the line is `usable` and the budget allows.

        On an `idle` line with line time saved up, a node is asked before its doubling delay is over.
        """
        early = idle and self.budget.tokens >= IDLE_TOKENS
        ready = [n for n in self.nodes if n.health is DOWN and max(_due(n, early), n.suspended_until) <= now]
        if self._running is not None or not ready or not usable:
            self._put_off(ready, now, idle)
            return None
        node = min(ready, key=lambda n: _due(n, early))
        cost = node.lateness
        if not self.budget.take(cost, now):
            self._deadlines.health = now + self.budget.wait_for(cost, now)
            return None
        probe = Transaction(node, node.profile.probe, priority=BACKGROUND, retries=0, probe=True)
        probe.paid = cost
        probe.queued = now
        node.probed_at = now
        node.counters.probes += 1
        self._running = probe
        self._deadlines.health = inf
        return probe

    def over(self, probe: Transaction) -> None:
        """This transaction has ended; it may have been the probe that was out."""
        if probe is self._running:
            self._running = None
            self.plan()

    def _put_off(self, ready: list[NodeRecord], now: float, idle: bool) -> None:
        if self._running is not None:
            self._deadlines.health = inf
        elif ready:
            self._deadlines.health = now + LONGEST_BUDGET_WAIT
        else:
            self.plan()
            if self._deadlines.health <= now:  # early, but the line is busy, or nothing is saved up
                down = [node for node in self.nodes if node.health is DOWN]
                later = min(max(node.probe_at, node.suspended_until) for node in down)
                self._deadlines.health = min(later, now + (IDLE_PROBE_EVERY if idle else LONGEST_BUDGET_WAIT))


def _earliest(node: NodeRecord) -> float:
    """When it may be probed at the earliest."""
    return min(node.probe_at, node.probed_at + IDLE_PROBE_EVERY)


def _due(node: NodeRecord, early: bool) -> float:
    return _earliest(node) if early else node.probe_at
