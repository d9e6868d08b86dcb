"""Which transaction goes next, and how each one ends (R6-R12).

The arbiter says when the line is free and what came of an attempt; the dispatcher never knows what is on the line.
It queues, orders the writes of a node, retries, confirms refusals, parks the polls of dead nodes, pays for probes,
and ends every transaction exactly once.

If the line can no longer be used, whatever waits is taken out at once, so that none of it is sent any more, whatever
becomes of the line meanwhile. But a thousand callers told in one callback would hold up the loop that owns the line,
and perhaps others: it ends in bounded pieces. What remains is due at once, so that the owner calls again when it has
seen to its other ports.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import count
from math import inf
from typing import Any

from busmaster.arbiter.backlog import Backlog, Writes
from busmaster.arbiter.clients import Hold
from busmaster.arbiter.counters import RESYNCHRONISING, LineCounters
from busmaster.arbiter.deadlines import Deadlines, Expiries
from busmaster.arbiter.eligibility import IF_PAID, OK, WAITS, Eligible, Rejected, eligibility, unpaid
from busmaster.arbiter.events import Event, Overdue, Polled, Sampled
from busmaster.arbiter.health import DOWN, UP, NodeRecord
from busmaster.arbiter.probes import NodeWatch, Probes
from busmaster.arbiter.schedule import Schedule
from busmaster.arbiter.shared_backlog import SharedBacklog
from busmaster.arbiter.tap import Attempt, Verdict
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


REFUSED_POLL_PAUSE = 10.0
"""Seconds between polls of a point that was refused again and again."""
RETRY_PATIENCE = 1.0
"""Seconds after which a request in POLL or BACKGROUND wants to be answered; the period, for a poll."""
NOT_DONE = (Refused, Superseded)
"""Errors that say of a write that it was not carried out, unless an attempt before them may have been."""


class Tapped:
    """Tells whoever taps the line of each attempt, from now on; of one that is on the wire already, nothing is told."""

    def __init__(self, events: deque[Event], counters: LineCounters) -> None:
        self.attempt: Attempt | None = None
        """What is on the wire."""
        self._events = events
        self._counters = counters
        self._order_of_transactions = count(1)
        self._numbers: dict[Transaction, int] = {}

    def started(self, transaction: Transaction) -> None:
        """Begin the attempt that goes out now, with the number of its transaction."""
        if transaction.attempts == 1 or transaction not in self._numbers:
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

    def over(self, transaction: Transaction, verdict: Verdict, result: Any, now: float) -> None:
        """Tell how the attempt ended."""
        attempt, self.attempt = self.attempt, None
        if attempt is None:  # it was on the wire before anybody listened
            return
        attempt.late = transaction.late
        attempt.heard = transaction.wanted or transaction.check
        attempt.end(verdict, result, now)
        self._events.append(attempt)

    def forget(self, transaction: Transaction) -> None:
        """Forget the number of a transaction that has ended."""
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
        """The one that has succeeded, until `note_success`."""
        self.backlog: Backlog = Backlog()
        self.schedule = Schedule()
        self.nodes: list[NodeRecord] = []
        self.writes = Writes(self.backlog)
        self.counters = counters
        self.fault: Callable[[], BusError] | None = None
        """Makes the error with which everything fails while the line cannot be used."""
        self.is_held: Callable[[], bool] = lambda: False
        """Says whether the port had not sent all of the request on the wire when it was asked last."""
        self._deadlines = deadlines
        self.probes = Probes(deadlines, self.nodes, now)
        self._capacity = capacity
        self._watch = NodeWatch(self.nodes, self.probes, self.events, jitter)
        self._expiries = Expiries(deadlines)
        self.failing = FailingTransactions(deadlines)
        self.tapped: Tapped | None = None
        """Where somebody taps the line: a line that nobody listens to pays a comparison for it."""

    # requests

    def submit(self, transaction: Transaction, now: float) -> bool:
        """Queue a transaction, or end it at once with the reason why not. Returns False if nothing else has changed."""
        node, counters = transaction.node, self.counters
        transaction.queued = now
        transaction.deadline = now + RETRY_PATIENCE
        transaction.exchanges_ahead = counters.exchanges  # as _waits does: this is done for every request
        transaction.quiet_time_ahead = counters.spent[RESYNCHRONISING]
        if self.fault is not None:
            self._admitted(transaction, now)
            return True
        changed = transaction.writes  # it may have superseded others, which is to be told
        queue = self.backlog.queues[transaction.priority]
        if changed and transaction.priority is URGENT:  # even if it fails below: no enable may follow it
            self._supersede(node, "overtaken by an urgent write to the same node", now, above=URGENT)
        # writes that are parked are in no class
        waiting = max(queue.live, len(self.writes.queues[node])) if changed else queue.live
        if waiting >= self._capacity and (waiting := self.writes.waiting_of(transaction)) >= self._capacity:
            self._end(transaction, now, make_error(BacklogFull, f"{waiting} requests are waiting already", transaction))
            return True
        if node.health is DOWN or now < node.suspended_until:
            if self._admitted(transaction, now) is None:
                return True
            if node.budgeted and transaction.client is not None and not isinstance(transaction.client, Hold):
                transaction.client = self.share().new_nodes()
        # Behind the check above, so that a rejected write never blocks the writes behind it.
        if changed:
            self.writes.queues[node].append(transaction)
        if transaction.start_by < inf:
            self._expiries.expect(transaction, len(self.backlog))
            changed = True
        transaction.phase = QUEUED  # as backlog.push does: this is done for every request
        queue.push(transaction)
        return changed

    def cancel(self, transaction: Transaction, now: float) -> None:
        """Note that a caller has gone: its transaction is not sent if still queued, unheard if on the wire (R6)."""
        if not transaction.wanted or transaction.phase in (ENDED, IDLE):
            return
        # On the wire it stays until its reply has come or its window is over: cancelling saves no line time (R6).
        transaction.wanted = False
        self.counters.cancelled += 1
        if transaction.phase is QUEUED:
            self.backlog.discard(transaction, PARKED)
        if transaction.phase is not ON_WIRE:
            self._release_stops(transaction)
            self.probes.budget.refund(transaction.probe_cost)
            self._end(transaction, now)

    def next(self, now: float) -> Transaction | None:
        """Take out the transaction that may be sent now, or return None."""
        while (transaction := self.backlog.pop(now)) is not None:
            verdict = self._admitted(transaction, now)
            if verdict is OK:
                return transaction
            if verdict is WAITS:
                self.writes.park(transaction)
            self.backlog.keep_turn(transaction)
        return None

    def urgent_waits(self) -> bool:
        """Return whether something of the class URGENT waits."""
        return self.backlog.waiting(URGENT) > 0

    def eligibility(self, transaction: Transaction, now: float) -> Eligible | Rejected:
        """Return whether a transaction may be sent now; nothing is changed."""
        return eligibility(transaction, now, self.writes, None if self.fault is None else self.fault())

    def proves(self, read: Transaction, now: float) -> bool:
        """Return whether a read that waits may be sent in place of a sync read: its node is not known to be down."""
        return read.node.health is not DOWN and self.eligibility(read, now) is OK

    def _admitted(self, transaction: Transaction, now: float) -> Eligible | None:
        """Return OK or WAITS, and have the budget of probes pay for what is asked of a dead node; or end the
        transaction, and return None."""
        verdict = self.eligibility(transaction, now)
        if verdict is IF_PAID:
            cost = transaction.node.max_reply_delay
            if self.probes.spare(cost, now):
                transaction.probe_cost = cost
                transaction.retries = 0
                verdict = self.eligibility(transaction, now)
            else:
                verdict = unpaid(transaction)
        if isinstance(verdict, Rejected):
            self._end(transaction, now, verdict.error)
            return None
        return verdict

    def started(self, transaction: Transaction, now: float) -> None:
        """Note that the next attempt of a transaction goes out now."""
        counters = self.counters
        # Waits are those of the first attempt: a retry waits because of the line, not because of its class.
        if transaction.attempts:
            transaction.first_byte = -inf
        elif not transaction.check:
            counters.waits[transaction.priority].record(now - transaction.queued)
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
        transaction.late = transaction.overdue = False  # an earlier attempt may have been: its value is not this one's
        if self.tapped is not None:
            self.tapped.started(transaction)

    def _take_stops(self, stop: Transaction, now: float) -> None:
        """Have equal stops that wait for the same node get the outcome of the one that is sent now.

        Not those behind a write that is no stop: sent once, they would be overtaken by it.
        """
        alike: list[Transaction] = []
        for write in self.writes.queues[stop.node]:
            if write is stop or write.phase is ON_WIRE:
                continue
            if not write.stop:
                break
            if write.attempts or type(write.command) is not type(stop.command) or write.command != stop.command:
                continue
            if write.priority is not stop.priority or isinstance(write.client, Hold):
                continue
            if write.phase is QUEUED:
                self.backlog.discard(write, PARKED)
            write.phase = ON_WIRE  # it is not sent itself, and runs out as this one does
            write.attempts, write.started = 1, now
            alike.append(write)
        stop.stops_alike = tuple(alike)

    def _release_stops(self, stop: Transaction) -> None:
        """Have the stops that wait for the outcome of this one be sent themselves, as it is not sent again."""
        alike, stop.stops_alike = stop.stops_alike, ()
        for other in alike:
            if other.phase is ON_WIRE:
                other.unsure = True
                self.backlog.push(other)

    # what came of an attempt

    def succeeded(self, transaction: Transaction, value: Any, now: float) -> None:
        """Note a success at once where it bears on what goes next; else with the events, when the next request left."""
        if self.tapped is not None:
            self.tapped.over(transaction, Verdict.OK, value, now)
        # Still there if the owner has not pumped its events since the last success.
        if self.unnoted is not None:
            self.note_success()
        transaction.value = value
        transaction.last_byte = now
        self.unnoted = transaction
        if transaction.writes or transaction.node.health is not UP:  # its next write may go; its polls may resume
            self.note_success()

    def note_success(self) -> None:
        """End the transaction that has succeeded and is not noted yet, if there is one."""
        transaction = self.unnoted
        if transaction is None:
            return
        self.unnoted = None
        node, now = transaction.node, transaction.last_byte
        counters = node.counters
        counters.latency.record(now - transaction.started)
        if transaction.late:
            counters.late += 1
            counters.overdue += transaction.overdue
        node.last_reply = now
        if node.health is not UP:
            self._watch.heard(node, now)
        if node.max_reply_delay_until < inf:
            self._watch.lower_max_reply_delay(transaction, now)
        if transaction.probe_cost:
            self.probes.budget.refund(transaction.probe_cost - (now - transaction.started))
        transaction.refused_cycles = 0
        self._end(transaction, now)

    def attempt_failed(
        self, transaction: Transaction, no_reply: bool, failure: FrameError, now: float, ambiguous: bool = False
    ) -> None:
        """Ask again or fail. A `ambiguous` answer came and was not believed, which says nothing of the node (R15)."""
        if self.tapped is not None:
            self.tapped.over(transaction, _verdict(no_reply, failure.what, ambiguous), failure.what, now)
        node = transaction.node
        transaction.unsure = True
        if no_reply:
            node.counters.no_reply += 1
        else:
            node.counters.garbled += 1
        # An ambiguous reply says nothing against the node, so the attempt is repeated even to one that fails.
        worth = ambiguous or self._watch.is_worth_a_retry(transaction)
        if transaction.retried < transaction.retries and worth and self.is_wanted(transaction):
            transaction.retried += 1
            node.counters.retries += 1
            self._requeue(transaction, now)
            return
        # A sync read may be refused or unknown to the node: its failure says nothing about the node.
        if not (ambiguous or transaction.check):
            self._watch.failed(node, now)
        kind: type[BusError] = NoReply if no_reply else GarbledReply
        if transaction.writes:
            kind, failure.hint = WriteUnconfirmed, None  # whatever came: what to do about the write comes first
        self._end(transaction, now, make_error(kind, failure.what, transaction, failure.hint))

    def broken(self, transaction: Transaction, bug: Exception, now: float) -> None:
        """Fail a transaction over which the protocol's reader failed: a bug there. To ask again would meet it again."""
        if self.tapped is not None:
            self.tapped.over(transaction, Verdict.GARBLED, f"a bug in the protocol's reader: {bug!r}", now)
        what = f"a bug in the {transaction.node.profile.name} reader: {bug!r}"
        transaction.node.counters.garbled += 1  # but no failure of the node: a bug says nothing of its health
        kind = WriteUnconfirmed if transaction.writes else BusError
        error = make_error(kind, what, transaction)
        error.hint = "this is not the line's fault: please report it, with a capture"
        error.__cause__ = bug
        self._end(transaction, now, error)

    def refused(self, transaction: Transaction, refusal: Refused, certain: bool, now: float) -> None:
        """Ask once more after a NAK or EOT where that can tell something new; then it is final (R7). Where it is not
        `certain`, it may be an earlier request's (R15): a read is asked once more; a write was perhaps carried out."""
        if self.tapped is not None:
            self.tapped.over(transaction, Verdict.REFUSED, refusal.what, now)
        node = transaction.node
        node.counters.refused += 1
        transaction.unsure = transaction.unsure or not certain
        again = refusal.confirm if certain else not transaction.writes or transaction.idempotent
        if again and not transaction.refusals and not transaction.probe and self.is_wanted(transaction):
            transaction.refusals += 1
            self._requeue(transaction, now)
            return
        # A NAK that may be noise, or another request's, takes nothing away that could prove that the line is in sync.
        if certain and not transaction.writes and (transaction.refusals or not refusal.confirm):
            node.note_refused(transaction.command)
        node.last_reply = now  # a refusal is an answer too (R11)
        if node.health is not UP:
            self._watch.heard(node, now)
        # Once may be noise that looks like a NAK; twice in a row is a point that the node does not have.
        transaction.refused_cycles += 1
        if transaction.refused_cycles > 1:
            transaction.refused_until = now + REFUSED_POLL_PAUSE
        self._end(transaction, now, name_error(refusal, transaction))

    def unsendable(self, transaction: Transaction, bug: Exception, now: float) -> None:
        """Fail a transaction that its protocol cannot encode: a bug there, but nobody may wait for ever."""
        self._end(transaction, now, make_error(BusError, f"its protocol could not encode it: {bug!r}", transaction))

    def cut_off(self, transaction: Transaction, error: BusError, now: float) -> None:
        """Fail a transaction under which the line was lost: a write may have been carried out."""
        if self.tapped is not None:
            self.tapped.over(transaction, Verdict.CUT_OFF, error.what, now)
        transaction.node.counters.cut_off += 1
        self._end(transaction, now, name_error(error, transaction))

    # clients

    def share(self) -> SharedBacklog:
        """Return the backlog in which clients take turns, which the line has from now on."""
        backlog = self.backlog
        if not isinstance(backlog, SharedBacklog):
            self.backlog = self.writes.backlog = backlog = SharedBacklog(backlog, self.writes, self._deadlines)
        return backlog

    def end_hold(self, now: float, hold: Hold | None = None) -> None:
        """Hold the line no longer for a sequence, the one that lasts if none is given: what of it waits ends so."""
        backlog = self.share()
        hold = hold or backlog.hold
        if hold is not None:
            for transaction in backlog.end_hold(hold, now):
                self._end(transaction, now, hold_ended(transaction, hold))
            self.writes.wake(hold.node, hold.client)

    # everything at once

    def supersede_writes(self, now: float) -> None:
        """End every write that waits, of whatever class, as Superseded."""
        for node in self.nodes:
            self._supersede(node, LEFT, now)

    def fail_all(self, now: float) -> None:
        """Take out whatever waits, to end with the current fault: the first few now, the others with `fail_more`."""
        assert self.fault is not None
        self.failing.add(take_out(self.writes.queues.values(), self.backlog), self.fault())
        self.fail_more(now)

    def handle_timeout(self, now: float, unread: bool) -> None:
        """Do what is due, but for what is the line's; with bytes `unread`, nobody is told that his time is over."""
        deadlines = self._deadlines
        if now >= deadlines.failing:
            self.fail_more(now)
        if now >= deadlines.schedule:
            self.release_polls(now)
        if now >= deadlines.expiry and not unread:
            self.expire(now)
        if now >= deadlines.hold:
            self.end_hold(now)
        if now >= deadlines.sequence:
            deadlines.sequence = inf  # the line, if it is free, asks the backlog next

    def fail_more(self, now: float) -> None:
        """End a bounded piece of what was taken out: the deadline has passed already while there is more."""
        for transaction, error in self.failing.next(now):
            self._end(transaction, now, error)

    def expire(self, now: float) -> None:
        """Tell callers whose time is over: nothing was sent, or it was, and how it ends is not known (R12). What is on
        the wire runs out unheard, as when its caller is cancelled; what has come by now has come in time."""
        self.note_success()
        # First the success above: a reply that has arrived in time must not be reported as too late.
        for transaction in self._expiries.due(now):
            if not transaction.wanted or (transaction.attempts and transaction.finish_by >= now):
                continue  # its caller has gone, or it was started in time: then only its `finish_by` ends it
            if transaction.phase is FAILING:
                continue  # it ends next, with what became of the line
            if transaction.phase is ON_WIRE:
                transaction.wanted = False
                self.counters.cancelled += 1
                self.events.append(Overdue(transaction, too_late(transaction, now, held=self.is_held())))
                continue
            if transaction.phase is QUEUED:
                self.backlog.discard(transaction, PARKED)
            self._end(transaction, now, too_late(transaction, now, held=self.is_held()))

    # polls

    def add_poll(self, poll: Poll, now: float) -> None:
        """Run a poll from now on."""
        self.schedule.add(poll, now)
        self._deadlines.schedule = self.schedule.next_due()

    def remove_poll(self, poll: Poll, now: float) -> None:
        """End a poll: what it has queued is never sent, and what it has on the wire goes unheard."""
        self.schedule.remove(poll)
        self._deadlines.schedule = self.schedule.next_due()
        for transaction in poll.results:
            self.cancel(transaction, now)

    def prepare_poll(self, poll: Poll, now: float) -> None:
        """Do the new `preparation` of a poll, a slice at a time."""
        self.schedule.prepare(poll, now)
        self._deadlines.schedule = self.schedule.next_due()

    def demand(self, poll: Poll, now: float) -> None:
        """Run one cycle of a poll now, off the grid. The running one serves, if there is one."""
        self.schedule.demand(poll)
        self.release_polls(now)

    def release_polls(self, now: float) -> None:
        """Start what is due, a bounded piece of it: the deadline has passed already while there is more."""
        for transaction in self.schedule.begin(now):
            self._waits(transaction)
            if self._admitted(transaction, now) is not None:
                self.backlog.push(transaction)
        self._deadlines.schedule = self.schedule.next_due()

    # dead nodes

    def suspend(self, node: NodeRecord, until: float) -> None:
        """Send a node nothing until this time, in seconds: what is asked of it fails with NodeDown."""
        node.suspended_until = until
        self.probes.plan()

    def release_node(self, node: NodeRecord) -> None:
        """Resume a node's polls with their next cycle, as its hook has run, unless it has died and come back since."""
        node.holds = max(0, node.holds - 1)

    def probe(self, now: float, idle: bool) -> None:
        """Ask the dead node whose turn it is, if the budget allows. If `idle`, the line has nothing else to do."""
        probe = self.probes.next(now, self.fault is None, idle)
        if probe is not None:
            self._waits(probe)
            probe.deadline = now + RETRY_PATIENCE
            if probe.node.budgeted:
                probe.client = self.share().new_nodes()
            self.backlog.push(probe)

    def check(self, node: NodeRecord, command: Command[Any], now: float) -> Transaction:
        """Make a read by which the line proves that it is in sync (R15). It goes at once; nobody waits for it."""
        self.counters.sync_reads += 1
        check = Transaction(node, command, priority=BACKGROUND, retries=0, probe=True)
        check.check = True
        check.wanted = False
        check.queued, check.deadline = now, inf
        self._waits(check)
        return check

    # the ways of one transaction

    def is_wanted(self, transaction: Transaction) -> bool:
        """Return whether a transaction may be sent again: its caller waits for it, and nothing has overtaken it."""
        client = transaction.client
        over = client is not None and client.over
        return transaction.wanted and not (transaction.superseded or over) and self.fault is None

    def _requeue(self, transaction: Transaction, now: float) -> None:
        """Put a transaction at the back of its class; a poll's key becomes failure time + period (R7)."""
        poll = transaction.poll
        # From now on and not from the first deadline: a retry that keeps its place would delay the polls behind it.
        transaction.deadline = now + (poll.patience if poll is not None else RETRY_PATIENCE)
        self.backlog.push(transaction)

    def _supersede(self, node: NodeRecord, why: str, now: float, above: Priority | None = None) -> None:
        """End a node's writes, those below the class `above` if one is given: what is overtaken is never sent after
        what overtakes it, nor if that cannot be sent itself (R7)."""
        # A copy, since ending a write removes it from the queue.
        for write in list(self.writes.queues[node]):
            if write.phase is ON_WIRE:
                write.superseded = True  # it runs out, but is not repeated behind what overtakes it
            elif above is None or write.priority > above:
                if write.phase is QUEUED:
                    self.backlog.discard(write, PARKED)
                self._end(write, now, make_error(Superseded, why, write))

    def _end(self, transaction: Transaction, now: float, error: BusError | None = None) -> None:
        """End it exactly once (R8). A write sent before something else ended it may have been carried out."""
        if self.tapped is not None:
            self.tapped.forget(transaction)
        if transaction.writes:
            unsure = transaction.unsure or (transaction.attempts > 0 and not isinstance(error, NOT_DONE))
            if unsure and error is not None and not isinstance(error, WriteUnconfirmed):
                error = make_error(WriteUnconfirmed, f"it was sent and not answered, then: {error.what}", transaction)
            self.writes.over(transaction)
        if not transaction.attempts:
            transaction.exchanges_ahead = self.counters.exchanges - transaction.exchanges_ahead
            transaction.quiet_time_ahead = self.counters.spent[RESYNCHRONISING] - transaction.quiet_time_ahead
        transaction.phase = ENDED
        transaction.ended_at = now
        transaction.error = error
        if error is not None and not transaction.check:
            transaction.node.counters.failed += 1
        if transaction.probe:
            self.probes.over(transaction)
        if not transaction.wanted and not transaction.check:
            transaction.node.counters.unheard += transaction.attempts > 0
        for other in transaction.stops_alike:
            other.value, other.last_byte, other.unsure = transaction.value, transaction.last_byte, transaction.unsure
            self._end(other, now, error and make_error(type(error), error.what, other, error.hint))
        poll = transaction.poll
        if poll is not None:
            # A group that was removed meanwhile has no reader any more.
            if poll.group is not None and poll.active:
                self.events.append(Sampled(poll, transaction))
            poll.remaining -= 1
            if not poll.remaining and poll.active:
                poll.finished = now
                self.events.append(Polled(poll))
        elif transaction.wanted:
            self.counters.completed += 1
            self.events.append(transaction)

    def _waits(self, transaction: Transaction) -> None:
        """Note what the line has counted so far, for which it does not wait: it is taken off when it has waited."""
        transaction.exchanges_ahead = self.counters.exchanges
        transaction.quiet_time_ahead = self.counters.spent[RESYNCHRONISING]
