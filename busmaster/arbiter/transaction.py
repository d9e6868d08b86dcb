"""Transactions (a command with its caller, priority and retries), polls that run theirs once per period, and their
errors.

Each failed transaction gets an error instance of its own, which contains the node, the command and the attempts.
"""

from __future__ import annotations

import enum
from collections.abc import Iterator, Sequence
from math import inf, nextafter
from typing import Any, NamedTuple

from busmaster.arbiter.clients import Hold, LineClient
from busmaster.arbiter.counters import Histogram
from busmaster.arbiter.health import DOWN, UNKNOWN, NodeRecord
from busmaster.arbiter.learned import AGAIN, AT_FIRST, AT_LAST, NEVER
from busmaster.contract.bounds import LONGEST_PERIOD, SHORTEST_PERIOD
from busmaster.contract.exchange import Command
from busmaster.contract.timing import Timings
from busmaster.errors import BusError, HoldEnded, InvalidCommand, NoReply, NotStarted, WriteUnconfirmed

LONGEST_PATIENCE = 10.0
"""Longest time in seconds from a cycle's due time to its deadline, however long the poll's period is."""
BEFORE_ALL = -inf
"""A time before all others. A constant, because `-inf` is calculated anew each time."""


class Priority(enum.IntEnum):
    """The classes of R9. A lower number goes first."""

    URGENT = 0
    COMMAND = 1
    POLL = 2
    BACKGROUND = 3


URGENT, COMMAND, POLL, BACKGROUND = Priority


class Phase(enum.Enum):
    """State of a transaction. PARKED: it is in no class queue. It waits for an earlier write to its node (R7), or for a
    time before which it may not be sent.

    FAILING: the line became unusable while it was queued. It ends next and is never sent (R13).
    """

    IDLE = "idle"
    QUEUED = "queued"
    PARKED = "parked"
    ON_WIRE = "on wire"
    FAILING = "failing"
    ENDED = "ended"


IDLE, QUEUED, PARKED, ON_WIRE, FAILING, ENDED = Phase
LEFT = "the line is being left: only its safe state is still written"
"""Reason for superseding other writes while the safe state is sent."""


class Timeline(NamedTuple):
    """When the steps of a request happened, on the bus's clock in seconds; None for steps that did not happen."""

    queued: float
    started: float | None
    """When its last attempt began to be sent."""
    first_byte: float | None
    last_byte: float | None
    attempts: int
    exchanges_ahead: int
    """Exchanges of other requests that went first while it was queued."""
    quiet_time_ahead: float
    """Seconds of that wait in which the line was resynchronising."""


class Transaction:
    """One command in progress. Created by the caller, changed only by the arbiter, ended exactly once (R8)."""

    __slots__ = (
        "attempts",
        "check",
        "client",
        "command",
        "deadline",
        "ended_at",
        "error",
        "exchanges_ahead",
        "finish_by",
        "first_byte",
        "idempotent",
        "last_byte",
        "late",
        "node",
        "overdue",
        "phase",
        "poll",
        "priority",
        "probe",
        "probe_cost",
        "queued",
        "quiet_time_ahead",
        "refusals",
        "refused_cycles",
        "refused_until",
        "retried",
        "retries",
        "start_by",
        "started",
        "stop",
        "stops_alike",
        "superseded",
        "tag",
        "touches",
        "unsure",
        "value",
        "wanted",
        "writes",
    )

    queued: float
    deadline: float
    """Deadline used for earliest-deadline-first ordering."""
    exchanges_ahead: int
    quiet_time_ahead: float
    late: bool
    """The reply to its last attempt began after `late_after`."""
    overdue: bool
    """That reply began after the reply window."""
    # The attributes above are set when it is queued or sent, and not in `__init__`. The docstrings are here because a
    # string inside a function is an instruction that does nothing. Both cost time for every request.
    finish_by: float
    """The caller stops waiting at this time, and nothing is sent from then on."""
    client: LineClient | None
    """The client that sent the request; None: the program that owns the line."""
    check: bool
    """A sync read, sent only to prove that replies match requests (R15). It has no caller and is excluded from
    statistics."""
    touches: object
    """What a write changes. Used by the owner only."""
    stop: bool
    """It stops its node or belongs to the safe state: sending it once is as good as sending it twice."""
    stops_alike: tuple[Transaction, ...]
    """Equal stops that were queued when this one was sent, and get its outcome."""
    unsure: bool
    """An attempt with an unknown outcome was sent, so it may have been carried out (R7)."""

    def __init__(
        self,
        node: NodeRecord,
        command: Command[Any],
        priority: Priority = COMMAND,
        start_by: float = inf,
        retries: int | None = None,
        idempotent: bool | None = None,
        probe: bool = False,
        finish_by: float = inf,
        touches: object = None,
        client: LineClient | None = None,
        tag: Any = None,
        poll: Poll | None = None,
        stop: bool = False,
    ) -> None:
        self.node = node
        self.command = command
        self.priority = priority
        self.writes = writes = command.writes
        self.idempotent = command.idempotent if idempotent is None else idempotent
        if probe or (writes and not self.idempotent):
            self.retries = 0  # R7: a number of retries alone does not make a write repeatable
        else:
            self.retries = node.retries if retries is None else retries
        self.start_by = start_by
        self.finish_by = finish_by
        if finish_by < inf:
            # A request may start exactly at its start_by, but nothing is sent at or after finish_by.
            self.start_by = min(start_by, nextafter(finish_by, -inf))
        self.tag = tag
        self.poll = poll
        self.stop = stop
        # Set here and not in `reset`: only a poll's transactions run more than once, and they are never stops.
        self.stops_alike: tuple[Transaction, ...] = ()
        self.client = client
        self.probe = probe
        self.check = False
        self.touches = touches
        # Not part of `reset`: a poll must remember over its cycles that a point is refused.
        self.refused_until = BEFORE_ALL
        self.refused_cycles = 0
        self.reset()

    def reset(self) -> None:
        """Reset it for its next run. A poll's transactions live as long as the poll."""
        # `queued`, `deadline` and the counts of what went ahead are set anew whenever it is queued.
        self.phase = IDLE
        self.attempts = 0
        self.retried = 0
        self.refusals = 0
        self.probe_cost = 0.0
        self.wanted = True
        self.superseded = False
        self.unsure = False
        self.value: Any = None
        self.error: BusError | None = None
        self.started = self.first_byte = self.last_byte = self.ended_at = BEFORE_ALL

    def timings(self) -> Timings:
        """Return the times for the next attempt. A learned window is used only for a read that can be repeated."""
        # AT_LAST unless a case below changes it: the last attempt uses the documented window (R15).
        node, hurry = self.node, AT_LAST
        if node.learning is None:
            return node.timings
        # A sync read is created as a probe, but has no caller, so a learned window is enough.
        if node.failures or node.health is UNKNOWN or node.health is DOWN or self.probe != self.check:
            hurry = NEVER
        elif self.writes and node.profile.acks_are_commands:
            hurry = NEVER  # a late ACK would make the addressed drive send its next value
        elif self.check or (self.retried < self.retries and not self.writes and self.retried < 2):
            # Twice the learned window for the second attempt: the first may have failed because the node has become
            # slower.
            hurry = AGAIN if self.retried else AT_FIRST
        return node.learning.timings(self.command, node.timings, hurry)

    def timeline(self) -> Timeline:
        """Return when its steps happened and which exchanges went ahead of it."""

        def known(time: float) -> float | None:
            return None if time == -inf else time

        return Timeline(
            self.queued,
            known(self.started),
            known(self.first_byte),
            known(self.last_byte),
            self.attempts,
            self.exchanges_ahead,
            self.quiet_time_ahead,
        )


class Poll:
    """Transactions that are run once per period, on the grid base + k x period.

    `cost`: line time of one cycle in seconds, used to choose phases. `results`: its transactions, which hold the
    outcome of the last cycle until the next one starts. `preparation`: optional work that creates the transactions and
    the cost; each step yields the units it took, of about a microsecond. A removed poll cannot be added again.
    """

    __slots__ = (
        "active",
        "base",
        "cost",
        "cycles",
        "due",
        "finished",
        "fresh",
        "group",
        "jitter",
        "missed",
        "name",
        "number",
        "patience",
        "paused",
        "period",
        "phase",
        "placed",
        "preparation",
        "priority",
        "remaining",
        "results",
        "started",
        "wanted",
    )

    def __init__(self, name: str, period: float, *, phase: float | None = None, cost: float = 0.0) -> None:
        if not SHORTEST_PERIOD <= period <= LONGEST_PERIOD:
            bounds = f"{SHORTEST_PERIOD:g} to {LONGEST_PERIOD:g} s"
            raise InvalidCommand(f"poll group {name!r}: a period is {bounds}, not {period!r}")
        if phase is not None and not 0 <= phase < period:
            raise InvalidCommand(f"poll group {name!r}: a phase is at least 0 s and below the period, not {phase!r}")
        self.name = name
        self.period = period
        # A group that is read once an hour must not wait for an hour behind groups with shorter periods.
        self.patience = min(period, LONGEST_PATIENCE)
        self.phase = phase
        self.cost = cost
        self.priority = POLL
        self.results: Sequence[Transaction] = ()
        # The members of the next cycle, if they differ: a running cycle keeps its own.
        self.fresh: Sequence[Transaction] | None = None
        self.preparation: Iterator[int] | None = None
        self.group: Any = None
        self.base = 0.0
        self.number = 0
        self.due = inf
        self.active = False
        self.placed = False
        self.paused = False
        self.wanted = False
        self.remaining = 0
        self.started = self.finished = -inf
        self.cycles = 0
        self.missed = 0
        self.jitter = Histogram()

    @property
    def running(self) -> bool:
        """True while its last cycle is running."""
        return self.remaining > 0

    def next_due(self) -> float:
        """Return when its next cycle is due on the grid."""
        return self.base + self.number * self.period


TOO_LATE = "allow more time; bus.statistics() and busmaster plan show what delays it"

HELD = "flow control holds the port or the adapter is stuck; check CTS, replug"


def make_error(kind: type[BusError], what: str, transaction: Transaction, hint: str | None = None) -> BusError:
    """Return the error of this kind for a transaction, with the hint of the kind if none is given."""
    return name_error(kind(what, hint=hint), transaction)


def name_error(error: BusError, transaction: Transaction) -> BusError:
    """Add the node, the command and the number of attempts to an error, and return it."""
    error.name(transaction.node)
    error.command = str(transaction.command)
    error.attempts = transaction.attempts
    return error


def too_late(transaction: Transaction, now: float, *, held: bool = False) -> BusError:
    """Return the error for a transaction whose caller's time has passed. It reports whether the request was sent.

    `held`: the port has not sent all bytes of this or the previous request, and may still send them.
    """
    # In the error, because "too late" alone does not show whether the line or the node was slow.
    waited = (now - transaction.queued) * 1000
    if not transaction.attempts:
        what = f"not sent within its time: it waited {waited:.0f} ms for the line"
        return make_error(NotStarted, what, transaction, HELD if held else None)
    # After the request was sent, NotStarted would be wrong: the drive may have acted on it.
    kind = WriteUnconfirmed if transaction.writes else NoReply
    what = "the port did not send it within its time" if held else "sent, but not answered within its time"
    error = make_error(kind, f"{what}: {waited:.0f} ms", transaction)
    if kind is NoReply:
        error.hint = HELD if held else TOO_LATE
    return error


def hold_ended(transaction: Transaction, hold: Hold) -> BusError:
    """Return the error for the remaining requests of a sequence whose time has passed."""
    over = f"the sequence has ended: its {hold.longest:g} s have passed"
    if transaction.attempts:
        return make_error(NoReply, f"not answered, and {over}", transaction)
    return make_error(HoldEnded, over, transaction)
