"""Transactions: a command with its caller, priority and retries; polls, which run theirs once a period; and the errors
with which they end: a fresh one each, which says which node, which command and how often.
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
from busmaster.bounds import LONGEST_PERIOD, SHORTEST_PERIOD
from busmaster.contract.exchange import Command
from busmaster.contract.timing import Timings
from busmaster.errors import BusError, HoldEnded, InvalidCommand, NoReply, NotStarted, WriteUnconfirmed

LONGEST_PATIENCE = 10.0
"""Seconds after which a poll's cycle goes before those that came later, however long its period is."""


class Priority(enum.IntEnum):
    """The classes of R9, strict: a lower number goes first."""

    URGENT = 0
    COMMAND = 1
    POLL = 2
    BACKGROUND = 3


URGENT, COMMAND, POLL, BACKGROUND = Priority


class Phase(enum.Enum):
    """Where a transaction is. A write is PARKED while an earlier write to its node is not over (R7).

    What is FAILING waited for a line that can no longer be used: it ends next, and is never sent (R13).
    """

    IDLE = "idle"
    QUEUED = "queued"
    PARKED = "parked"
    ON_WIRE = "on wire"
    FAILING = "failing"
    ENDED = "ended"


IDLE, QUEUED, PARKED, ON_WIRE, FAILING, ENDED = Phase
LEFT = "the line is being left: only its safe state is still written"
"""Why a write is superseded that is not of the safe state, once that is being sent."""


class Timeline(NamedTuple):
    """Why it took as long as it did. Times are the bus's clock, in seconds; None for what did not happen."""

    queued: float
    started: float | None
    """When its last attempt began to be sent."""
    first_byte: float | None
    last_byte: float | None
    attempts: int
    exchanges_ahead: int
    """Exchanges of others that went first while it waited."""
    quiet_time_ahead: float
    """Seconds of that wait in which the line was resynchronising after somebody's uncertain outcome."""


class Transaction:
    """One command on its way. Made by the caller, changed by the arbiter alone, ended exactly once (R8)."""

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
    """By which it wants to be answered."""
    exchanges_ahead: int
    quiet_time_ahead: float
    late: bool
    """The reply to its last attempt began after `late_after`."""
    overdue: bool
    """It began after its window even."""
    # Those above are set when it is queued, or sent, and not before; and a string behind a statement of a function is
    # an instruction that does nothing. Each costs, and this is done for every request.
    finish_by: float
    """Its caller waits no longer, and nothing is sent from then on."""
    client: LineClient | None
    """Whose request it is; None is the program that owns the line."""
    check: bool
    """It is asked for the sake of its answer's likeness alone (R15): nobody waits for it, nothing counts it."""
    touches: object
    """What a write changes, for its owner to know."""
    stop: bool
    """It stops its node, or is of its safe state: writing it once is as good as writing it twice."""
    stops_alike: tuple[Transaction, ...]
    """Equal stops that waited when this one was sent, and get its outcome."""
    unsure: bool
    """An attempt was sent whose outcome is not known: it may have been carried out (R7)."""

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
            self.retries = 0  # whatever number was given: that alone does not make a write repeatable
        else:
            self.retries = node.retries if retries is None else retries
        self.start_by = start_by
        self.finish_by = finish_by
        if finish_by < inf:
            # a start_by is met by what starts right at it, but at finish_by nothing is sent any more
            self.start_by = min(start_by, nextafter(finish_by, -inf))
        self.tag = tag
        self.poll = poll
        self.stop = stop
        self.stops_alike: tuple[Transaction, ...] = ()
        self.client = client
        self.probe = probe
        self.check = False
        self.touches = touches
        self.refused_until = -inf
        self.refused_cycles = 0
        self.reset()

    def reset(self) -> None:
        """Make it fresh for its (next) run: a poll's transaction lives as long as the poll."""
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
        self.started = self.first_byte = self.last_byte = self.ended_at = -inf

    def timings(self) -> Timings:
        """Return the times of the next attempt: a learned window only for a read that is repeated if it is over."""
        # AT_LAST unless a case below says otherwise: the last attempt uses the documented window (R15).
        node, hurry = self.node, AT_LAST
        if node.learning is None:
            return node.timings
        # A check is made as a probe is, but nobody waits for it: a learned window will do.
        if node.failures or node.health is UNKNOWN or node.health is DOWN or self.probe != self.check:
            hurry = NEVER
        elif self.writes and node.profile.acks_are_commands:
            hurry = NEVER  # a late ACK would make whichever drive is asked meanwhile say something more
        elif self.check or (self.retried < self.retries and not self.writes and self.retried < 2):
            hurry = AGAIN if self.retried else AT_FIRST
        return node.learning.timings(self.command, node.timings, hurry)

    def timeline(self) -> Timeline:
        """Return when its steps happened, None for those that did not, and what went ahead of it."""

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
    """Transactions that are run once a period, on the grid base + k x period.

    `cost` is the line time of one cycle in seconds, for the choice of phases. `results` are its transactions: they
    hold the outcome of the last cycle until the next one starts. `preparation`, if there is one, is work that gives it
    its transactions and its cost: each step yields how many units it took, of about a microsecond. A poll that was
    removed is not added again.
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
        self.patience = min(period, LONGEST_PATIENCE)
        self.phase = phase
        self.cost = cost
        self.priority = POLL
        self.results: Sequence[Transaction] = ()
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
        """Whether its last cycle still runs."""
        return self.remaining > 0

    def next_due(self) -> float:
        """Return when its next cycle is due on the grid."""
        return self.base + self.number * self.period


TOO_LATE = "allow more time, or see bus.statistics(), or busmaster plan, for what holds it up"

HELD = "flow control holds the port or the adapter is stuck; check CTS, replug"


def make_error(kind: type[BusError], what: str, transaction: Transaction, hint: str | None = None) -> BusError:
    """Return the error of this kind for a transaction, with the hint of the kind if none is given."""
    return name_error(kind(what, hint=hint), transaction)


def name_error(error: BusError, transaction: Transaction) -> BusError:
    """Say in an error which node, which command and how often, and return it."""
    error.name(transaction.node)
    error.command = str(transaction.command)
    error.attempts = transaction.attempts
    return error


def too_late(transaction: Transaction, now: float, *, held: bool = False) -> BusError:
    """Return the error of a transaction whose caller's time is over: whether it was sent is what the error says.

    `held`: the port has not sent all that it was handed, this request or the one before it, and may still do.
    """
    # In the error, because "too late" alone does not tell whether the line or the node was slow.
    waited = (now - transaction.queued) * 1000
    if not transaction.attempts:
        what = f"not sent within its time: it waited {waited:.0f} ms for the line"
        return make_error(NotStarted, what, transaction, HELD if held else None)
    kind = WriteUnconfirmed if transaction.writes else NoReply
    what = "the port did not send it within its time" if held else "sent, but not answered within its time"
    error = make_error(kind, f"{what}: {waited:.0f} ms", transaction)
    if kind is NoReply:
        error.hint = HELD if held else TOO_LATE
    return error


def hold_ended(transaction: Transaction, hold: Hold) -> BusError:
    """Return the error of what a sequence still waits for when the line is no longer held for it."""
    over = f"the {hold.longest:g} s for which the line was held for it are over"
    if transaction.attempts:
        return make_error(NoReply, f"not answered, and {over}", transaction)
    return make_error(HoldEnded, over, transaction)
