"""Holds what the master says against what truly happened, and every rule that can be checked cheaply, on every step.

A wrong outcome is a value, or the acknowledgement of a write, that is not this attempt's. It is *unseen* if damage on
the line made it, which the telegram's own checksum does not show (or which hit a telegram that has none: an ACK, a NAK,
an EOT, a read of HCP or Mentor II); else it is *confused*: the master took one exchange's bytes for another's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Any

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.choice import MOST_BEFORE
from busmaster.arbiter.events import NodeChanged
from busmaster.arbiter.health import DOWN_AFTER_FAILURES, Health
from busmaster.arbiter.shared_backlog import PASSED_BY_EACH
from busmaster.arbiter.transaction import Phase, Poll, Priority, Transaction
from busmaster.contract.exchange import Command
from busmaster.errors import BacklogFull, NotStarted, Refused, WriteUnconfirmed
from busmaster.protocols.msc import codec as msc
from busmaster.protocols.msc.device import AUTO_START, RAM_NOT_RELIABLE, RUNNING, SYSTEM_RESET
from tests.verification.campaigns.kinds import Kind, echoed, elements_of
from tests.verification.campaigns.ledger import RECENT, ROUNDING, Frame, Ledger, WatchedLine, Written
from tests.verification.campaigns.mixes import AT_MOST, Mix

STATES = (RUNNING | AUTO_START, SYSTEM_RESET | RAM_NOT_RELIABLE)
"""What an emulated MSC's status word can be."""


@dataclass(slots=True)
class Asked:
    """What is known of a transaction beside itself."""

    client: int = -1
    elements: tuple[int, ...] = ()
    written: Written | None = None
    urgent_ahead: int = 0
    """Of its own program."""
    rivals: int = 0
    """Other programs on the line."""
    then: Callable[[Transaction], None] | None = None
    """What its caller does when it has ended."""


@dataclass
class Totals:
    """Of one hunt, or of many. `transactions` were on the wire; those `turned_away` ended without it."""

    hunts: int = 0
    transactions: int = 0
    values: int = 0
    writes: int = 0
    good: int = 0
    """Values and acknowledgements that were right."""
    failed: int = 0
    cancelled: int = 0
    turned_away: int = 0
    confused: int = 0
    unseen: int = 0
    """Wrong values and acknowledgements that the documents' checksums let through."""
    heard_twice: int = 0
    """Writes that were sent once and carried out more than once: a drive that heard them twice. No master can help."""
    untrue: int = 0
    """Writes that were carried out, and ended with an error that says they were not."""
    worst: int = 0
    """The most wrong outcomes that one doubled reply has brought."""
    unseen_writes: int = 0
    """Writes of something that nobody had sent, likewise."""
    unexpected: int = 0
    """What devices said because damage had made them: see `Ledger.unexpected`."""
    lost: int = 0
    attempts: int = 0
    bad_attempts: int = 0
    unexpected_bytes: int = 0
    raised: int = 0
    seconds: float = 0.0
    recovery: float = 0.0
    """The longest time, in seconds, that it took until everything went well again after the faults had healed."""
    problems: list[str] = field(default_factory=list)

    @property
    def wrong(self) -> int:
        return self.confused + self.unseen

    def add(self, other: Totals) -> None:
        for name, value in vars(other).items():
            if name in ("recovery", "worst"):
                setattr(self, name, max(getattr(self, name), value))
            else:
                setattr(self, name, getattr(self, name) + value)


class BrokenRuleError(AssertionError):
    """A promise was not kept."""


class Judge:
    """Of one hunt. What it finds is in `totals`; a rule that was broken is raised too."""

    def __init__(self, kind: Kind, mix: Mix, ledger: Ledger, line: WatchedLine, arbiter: Arbiter) -> None:
        self.kind = kind
        self.mix = mix
        self.ledger = ledger
        self.line = line
        self.arbiter = arbiter
        self.totals = Totals(hunts=1)
        self._left: list[tuple[Transaction, int]] = []
        self._demanded: set[Poll] = set()
        self._timing = kind.profile.timings
        self._since_doubled = 0
        ledger.problem = self.problem
        line.on_request = self.request_leaves

    @property
    def now(self) -> float:
        return self.ledger.now()

    def problem(self, what: str) -> None:
        """A rule was broken: that ends the hunt."""
        found = f"{self.now:.6f} {what}"
        self.totals.problems.append(found)
        raise BrokenRuleError(found)

    def count_problem(self, what: str) -> None:
        """A rule was broken where it is counted how often: the hunt goes on, and the first one is told."""
        if not self.totals.problems:
            self.totals.problems.append(f"{self.now:.6f} {what}")

    # the line

    def doubled(self) -> None:
        """A reply is going to be said twice."""
        self._since_doubled = 0

    def request_leaves(self, now: float) -> None:
        """R1, R3: whatever was caused before is over. An MSC repeats its packets by itself. A reply that noise cut
        into may look as if it had ended, with a bad checksum."""
        last = self.ledger.last
        if self.mix.beyond or self.line.repeats or self.ledger.broken():
            return
        if self._goes_on(last, now):
            return
        if self.mix.edges is not None and self.line.echo is None and self.line.held_back(now):
            self.problem("R3: a request leaves while bytes of a reply lie in the adapter")
        disguised = self.ledger.disguised(self.line.asked_at, now)
        if last.start > now + ROUNDING and not disguised:
            self.problem(f"R3: a request leaves while a reply is still to come, at {last.start:.6f}")
        calm = self.mix.edges is not None and not self.mix.device  # then whatever noise did to it, its end is known
        spared = self.ledger.damaged(last.start, now) or disguised
        if last.end > now + ROUNDING and (calm or not spared):
            self.problem(f"R1: a request leaves into a reply that lasts until {last.end:.6f}")

    def _goes_on(self, last: Frame, now: float) -> bool:
        """Whether a learned window was over, and so the line need not wait (R15): but a write has to."""
        awaited = self.arbiter._in_sync.awaited_until(-inf) > -inf
        asked = self.arbiter._wire.transaction
        still_comes = last.end > now + ROUNDING and not self.ledger.damaged(last.start, now)
        if awaited and still_comes and asked is not None and asked.writes and asked.priority is not Priority.URGENT:
            self.problem(f"R15: a write leaves while a reply is awaited, until {last.end:.6f}")
        return awaited

    # transactions

    def ended(self, transaction: Transaction) -> None:
        """With its value or its error."""
        totals = self.totals
        asked: Asked = transaction.tag or Asked(elements=elements_of(transaction.command))
        if transaction.phase is not Phase.ENDED:
            self.problem(f"R8: {transaction.command} was reported while {transaction.phase.value}")
        if not transaction.attempts:
            totals.turned_away += 1
            if transaction.error is None or (asked.written is not None and asked.written.taken):
                self.problem(f"{transaction.command} was carried out without having been sent")
            return
        totals.transactions += 1
        if transaction.attempts == 1:
            self._check_wait(transaction, asked)
        if transaction.writes:
            self._check_write(transaction, asked)
        elif transaction.error is None:
            self._check_value(transaction, asked)
        else:
            totals.failed += 1
            self._check_error(transaction)

    def _check_value(self, transaction: Transaction, asked: Asked) -> None:
        self.totals.values += 1
        value = transaction.value
        address = transaction.node.address
        if asked.elements:
            values = value if type(value) is tuple else (value,)
            right = len(values) == len(asked.elements) and all(
                self._is_right(number, address, element, transaction.started)
                for number, element in zip(values, asked.elements, strict=True)
            )
        else:
            right = self._is_state(transaction.command, value, address)
        if not right:
            self._wrong(transaction, f"{transaction.node.label}: {transaction.command} brought {value}")
        self.totals.good += right
        self._check_times(transaction)

    def _is_right(self, number: float, address: int, element: int, started: float) -> bool:
        answer = self.ledger.said_for(int(number))
        return answer is not None and answer[:2] == (address, element) and answer.asked >= started

    def _is_state(self, command: Command[Any], value: Any, address: int) -> bool:
        if isinstance(command, msc.ReadFlag):
            return not value or (command.flag + address) % 2 == 1
        return int(value) in STATES

    def _check_times(self, transaction: Transaction) -> None:
        """R2: a value's first byte came within the maximum reply delay, which an overdue reply may have raised."""
        if self.line.repeats or self.line.echo is not None or self.mix.stands is not None:
            return
        spoken = next(self.line.during(transaction.started, transaction.last_byte))
        due = (
            spoken.asked_until
            + transaction.node.max_reply_delay
            + self.line.latency
            + self.line.settings.byte_time
            + ROUNDING
        )
        if transaction.first_byte > due:
            self.problem(
                f"R2: {transaction.command} accepted {transaction.first_byte - due:.6f} s after its maximum reply delay"
            )

    def _check_write(self, transaction: Transaction, asked: Asked) -> None:
        written, error = asked.written, transaction.error
        if error is None:
            self.totals.writes += 1
        else:
            self.totals.failed += 1
            self._check_error(transaction)
        if transaction.node.address == self.kind.profile.broadcast or written is None:
            return
        what = f"{transaction.node.label}: {transaction.command}"
        if error is None and written.taken_at < transaction.started:
            self._wrong(transaction, f"{what} was acknowledged, but not taken")
        elif error is None:
            self.totals.good += 1
        elif written.taken and not isinstance(error, WriteUnconfirmed) and len(written.elements) == 1:
            self._untrue(transaction, f"{what} was taken, and ended with {error!r}")
        if not transaction.idempotent:
            sent_again = transaction.attempts - transaction.refusals
            if sent_again > 1:
                self.problem(f"R7: {what} was sent {transaction.attempts} times unexpected")
            if written.taken > 1:
                self._heard_twice(transaction, f"{what} was taken {written.taken} times and ended with {error!r}")

    def _untrue(self, transaction: Transaction, what: str) -> None:
        """R7: an attempt that may have been carried out leaves the write unconfirmed, whatever came later."""
        self.totals.untrue += 1
        if self.mix.beyond and not self.mix.in_sync:
            self._count_wrong(not self.ledger.damaged(transaction.queued, transaction.ended_at), what)
        elif not self.ledger.damaged(transaction.queued, transaction.ended_at):
            self.count_problem(f"R7: {what}")

    def _heard_twice(self, transaction: Transaction, what: str) -> None:
        self.totals.heard_twice += 1
        if not self.mix.beyond and not self.ledger.damaged(transaction.queued, transaction.ended_at):
            self.problem(f"R7: {what}")

    def _check_error(self, transaction: Transaction) -> None:
        error = transaction.error
        if isinstance(error, NotStarted | BacklogFull):
            self.problem(f"{transaction.command} was on the wire and ended with {error!r}")
            return
        refused = isinstance(error, Refused) and not self.mix.refuses and (self.mix.in_sync or not self.mix.beyond)
        if refused and not self.ledger.damaged(transaction.started - RECENT, transaction.ended_at):
            self._count_wrong(True, f"{error}: nobody did")

    def _wrong(self, transaction: Transaction, what: str) -> None:
        ledger, begin, end = self.ledger, transaction.started, transaction.ended_at
        command, address = transaction.command, transaction.node.address
        read = not transaction.writes and transaction.error is None
        confused = not ledger.damaged(begin, end)
        for frame in ledger.overdue_replies(begin, end):
            confused = confused or not read or echoed(command, address, frame.data)
        if read:
            heard = b" ".join(bytes(spoken.heard) for spoken in self.line.during(begin, end))
            confused = confused or not echoed(command, address, heard)
        self._count_wrong(confused, what)

    def _count_wrong(self, confused: bool, what: str) -> None:
        self._since_doubled += 1
        if self.mix.doubled:
            self.totals.worst = max(self.totals.worst, self._since_doubled)
        if not confused or (self.ledger.broken() and not self.mix.beyond):
            self.totals.unseen += 1
            return
        self.totals.confused += 1
        if not self.mix.beyond:
            self.problem(f"WRONG: {what}")
        elif self.mix.in_sync or (self.mix.doubled and self._since_doubled > AT_MOST):
            self.count_problem(f"WRONG: {what}")

    def _check_wait(self, transaction: Transaction, asked: Asked) -> None:
        """R9: an urgent read waits for the exchange on the wire, for what is ahead in its class, for the turns of other
        programs before each of those and itself, and for the few that may go before any of them (R15)."""
        ahead = transaction.exchanges_ahead
        turn = 1 + PASSED_BY_EACH * asked.rivals
        most = 1 + MOST_BEFORE + (1 + MOST_BEFORE) * ((asked.urgent_ahead + 1) * turn - 1)
        if transaction.priority is Priority.URGENT and not transaction.writes and ahead > most:
            self.problem(f"R9: {ahead} exchanges went before an urgent one")
        late = self.mix.stands is not None and self.mix.stands.process  # it was told in time, and then stood still
        if transaction.started > transaction.start_by + ROUNDING and not late:
            self.problem(f"R12: {transaction.command} was sent after its time")

    # callers who go away, polls, nodes

    def left(self, transaction: Transaction) -> None:
        """Its caller went away: it is not sent (again) from now on (R6)."""
        self.totals.cancelled += 1
        self._left.append((transaction, transaction.attempts))
        if len(self._left) > 500:
            self.check_those_who_left()

    def check_those_who_left(self) -> None:
        for transaction, attempts in self._left:
            if transaction.attempts != attempts:
                self.problem(f"R6: {transaction.command} was sent again for nobody")
        self._left = [entry for entry in self._left if entry[0].phase is not Phase.ENDED]

    def demanded(self, poll: Poll) -> None:
        self._demanded.add(poll)

    def polled(self, poll: Poll) -> None:
        for transaction in poll.results:
            self.ended(transaction)
        if poll in self._demanded:
            self._demanded.discard(poll)
            return
        places = (poll.due - poll.base) / poll.period
        if abs(places - round(places)) * poll.period > ROUNDING:
            self.problem(f"R10: {poll.name} was due at {poll.due:.6f}, off its grid")
        if poll.started < poll.due - ROUNDING and any(t.attempts for t in poll.results):
            self.problem(f"R10: {poll.name} started before it was due")
        if poll.remaining:
            self.problem(f"R10: {poll.name} was reported with {poll.remaining} reads to come")

    def changed(self, change: NodeChanged) -> None:
        known, failures = change.before is not Health.UNKNOWN, change.node.failures
        if change.after is Health.DOWN and known and failures < DOWN_AFTER_FAILURES:
            self.problem(f"R11: {change.node.label} is down after {failures} failures")

    # at the end

    def check_all_ended(self, open_transactions: int) -> None:
        """Nothing is left anywhere."""
        self.check_those_who_left()
        dispatcher = self.arbiter.dispatcher
        if open_transactions:
            self.totals.lost += open_transactions
            self.problem(f"R8: {open_transactions} transactions never ended")
        if len(dispatcher.backlog) or any(dispatcher.writes.queues.values()):
            self.problem("R8: something is left in the backlog")

    def sum_up(self, seconds: float) -> None:
        dispatcher, totals = self.arbiter.dispatcher, self.totals
        totals.unseen_writes += self.ledger.unseen_writes
        totals.unexpected += self.ledger.unexpected
        totals.seconds += seconds
        totals.unexpected_bytes += self.arbiter.statistics(self.now).unexpected_bytes
        for node in dispatcher.nodes:
            counters = node.counters
            totals.attempts += counters.attempts
            totals.bad_attempts += counters.no_reply + counters.garbled
