"""Which transaction goes next, and how each one ends (R6-R12).

The arbiter says when the line is free and what came of an attempt; the dispatcher never knows what is on the line.
It queues, orders the writes of a node, retries, confirms refusals, parks the polls of dead nodes, pays for probes,
and ends every transaction exactly once.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable
from itertools import count
from math import inf, nextafter
from typing import Any

from busmaster.arbiter import health
from busmaster.arbiter.backlog import Backlog
from busmaster.arbiter.counters import LineCounters
from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.events import Completed, Event, NodeChanged, Polled, Sampled
from busmaster.arbiter.health import DOWN, UNKNOWN, UP, Health, NodeRecord, ProbeBudget
from busmaster.arbiter.schedule import Poll, Schedule
from busmaster.arbiter.state import SETTLING
from busmaster.arbiter.transaction import BACKGROUND, ENDED, IDLE, ON_WIRE, PARKED, QUEUED, URGENT, Transaction
from busmaster.errors import (
    BacklogFull,
    BusError,
    GarbledReply,
    NodeDown,
    NoReply,
    NotStarted,
    Refused,
    Superseded,
    WriteUnconfirmed,
)

REFUSED_POLL_PAUSE = 10.0
"""Seconds between polls of a point that was refused again and again."""
RETRY_PATIENCE = 1.0
"""Seconds after which a request in POLL or BACKGROUND wants to be answered; the period, for a poll."""
EXPIRY_SLACK = 64
SUSPENDED = "suspended for maintenance"
TELLING = (Refused, Superseded, WriteUnconfirmed)
"""Errors that say themselves what may have become of a write that was on the wire."""


class Dispatcher:
    """The transactions of one line. Times are the caller's clock, in seconds."""

    def __init__(
        self, deadlines: Deadlines, counters: LineCounters, now: float, capacity: int, jitter: Callable[[], float]
    ) -> None:
        self.events: deque[Event] = deque()
        self.unnoted: deque[Transaction] = deque()
        """Those that have succeeded, until `note_successes`."""
        self.backlog = Backlog()
        self.schedule = Schedule()
        self.nodes: list[NodeRecord] = []
        self.counters = counters
        self.fault: Callable[[], BusError] | None = None
        """Makes the error with which everything fails while the line cannot be used."""
        self._deadlines = deadlines
        self._budget = ProbeBudget(now)
        self._capacity = capacity
        self._jitter = jitter
        self._expiries: list[tuple[float, int, Transaction]] = []
        self._order = count()
        self._probe: Transaction | None = None

    # requests

    def submit(self, transaction: Transaction, now: float) -> bool:
        """Queue it, or end it at once with the reason why not: then False."""
        node = transaction.node
        transaction.queued = now
        self._waits(transaction)
        if self.fault is not None:
            self._end(transaction, now, _named(self.fault(), transaction))
            return False
        if transaction.writes and transaction.priority is URGENT:
            self._supersede(node, now)
        waiting = self.backlog.waiting(transaction.priority)
        if transaction.writes:
            waiting = max(waiting, len(node.writes))
        if waiting >= self._capacity:
            self._end(transaction, now, _error(BacklogFull, f"{waiting} requests are waiting already", transaction))
            return False
        if not self._may_ask(transaction, now):
            return False
        if transaction.writes:
            node.writes.append(transaction)
        if transaction.deadline == inf:
            transaction.deadline = now + RETRY_PATIENCE
        if transaction.start_by < inf:
            self._expect_start(transaction)
        self.backlog.push(transaction)
        return True

    def cancel(self, transaction: Transaction, now: float) -> None:
        """Its caller has gone: never sent if still queued, unheard if on the wire (R6)."""
        if not transaction.heard or transaction.phase in (ENDED, IDLE):
            return
        transaction.heard = False
        self.counters.cancelled += 1
        if transaction.phase is QUEUED:
            self.backlog.discard(transaction, PARKED)
        if transaction.phase is PARKED:
            self._budget.refund(transaction.paid)
            self._end(transaction, now)

    def next(self, now: float) -> Transaction | None:
        """The transaction that may be sent now, or None."""
        while (transaction := self.backlog.pop()) is not None:
            node = transaction.node
            if transaction.start_by < now and transaction.queued < now and not transaction.attempts:
                self._end(transaction, now, _not_started(transaction, now))
            elif transaction.writes and node.writes[0] is not transaction:
                self._park(transaction)
            elif (node.health is not DOWN and not node.holds and node.suspended_until <= now) or self._may_ask(
                transaction, now
            ):
                return transaction
        return None

    def urgent_waits(self) -> bool:
        return self.backlog.waiting(URGENT) > 0

    def started(self, transaction: Transaction, now: float) -> None:
        """Its next attempt goes out now."""
        counters = self.counters
        if transaction.attempts == 0:
            counters.waits[transaction.priority].record(now - transaction.queued)
            self._count_ahead(transaction)
            poll = transaction.poll
            if poll is not None and poll.started == -inf:
                poll.started = now
                poll.jitter.record(now - poll.due)
        transaction.node.counters.attempts += 1
        transaction.phase = ON_WIRE
        transaction.attempts += 1
        transaction.started = now
        transaction.first_byte = -inf
        transaction.late = False

    # what came of an attempt

    def succeeded(self, transaction: Transaction, value: Any, now: float) -> None:
        """Noted at once where it bears on what goes next; else with the events, when the next request has left."""
        transaction.value = value
        transaction.last_byte = now
        self.unnoted.append(transaction)
        if transaction.writes or transaction.node.health is not UP:
            self.note_successes()

    def note_successes(self) -> None:
        while self.unnoted:
            transaction = self.unnoted.popleft()
            node, now = transaction.node, transaction.last_byte
            counters = node.counters
            counters.ok += 1
            counters.latency.record(now - transaction.started)
            if transaction.late:
                counters.late += 1
            node.last_reply = now
            if node.health is not UP:
                self._heard(node, now)
            if transaction.paid:
                self._budget.refund(transaction.paid - (now - transaction.started))
            transaction.refused_cycles = 0
            self._end(transaction, now)

    def attempt_failed(self, transaction: Transaction, no_reply: bool, what: str, now: float) -> None:
        node = transaction.node
        if no_reply:
            node.counters.no_reply += 1
        else:
            node.counters.garbled += 1
        if transaction.retried < transaction.retries and self._worth_a_retry(transaction) and self._wanted(transaction):
            transaction.retried += 1
            node.counters.retries += 1
            self._requeue(transaction, now)
            return
        before = node.health
        health.note_failure(node, now, self._jitter)
        self._report(node, before)
        kind: type[BusError] = NoReply if no_reply else GarbledReply
        if transaction.writes:
            kind = WriteUnconfirmed
        self._end(transaction, now, _error(kind, what, transaction))

    def refused(self, transaction: Transaction, refusal: Refused, now: float) -> None:
        """A NAK or EOT: asked once more where that can tell something new, then final (R7)."""
        node = transaction.node
        node.counters.refused += 1
        if refusal.confirm and not transaction.refusals and self._wanted(transaction):
            transaction.refusals += 1
            self._requeue(transaction, now)
            return
        node.last_reply = now
        if node.health is not UP:
            self._heard(node, now)
        transaction.refused_cycles += 1
        if transaction.refused_cycles > 1:
            transaction.refused_until = now + REFUSED_POLL_PAUSE
        self._end(transaction, now, _named(refusal, transaction))

    def unsendable(self, transaction: Transaction, bug: Exception, now: float) -> None:
        """Its protocol cannot encode it: a bug there, but nobody may wait for ever."""
        self._end(transaction, now, _error(BusError, f"its protocol could not encode it: {bug!r}", transaction))

    def cut_off(self, transaction: Transaction, error: BusError, now: float) -> None:
        """The line was lost under it: a write may have been carried out."""
        self._end(transaction, now, _named(error, transaction))

    # everything at once

    def fail_all(self, now: float) -> None:
        """End whatever waits, with the current fault."""
        fault = self.fault
        assert fault is not None
        for node in self.nodes:
            for write in [w for w in node.writes if w.phase is PARKED]:
                self._end(write, now, _named(fault(), write))
        for transaction in self.backlog.drain():
            transaction.phase = PARKED
            self._end(transaction, now, _named(fault(), transaction))

    def expire(self, now: float) -> None:
        """Fail what should have started by now (R12)."""
        heap = self._expiries
        while heap and (heap[0][0] < now or heap[0][2].phase is ENDED):
            transaction = heapq.heappop(heap)[2]
            if transaction.attempts:
                continue
            if transaction.phase is QUEUED:
                self.backlog.discard(transaction, PARKED)
            if transaction.phase is PARKED:
                self._end(transaction, now, _not_started(transaction, now))
        self._deadlines.expiry = nextafter(heap[0][0], inf) if heap else inf

    # polls

    def add_poll(self, poll: Poll, now: float) -> None:
        self.schedule.add(poll, now)
        self._deadlines.schedule = self.schedule.next_due()

    def remove_poll(self, poll: Poll, now: float) -> None:
        self.schedule.remove(poll)
        self._deadlines.schedule = self.schedule.next_due()
        for transaction in poll.results:
            self.cancel(transaction, now)

    def prepare_poll(self, poll: Poll, now: float) -> None:
        """Do its new `preparation`, a slice at a time."""
        self.schedule.prepare(poll, now)
        self._deadlines.schedule = self.schedule.next_due()

    def demand(self, poll: Poll, now: float) -> None:
        """Run one cycle now, off the grid. The running one serves, if there is one."""
        self.schedule.demand(poll)
        self.release_polls(now)

    def release_polls(self, now: float) -> None:
        """Start what is due, a bounded piece of it: the deadline has passed already while there is more."""
        for transaction in self.schedule.begin(now):
            self._waits(transaction)
            error = self._reason_to_park(transaction, now)
            if error is None:
                self.backlog.push(transaction)
            else:
                self._end(transaction, now, error)
        self._deadlines.schedule = self.schedule.next_due()

    def _reason_to_park(self, transaction: Transaction, now: float) -> BusError | None:
        node = transaction.node
        if self.fault is not None:
            return _named(self.fault(), transaction)
        if now < node.suspended_until:
            return _error(NodeDown, SUSPENDED, transaction)
        if node.health is DOWN:
            return _error(NodeDown, "down: it is probed, its polls wait", transaction)
        if node.holds:
            return _error(NodeDown, "back, and its on_return hook is still running", transaction)
        if now < transaction.refused_until:
            return _error(Refused, "refused again and again: polled every 10 s", transaction)
        return None

    # dead nodes

    def idle(self, seconds: float) -> None:
        """The line had nothing to do for so long: a part of it may be spent on probes."""
        self._budget.idle(seconds)

    def suspend(self, node: NodeRecord, until: float) -> None:
        node.suspended_until = until
        self.plan_probes()

    def release_node(self, node: NodeRecord) -> None:
        """Its hook has run: its polls resume with their next cycle, unless it has died and come back meanwhile."""
        node.holds = max(0, node.holds - 1)

    def plan_probes(self) -> None:
        """Set the deadline of the next probe. One probe at a time is out."""
        if self._probe is not None:
            self._deadlines.health = inf
            return
        down = [node for node in self.nodes if node.health is DOWN]
        self._budget.probe = max((node.lateness for node in down), default=0.0)
        self._deadlines.health = min((max(node.probe_at, node.suspended_until) for node in down), default=inf)

    def probe(self, now: float) -> None:
        """Ask the dead node whose turn it is, if the budget allows."""
        ready = [n for n in self.nodes if n.health is DOWN and max(n.probe_at, n.suspended_until) <= now]
        if self._probe is not None or not ready or self.fault is not None:
            self._deadlines.health = inf if self._probe is not None else now + health.LONGEST_BUDGET_WAIT
            if not ready:
                self.plan_probes()
            return
        node = min(ready, key=lambda n: n.probe_at)
        cost = node.lateness
        if not self._budget.take(cost, now):
            self._deadlines.health = now + self._budget.wait_for(cost, now)
            return
        probe = Transaction(node, node.profile.probe, priority=BACKGROUND, retries=0, probe=True)
        probe.paid = cost
        probe.queued = now
        self._waits(probe)
        probe.deadline = now + RETRY_PATIENCE
        node.counters.probes += 1
        self._probe = probe
        self._deadlines.health = inf
        self.backlog.push(probe)

    def _may_ask(self, transaction: Transaction, now: float) -> bool:
        """Whether a node that is down, back or suspended is worth this request's line time; if not, it is ended."""
        node = transaction.node
        error: BusError | None = None
        if transaction.poll is not None:
            error = self._reason_to_park(transaction, now)
        elif now < node.suspended_until:
            error = _error(NodeDown, SUSPENDED, transaction)
        elif node.health is DOWN and not (transaction.paid or transaction.probe):
            if self._budget.take(node.lateness, now):
                transaction.paid = node.lateness
                transaction.retries = 0
            else:
                error = _error(NodeDown, "down: no answer for a while", transaction)
        if error is not None:
            self._end(transaction, now, error)
        return error is None

    def _heard(self, node: NodeRecord, now: float) -> None:
        before = node.health
        flaps = health.flaps(node, now)
        health.note_success(node, now)
        if before is DOWN and not flaps:
            self._budget.node_returned(now)
            for other in self.nodes:
                if other.health is DOWN:
                    other.probe_at = min(other.probe_at, now)
        self._report(node, before)

    def _report(self, node: NodeRecord, before: Health) -> None:
        if node.health is not before:
            returning = before is DOWN and node.has_hook
            node.holds += returning
            self.events.append(NodeChanged(node, before, node.health, returning))
        self.plan_probes()

    # the ways of one transaction

    def _worth_a_retry(self, transaction: Transaction) -> bool:
        """Not while its node fails; nor may the polls of nodes that were never heard hold up the start of a line."""
        node = transaction.node
        if node.health is UNKNOWN:
            return transaction.poll is None
        return not node.failures and node.health is not DOWN

    def _wanted(self, transaction: Transaction) -> bool:
        return transaction.heard and not transaction.superseded and self.fault is None

    def _requeue(self, transaction: Transaction, now: float) -> None:
        """At the back of its class; a poll's key becomes failure time + period (R7)."""
        poll = transaction.poll
        transaction.deadline = now + (poll.patience if poll is not None else RETRY_PATIENCE)
        self.backlog.push(transaction)

    def _park(self, write: Transaction) -> None:
        """An earlier write to its node is not over: it waits, and lends that one its class (R7)."""
        write.phase = PARKED
        first = write.node.writes[0]
        if first.priority > write.priority and first.phase is QUEUED:
            self.backlog.promote(first, write.priority)

    def _supersede(self, node: NodeRecord, now: float) -> None:
        """An urgent write overtakes: what it overtakes is never sent after it, nor if it cannot be sent itself (R7)."""
        for write in list(node.writes):
            if write.phase is ON_WIRE:
                write.superseded = True
            elif write.priority > URGENT:
                if write.phase is QUEUED:
                    self.backlog.discard(write, PARKED)
                self._end(write, now, _error(Superseded, "overtaken by an urgent write to the same node", write))

    def _expect_start(self, transaction: Transaction) -> None:
        heap = self._expiries
        if len(heap) > 2 * len(self.backlog) + EXPIRY_SLACK:
            self._expiries = heap = [entry for entry in heap if entry[2].phase is not ENDED]
            heapq.heapify(heap)
        heapq.heappush(heap, (transaction.start_by, next(self._order), transaction))
        self._deadlines.expiry = nextafter(heap[0][0], inf)

    def _end(self, transaction: Transaction, now: float, error: BusError | None = None) -> None:
        """Exactly once (R8). A write that was on the wire before something else ended it may have been carried out."""
        if transaction.writes:
            if transaction.attempts and error is not None and not isinstance(error, TELLING):
                error = _error(WriteUnconfirmed, f"it was sent and not answered, then: {error.what}", transaction)
            self._next_write(transaction)
        if not transaction.attempts:
            self._count_ahead(transaction)
        transaction.phase = ENDED
        transaction.ended_at = now
        transaction.error = error
        if error is not None:
            transaction.node.counters.failed += 1
        if transaction is self._probe:
            self._probe = None
            self.plan_probes()
        if not transaction.heard:
            transaction.node.counters.unheard += transaction.attempts > 0
        poll = transaction.poll
        if poll is not None:
            if poll.waiter is not None and poll.active:
                self.events.append(Sampled(poll, transaction))
            poll.remaining -= 1
            if not poll.remaining and poll.active:
                poll.finished = now
                self.events.append(Polled(poll))
        elif transaction.heard:
            self.counters.completed += 1
            self.events.append(Completed(transaction))

    def _waits(self, transaction: Transaction) -> None:
        """What the line has counted so far is not what it waits for."""
        transaction.exchanges_ahead = self.counters.exchanges
        transaction.settling_ahead = self.counters.spent[SETTLING]

    def _count_ahead(self, transaction: Transaction) -> None:
        """It has waited: until now it held what `_waits` noted."""
        transaction.exchanges_ahead = self.counters.exchanges - transaction.exchanges_ahead
        transaction.settling_ahead = self.counters.spent[SETTLING] - transaction.settling_ahead

    def _next_write(self, transaction: Transaction) -> None:
        writes = transaction.node.writes
        if writes and writes[0] is transaction:
            writes.popleft()
            if writes and writes[0].phase is PARKED:
                self.backlog.push_front(writes[0])
        elif transaction in writes:
            writes.remove(transaction)


def _error(kind: type[BusError], what: str, transaction: Transaction) -> BusError:
    return _named(kind(what), transaction)


def _named(error: BusError, transaction: Transaction) -> BusError:
    """Say which node, which command and how often."""
    error.node = transaction.node.label
    error.command = str(transaction.command)
    error.attempts = transaction.attempts
    return error


def _not_started(transaction: Transaction, now: float) -> BusError:
    waited = (now - transaction.queued) * 1000
    return _error(NotStarted, f"not sent within its time: it waited {waited:.0f} ms for the line", transaction)
