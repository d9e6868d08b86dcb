"""Selects the next transaction and ends each transaction (R6 to R12).

The arbiter reports when the line is free and how an attempt ended. The dispatcher does not know the bytes on the wire.
It queues requests, keeps the writes of a node in order, retries, and confirms refusals. It parks the polls of dead
nodes, charges probes to their budget, and ends each transaction exactly once.

If the line becomes unusable, all queued transactions are removed at once, so that none of them can be sent later. Their
callers are notified in batches: a thousand callers in one callback would block the event loop, which may also serve
other lines. The next batch is due immediately, after the loop has served its other ports.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import count
from math import inf
from typing import Any

from busmaster.arbiter.backlog import Backlog, Delayed, Writes
from busmaster.arbiter.clients import Hold
from busmaster.arbiter.counters import BATCH, RESYNCHRONISING, LineCounters
from busmaster.arbiter.deadlines import Deadlines, Expiries
from busmaster.arbiter.eligibility import IF_PAID, OK, Eligibility, Rejected, Wait, eligibility, unpaid
from busmaster.arbiter.events import Event, Overdue, Polled, Sampled
from busmaster.arbiter.health import DOWN, UP, NodeRecord
from busmaster.arbiter.probes import NodeWatch, Probes
from busmaster.arbiter.schedule import Schedule
from busmaster.arbiter.shared_backlog import SharedBacklog
from busmaster.arbiter.transaction import (
    BACKGROUND,
    ENDED,
    FAILING,
    IDLE,
    LEFT,
    ON_WIRE,
    PARKED,
    QUEUED,
    URGENT,
    Poll,
    Priority,
    Transaction,
    hold_ended,
    make_error,
    name_error,
    too_late,
)
from busmaster.arbiter.trust import SPOILING
from busmaster.contract.exchange import Command, FrameError
from busmaster.contract.tap import Attempt, Verdict
from busmaster.errors import (
    BacklogFull,
    BusError,
    GarbledReply,
    NoReply,
    Refused,
    Superseded,
    WriteUnconfirmed,
)

AT_ONCE = 32
"""Transactions that fail in one call."""


class FailingTransactions:
    """Transactions of one line that are about to fail. Each keeps the error for which it was added."""

    __slots__ = ("_deadlines", "_left")

    def __init__(self, deadlines: Deadlines) -> None:
        self._deadlines = deadlines
        self._left: deque[tuple[Transaction, BusError]] = deque()

    def __len__(self) -> int:
        return len(self._left)

    def add(self, transactions: Iterable[Transaction], fault: BusError) -> None:
        """Append transactions that `next` will return with `fault`."""
        for transaction in transactions:
            transaction.phase = FAILING
            self._left.append((transaction, fault))

    def next(self, now: float) -> Iterator[tuple[Transaction, BusError]]:
        """Yield at most AT_ONCE transactions, each with its own error, and set the deadline for the rest.

        A transaction that has ended in the meantime, for example because it was cancelled, is skipped.
        """
        left = self._left
        piece = [left.popleft() for _ in range(min(AT_ONCE, len(left)))]
        self._deadlines.failing = now if left else inf
        for transaction, fault in piece:
            if transaction.phase is FAILING:
                yield transaction, make_error(type(fault), fault.what, transaction)


def take_out(queues: Iterable[deque[Transaction]], backlog: Backlog) -> list[Transaction]:
    """Empty the backlog and each node's write queue, except for writes on the wire. Returns the removed
    transactions."""
    taken: list[Transaction] = []
    for writes in queues:
        if writes:
            taken += (write for write in writes if write.phase is PARKED)
            # The arbiter ends it itself, as cut off: it may have been carried out.
            on_wire = [write for write in writes if write.phase is ON_WIRE]
            writes.clear()
            writes += on_wire
    return taken + backlog.drain()


REFUSED_POLL_PAUSE = 10.0
"""Seconds between polls of a point that was refused again and again."""
RETRY_PATIENCE = 1.0
"""Seconds from queueing to the deadline of a request in POLL or BACKGROUND. A poll uses its period."""
NOT_DONE = (Refused, Superseded)
"""Errors that mean that a write was not carried out, unless an earlier attempt may have been."""


class Tapped:
    """Reports each attempt to the tap. An attempt that is already on the wire when the tap starts is not reported."""

    def __init__(self, events: deque[Event], counters: LineCounters) -> None:
        self.attempt: Attempt | None = None
        """The attempt on the wire."""
        self._events = events
        self._counters = counters
        self._order_of_transactions = count(1)
        self._numbers: dict[Transaction, int] = {}

    def started(self, transaction: Transaction) -> None:
        """Start an attempt with the number of its transaction."""
        if transaction.attempts == 1 or transaction not in self._numbers:
            # A poll's transaction is used again in each cycle, with a new number each time.
            self._numbers[transaction] = next(self._order_of_transactions)
        node = transaction.node
        self.attempt = Attempt(
            node.profile.name,
            node.address,
            transaction.command,
            node.timings,
            transaction=self._numbers[transaction],
            number=transaction.attempts,
            purpose=_purpose(transaction),
            quiet_time=self._counters.spent[RESYNCHRONISING],
        )

    def ended(self, transaction: Transaction, verdict: Verdict, result: Any, now: float) -> None:
        """Report the result of the attempt."""
        attempt, self.attempt = self.attempt, None
        if attempt is None:  # it was on the wire before the tap was opened
            return
        attempt.late = transaction.late
        attempt.heard = transaction.wanted or transaction.check
        attempt.end(verdict, result, now)
        self._events.append(attempt)

    def forget(self, transaction: Transaction) -> None:
        """Release the number of a transaction that has ended."""
        self._numbers.pop(transaction, None)


def _verdict(no_reply: bool, what: str, ambiguous: bool) -> Verdict:
    if ambiguous:
        return Verdict.AMBIGUOUS
    if no_reply:
        return Verdict.NO_REPLY
    return Verdict.SPOILT if what in SPOILING else Verdict.GARBLED


def _purpose(transaction: Transaction) -> str:
    if transaction.check:
        return "check"
    if transaction.probe:
        return "probe"
    return "" if transaction.poll is None else f"poll {transaction.poll.name}".rstrip()


class Dispatcher:
    """The transactions of one line. Times are the caller's clock, in seconds."""

    def __init__(
        self, deadlines: Deadlines, counters: LineCounters, now: float, capacity: int, jitter: Callable[[], float]
    ) -> None:
        self.events: deque[Event] = deque()
        self.unnoted: Transaction | None = None
        """The successful transaction that `note_success` has not ended yet."""
        self.backlog: Backlog = Backlog()
        self.schedule = Schedule()
        self.nodes: list[NodeRecord] = []
        self.writes = Writes(self.backlog)
        self.delayed = Delayed(deadlines)
        self.counters = counters
        self.fault: Callable[[], BusError] | None = None
        """Returns the error for all requests while the line is unusable; None while it is usable."""
        self.is_held: Callable[[], bool] = lambda: False
        """Returns True if the port had not sent the whole request when it was last queried."""
        self._deadlines = deadlines
        self.probes = Probes(deadlines, self.nodes, now)
        self._capacity = capacity
        self._watch = NodeWatch(self.nodes, self.probes, self.events, jitter)
        self._expiries = Expiries(deadlines)
        self.failing = FailingTransactions(deadlines)
        self.tapped: Tapped | None = None
        """None if the line is not tapped: the check then costs one comparison."""

    # requests

    def submit(self, transaction: Transaction, now: float) -> bool:
        """Queue a transaction, or end it immediately with an error. Returns False if it was queued and nothing else
        changed."""
        node, counters = transaction.node, self.counters
        transaction.queued = now
        transaction.deadline = now + RETRY_PATIENCE
        # same as `_store_counts`, written out: this runs for every request
        transaction.exchanges_ahead = counters.exchanges
        transaction.quiet_time_ahead = counters.spent[RESYNCHRONISING]
        # Checked again for each request and not only at the loss: requests keep arriving while the line is down.
        if self.fault is not None:
            self._admitted(transaction, now)
            return True
        changed = transaction.writes  # it may have superseded other writes, whose callers must be notified
        queue = self.backlog.queues[transaction.priority]
        # Even if this write fails below: a `disable()` must never be followed by the `enable()` that it overtook (R7).
        if changed and transaction.priority is URGENT:
            self._supersede(node, "overtaken by an urgent write to the same node", now, above=URGENT)
        # Parked writes are in no class queue, so the node's queue is counted as well.
        waiting = max(queue.live, len(self.writes.queues[node])) if changed else queue.live
        waiting += self.delayed.live
        if waiting >= self._capacity and (waiting := self._waiting_of(transaction)) >= self._capacity:
            self._end(transaction, now, make_error(BacklogFull, f"{waiting} requests are waiting already", transaction))
            return True
        if node.health is DOWN or now < node.suspended_until:
            if self._admitted(transaction, now) is None:
                return True
            if node.budgeted and transaction.client is not None and not isinstance(transaction.client, Hold):
                # All requests to such nodes share one small part of the line, whichever client names them (1/128, R9).
                transaction.client = self.share().new_nodes()
        # After the capacity check, so that a rejected write never blocks the writes behind it.
        if changed:
            self.writes.queues[node].append(transaction)
        if transaction.start_by < inf:
            self._expiries.expect(transaction, len(self.backlog))
            changed = True
        transaction.phase = QUEUED  # same as `backlog.push`, written out: this runs for every request
        queue.push(transaction)
        return changed

    def cancel(self, transaction: Transaction, now: float) -> None:
        """Handle a cancelled caller: a queued transaction is not sent; the reply to one on the wire is ignored (R6)."""
        if not transaction.wanted or transaction.phase in (ENDED, IDLE):
            return
        # A request on the wire runs until its reply or its deadline. Cancelling saves no line time (R6).
        transaction.wanted = False
        self.counters.cancelled += 1
        self._unqueue(transaction)
        if transaction.phase is not ON_WIRE:
            self._release_stops(transaction)
            # It was paid when it was queued, and was not sent.
            self.probes.budget.refund(transaction.probe_cost)
            self._end(transaction, now)

    def next(self, now: float) -> Transaction | None:
        """Remove and return the transaction to send now, or None."""
        while (transaction := self.backlog.pop(now)) is not None:
            verdict = eligibility(transaction, now, self.writes, self.fault)
            if verdict is OK or (acted := self._act_on(verdict, transaction, now)) is OK:
                return transaction
            if isinstance(acted, Wait):
                self._set_aside(transaction, acted)
            self.backlog.keep_turn(transaction)
        return None

    def urgent_waits(self) -> bool:
        """Return True if an URGENT request is queued."""
        return self.backlog.waiting(URGENT) > 0

    def _set_aside(self, transaction: Transaction, verdict: Wait) -> None:
        """Take a transaction that must wait out of its class queue."""
        if verdict.until < inf:
            self.delayed.add(transaction, verdict.until)
        else:
            self.writes.park(transaction)

    def _unqueue(self, transaction: Transaction) -> None:
        """Take a transaction that is queued out of its class. One that is set aside already is in no class."""
        if transaction.phase is QUEUED:
            self.backlog.discard(transaction, PARKED)

    def _waiting_of(self, transaction: Transaction) -> int:
        """Return how many requests count against the limit of a new one: those of its client in its class."""
        return self.writes.waiting_of(transaction) + self.delayed.waiting_of(transaction.priority, transaction.client)

    def eligibility(self, transaction: Transaction, now: float) -> Eligibility:
        """Return whether a transaction may be sent now. Changes nothing."""
        return eligibility(transaction, now, self.writes, self.fault)

    def proves(self, read: Transaction, now: float) -> bool:
        """Return True if a queued read can replace a sync read: it may be sent, and its node is not DOWN."""
        return read.node.health is not DOWN and self.eligibility(read, now) is OK

    def _admitted(self, transaction: Transaction, now: float) -> Eligibility | None:
        """Return OK or when it may be sent, or end the transaction and return None. A request to a dead node is charged
        to the probe budget."""
        return self._act_on(self.eligibility(transaction, now), transaction, now)

    def _act_on(self, verdict: Eligibility, transaction: Transaction, now: float) -> Eligibility | None:
        if verdict is IF_PAID:
            cost = transaction.node.max_reply_delay
            if self.probes.spare(cost, now):
                transaction.probe_cost = cost
                # The budget has paid for one attempt. A dead node does not reply to the second one either.
                transaction.retries = 0
                verdict = self.eligibility(transaction, now)
            else:
                verdict = unpaid(transaction)
        if isinstance(verdict, Rejected):
            self._end(transaction, now, verdict.error)
            return None
        return verdict

    def started(self, transaction: Transaction, now: float) -> None:
        """Record that the next attempt of a transaction is sent now."""
        counters = self.counters
        # Only the first attempt counts as a wait: a retry waits because of the line and not because of its class.
        if transaction.attempts:
            transaction.first_byte = -inf
        elif not transaction.check:
            waits = counters.waits[transaction.priority]
            times = waits.new  # same as `record`, written out: this runs for every request
            times.append(now - transaction.queued)
            if len(times) >= BATCH:
                waits.sort_in()
            transaction.exchanges_ahead = counters.exchanges - transaction.exchanges_ahead
            transaction.quiet_time_ahead = counters.spent[RESYNCHRONISING] - transaction.quiet_time_ahead
            poll = transaction.poll
            if poll is not None and poll.started == -inf:
                poll.started = now
                poll.jitter.record(now - poll.due)
            if transaction.stop:
                self._take_stops(transaction, now)
        transaction.phase = ON_WIRE
        transaction.attempts += 1
        transaction.started = now
        transaction.late = transaction.overdue = False  # a flag of an earlier attempt does not apply to the new reply
        if self.tapped is not None:
            self.tapped.started(transaction)

    def _take_stops(self, stop: Transaction, now: float) -> None:
        """Give equal stops that are queued for the same node the outcome of the stop that is sent now (R9).

        Stops behind a write that is not a stop are excluded: if they were sent only once, that write would overtake
        them.
        """
        alike: list[Transaction] = []
        for write in self.writes.queues[stop.node]:
            if write is stop or write.phase is ON_WIRE:
                continue
            if not write.stop:
                break
            # An attempt of its own may have been carried out: such a stop ends with its own outcome.
            if write.attempts or type(write.command) is not type(stop.command) or write.command != stop.command:
                continue
            if write.priority is not stop.priority or isinstance(write.client, Hold):
                continue
            self._unqueue(write)
            write.phase = ON_WIRE  # not sent itself; ends together with this one
            write.attempts, write.started = 1, now
            alike.append(write)
        stop.stops_alike = tuple(alike)

    def _release_stops(self, stop: Transaction) -> None:
        """Queue the equal stops again, because the stop whose outcome they wait for is not sent again."""
        alike, stop.stops_alike = stop.stops_alike, ()
        for other in alike:
            if other.phase is ON_WIRE:
                # Its first attempt was the shared one, whose outcome is not known.
                other.unsure = True
                self.backlog.push(other)

    # what came of an attempt

    def succeeded(self, transaction: Transaction, value: Any, now: float) -> None:
        """Record a success. Parts that do not affect the next request are deferred until that request has left."""
        if self.tapped is not None:
            self.tapped.ended(transaction, Verdict.OK, value, now)
        # Set if the owner has not fetched its events since the last success.
        if self.unnoted is not None:
            self.note_success()
        transaction.value = value
        transaction.last_byte = now
        self.unnoted = transaction
        # affects the next request: the node's next write may go, or its polls resume
        if transaction.writes or transaction.node.health is not UP:
            self.note_success()

    def note_success(self) -> None:
        """End the successful transaction that was deferred by `succeeded`, if any."""
        transaction = self.unnoted
        if transaction is None:
            return
        self.unnoted = None
        node, now = transaction.node, transaction.last_byte
        counters = node.counters
        times = counters.latency.new  # same as `record`, written out
        times.append(now - transaction.started)
        if len(times) >= BATCH:
            counters.latency.sort_in()
        if transaction.late:
            counters.late += 1
            counters.overdue += transaction.overdue
        node.last_reply = now
        if node.health is not UP:
            self._watch.heard(node, now)
        if node.max_reply_delay_until < inf:
            self._watch.lower_max_reply_delay(transaction, now)
        if transaction.probe_cost:
            # A reply costs far less than the maximum reply delay that was paid in advance.
            self.probes.budget.refund(transaction.probe_cost - (now - transaction.started))
        transaction.refused_cycles = 0
        self._end(transaction, now)

    def attempt_failed(
        self, transaction: Transaction, no_reply: bool, failure: FrameError, now: float, ambiguous: bool
    ) -> None:
        """Retry or fail a transaction. An `ambiguous` reply does not change the node's health (R15)."""
        if self.tapped is not None:
            self.tapped.ended(transaction, _verdict(no_reply, failure.what, ambiguous), failure.what, now)
        node = transaction.node
        transaction.unsure = True
        if no_reply:
            node.counters.no_reply += 1
        else:
            node.counters.garbled += 1
        # An ambiguous reply is not a failure of the node, so the attempt is repeated even if the node is SUSPECT.
        worth = ambiguous or self._watch.is_worth_a_retry(transaction)
        if transaction.retried < transaction.retries and worth and self.is_wanted(transaction):
            # At the back of its class: a node that loses frames must not delay the other nodes with its retries.
            transaction.retried += 1
            node.counters.retries += 1
            self._requeue(transaction, now)
            return
        # The node may not support the item of a sync read, so a failed sync read is not a failure of the node.
        if not (ambiguous or transaction.check):
            self._watch.failed(node, now)
        kind: type[BusError] = NoReply if no_reply else GarbledReply
        if transaction.writes:
            # for a write, the hint of WriteUnconfirmed replaces that of the failure
            kind, failure.hint = WriteUnconfirmed, None
        self._end(transaction, now, make_error(kind, failure.what, transaction, failure.hint))

    def broken(self, transaction: Transaction, bug: Exception, now: float) -> None:
        """Fail a transaction because the protocol's reader raised an exception. It is not retried: the bug would
        recur."""
        if self.tapped is not None:
            self.tapped.ended(transaction, Verdict.GARBLED, f"a bug in the protocol's reader: {bug!r}", now)
        what = f"a bug in the {transaction.node.profile.name} reader: {bug!r}"
        # Not a failure of the node: the bug would be the same for a healthy one.
        transaction.node.counters.garbled += 1
        kind = WriteUnconfirmed if transaction.writes else BusError
        error = make_error(kind, what, transaction)
        error.hint = "this is not the line's fault: please report it, with a capture"
        error.__cause__ = bug
        self._end(transaction, now, error)

    def refused(self, transaction: Transaction, refusal: Refused, certain: bool, now: float) -> None:
        """Handle a NAK or EOT: repeat the request once if that can give new information, else raise Refused (R7).

        If the refusal is not `certain`, it may belong to an earlier request (R15): a read is repeated once, and a write
        may have been carried out.
        """
        if self.tapped is not None:
            self.tapped.ended(transaction, Verdict.REFUSED, refusal.what, now)
        node = transaction.node
        node.counters.refused += 1
        transaction.unsure = transaction.unsure or not certain
        again = refusal.confirm if certain else not transaction.writes or transaction.idempotent
        # Not a probe: a refusal is a reply, which is all that a probe needs. Not for a caller that has gone (R6).
        if again and not transaction.refusals and not transaction.probe and self.is_wanted(transaction):
            transaction.refusals += 1
            self._requeue(transaction, now)
            return
        # An uncertain NAK must not disable a sync read: the node may support it.
        if certain and not transaction.writes and (transaction.refusals or not refusal.confirm):
            node.note_refused(transaction.command)
        node.last_reply = now  # R11: a refusal is a reply too
        if node.health is not UP:
            self._watch.heard(node, now)
        # One refusal may be noise that looks like a NAK. Two in a row mean that the node does not have the point.
        transaction.refused_cycles += 1
        if transaction.refused_cycles > 1:
            transaction.refused_until = now + REFUSED_POLL_PAUSE
        self._end(transaction, now, name_error(refusal, transaction))

    def unsendable(self, transaction: Transaction, bug: Exception, now: float) -> None:
        """Fail a transaction that its protocol cannot encode. This is a bug in the protocol, but the caller must not
        wait forever."""
        self._end(transaction, now, make_error(BusError, f"its protocol could not encode it: {bug!r}", transaction))

    def cut_off(self, transaction: Transaction, error: BusError, now: float) -> None:
        """Fail the transaction on the wire after the port was lost. A write may have been carried out."""
        if self.tapped is not None:
            self.tapped.ended(transaction, Verdict.CUT_OFF, error.what, now)
        transaction.node.counters.cut_off += 1
        self._end(transaction, now, name_error(error, transaction))

    # clients

    def share(self) -> SharedBacklog:
        """Return the backlog in which clients take turns. Converts the backlog on the first call."""
        # On demand: a line that only its owner uses keeps the simple queues, which cost less per request.
        backlog = self.backlog
        if not isinstance(backlog, SharedBacklog):
            self.backlog = self.writes.backlog = backlog = SharedBacklog(backlog, self.writes, self._deadlines)
        return backlog

    def end_hold(self, now: float, hold: Hold | None = None) -> None:
        """End a sequence, by default the one that holds the line. Its queued requests fail with HoldEnded."""
        backlog = self.share()
        hold = hold or backlog.hold
        if hold is not None:
            # Failed and not sent without the hold: other requests would come between the halves of the sequence.
            for transaction in [*backlog.end_hold(hold, now), *self.delayed.of(hold)]:
                self._end(transaction, now, hold_ended(transaction, hold))
            self.writes.wake(hold.node, hold.client)

    # everything at once

    def supersede_writes(self, now: float) -> None:
        """Fail every queued write of every class with Superseded."""
        for node in self.nodes:
            self._supersede(node, LEFT, now)

    def fail_all(self, now: float) -> None:
        """Remove all queued transactions and fail them with the current fault: one batch now, the others in
        `fail_more`."""
        assert self.fault is not None
        waiting = take_out(self.writes.queues.values(), self.backlog) + self.delayed.drain()
        self.failing.add(waiting, self.fault())
        self.fail_more(now)

    def handle_timeout(self, now: float, unread: bool) -> None:
        """Run expired timers except the line timer. While input is `unread`, no request expires."""
        deadlines = self._deadlines
        if now >= deadlines.failing:
            self.fail_more(now)
        if now >= deadlines.schedule:
            self.release_polls(now)
        # The unread bytes may be the reply that the caller waits for.
        if now >= deadlines.expiry and not unread:
            self.expire(now)
        if now >= deadlines.hold:
            self.end_hold(now)
        if now >= deadlines.delayed:
            for transaction in reversed(self.delayed.due(now)):  # each goes to the front
                self.backlog.push_front(transaction)
        if now >= deadlines.sequence:
            deadlines.sequence = inf  # if the line is free, it calls the backlog next

    def fail_more(self, now: float) -> None:
        """End one batch of the removed transactions. Its deadline has already passed while more are left."""
        for transaction, error in self.failing.next(now):
            self._end(transaction, now, error)

    def expire(self, now: float) -> None:
        """Fail callers whose time has passed (R12): with NotStarted if nothing was sent, else with an unknown outcome.

        An exchange on the wire continues, and its reply is ignored, as after a cancellation.
        """
        self.note_success()
        # The success first: a reply that has arrived in time must not be reported as too late.
        for transaction in self._expiries.due(now):
            if not transaction.wanted or (transaction.attempts and transaction.finish_by >= now):
                continue  # The caller was cancelled, or the request was sent in time: then only `finish_by` ends it.
            if transaction.phase is FAILING:
                continue  # it ends next, with the error of the line
            if transaction.phase is ON_WIRE:
                transaction.wanted = False
                self.counters.cancelled += 1
                # The caller is notified now, while the exchange keeps the line: the reply that may come must not reach
                # the next request.
                self.events.append(Overdue(transaction, too_late(transaction, now, held=self.is_held())))
                continue
            self._unqueue(transaction)
            self._end(transaction, now, too_late(transaction, now, held=self.is_held()))

    # polls

    def add_poll(self, poll: Poll, now: float) -> None:
        """Start a poll."""
        self.schedule.add(poll, now)
        self._deadlines.schedule = self.schedule.next_due()

    def remove_poll(self, poll: Poll, now: float) -> None:
        """Remove a poll. Its queued requests are discarded; the reply of one on the wire is ignored."""
        self.schedule.remove(poll)
        self._deadlines.schedule = self.schedule.next_due()
        for transaction in poll.results:
            self.cancel(transaction, now)

    def prepare_poll(self, poll: Poll, now: float) -> None:
        """Run the new `preparation` of a poll, one slice at a time."""
        self.schedule.prepare(poll, now)
        self._deadlines.schedule = self.schedule.next_due()

    def demand(self, poll: Poll, now: float) -> None:
        """Run one cycle of a poll now, outside its grid. If a cycle is running, that one is used."""
        self.schedule.demand(poll)
        self.release_polls(now)

    def release_polls(self, now: float) -> None:
        """Start a batch of due cycles. The deadline has already passed while more are left."""
        for transaction in self.schedule.begin(now):
            self._store_counts(transaction)
            if self._admitted(transaction, now) is not None:
                self.backlog.push(transaction)
        self._deadlines.schedule = self.schedule.next_due()

    # dead nodes

    def suspend(self, node: NodeRecord, until: float) -> None:
        """Send a node nothing until the given time, in seconds. Requests to it fail with NodeDown."""
        node.suspended_until = until
        self.probes.plan()

    def release_node(self, node: NodeRecord) -> None:
        """Resume a node's polls with their next cycle after its hook has run.

        Counted, because the node may have gone DOWN and returned again in the meantime.
        """
        node.holds = max(0, node.holds - 1)

    def probe(self, now: float, idle: bool) -> None:
        """Send the next due probe if the budget allows it. `idle`: the line has nothing else to do."""
        probe = self.probes.next(now, self.fault is None, idle)
        if probe is not None:
            self._store_counts(probe)
            probe.deadline = now + RETRY_PATIENCE
            if probe.node.budgeted:
                probe.client = self.share().new_nodes()
            self.backlog.push(probe)

    def check(self, node: NodeRecord, command: Command[Any], now: float) -> Transaction:
        """Return a sync read, which proves that the line is in sync (R15). It is sent immediately and has no caller."""
        self.counters.sync_reads += 1
        check = Transaction(node, command, priority=BACKGROUND, retries=0, probe=True)
        check.check = True
        check.wanted = False
        check.queued, check.deadline = now, inf
        self._store_counts(check)
        return check

    # the ways of one transaction

    def is_wanted(self, transaction: Transaction) -> bool:
        """Return True if a transaction may be sent again: its caller still waits, and no later write has overtaken
        it."""
        client = transaction.client
        over = client is not None and client.over
        return transaction.wanted and not (transaction.superseded or over) and self.fault is None

    def _requeue(self, transaction: Transaction, now: float) -> None:
        """Append a transaction to its class. The deadline of a poll becomes the failure time plus the period (R7)."""
        poll = transaction.poll
        # Counted from now and not from the first deadline: a retry that keeps its place would delay the polls behind
        # it.
        transaction.deadline = now + (poll.patience if poll is not None else RETRY_PATIENCE)
        self.backlog.push(transaction)

    def _supersede(self, node: NodeRecord, why: str, now: float, above: Priority | None = None) -> None:
        """Fail a node's queued writes, of classes below `above` if given.

        A superseded write is never sent after the write that overtakes it, even if that one cannot be sent itself (R7).
        """
        # A copy, since ending a write removes it from the queue.
        for write in list(self.writes.queues[node]):
            if write.phase is ON_WIRE:
                write.superseded = True  # the attempt continues, but is not retried behind the write that overtakes it
            elif above is None or write.priority > above:
                self._unqueue(write)
                self._end(write, now, make_error(Superseded, why, write))

    def _end(self, transaction: Transaction, now: float, error: BusError | None = None) -> None:
        """End a transaction exactly once (R8). A write that was sent before another error ended it is unconfirmed."""
        if self.tapped is not None:
            self.tapped.forget(transaction)
        if transaction.writes:
            unsure = transaction.unsure or (transaction.attempts > 0 and not isinstance(error, NOT_DONE))
            # R7: a later NodeDown or Superseded does not mean that the first attempt was not carried out.
            if unsure and error is not None and not isinstance(error, WriteUnconfirmed):
                error = make_error(WriteUnconfirmed, f"it was sent and not answered, then: {error.what}", transaction)
            self.writes.ended(transaction)
        if not transaction.attempts:
            transaction.exchanges_ahead = self.counters.exchanges - transaction.exchanges_ahead
            transaction.quiet_time_ahead = self.counters.spent[RESYNCHRONISING] - transaction.quiet_time_ahead
        transaction.phase = ENDED
        transaction.ended_at = now
        transaction.error = error
        if error is not None and not transaction.check:
            transaction.node.counters.failed += 1
        if transaction.probe:
            self.probes.ended(transaction)
        if not transaction.wanted and not transaction.check:
            transaction.node.counters.unheard += transaction.attempts > 0
        if transaction.stops_alike:
            self._end_alike(transaction, now, error)
        poll = transaction.poll
        if poll is not None:
            # A group that was removed in the meantime has no reader.
            if poll.group is not None and poll.active:
                self.events.append(Sampled(poll, transaction))
            poll.remaining -= 1
            if not poll.remaining and poll.active:
                poll.finished = now
                self.events.append(Polled(poll))
        elif transaction.wanted:
            self.counters.completed += 1
            self.events.append(transaction)

    def _end_alike(self, stop: Transaction, now: float, error: BusError | None) -> None:
        """End the equal stops that were waiting for the outcome of this one."""
        for other in stop.stops_alike:
            other.value, other.last_byte, other.unsure = stop.value, stop.last_byte, stop.unsure
            self._end(other, now, error and make_error(type(error), error.what, other, error.hint))

    def _store_counts(self, transaction: Transaction) -> None:
        """Store the line's counters. Their difference at the start of the request gives the exchanges that went ahead
        of it."""
        transaction.exchanges_ahead = self.counters.exchanges
        transaction.quiet_time_ahead = self.counters.spent[RESYNCHRONISING]
