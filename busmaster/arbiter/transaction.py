"""Transactions: a command with its caller, priority and retries."""

from __future__ import annotations

import enum
from math import inf, nextafter
from typing import TYPE_CHECKING, Any, NamedTuple

from busmaster.contract.exchange import Command
from busmaster.errors import BusError

if TYPE_CHECKING:
    from busmaster.arbiter.health import NodeRecord
    from busmaster.arbiter.schedule import Poll


class Priority(enum.IntEnum):
    """The classes of R9, strict: a lower number goes first."""

    URGENT = 0
    COMMAND = 1
    POLL = 2
    BACKGROUND = 3


URGENT, COMMAND, POLL, BACKGROUND = Priority


class Phase(enum.Enum):
    """Where a transaction is. A write is PARKED while an earlier write to its node is not over (R7)."""

    IDLE = "idle"
    QUEUED = "queued"
    PARKED = "parked"
    ON_WIRE = "on wire"
    ENDED = "ended"


IDLE, QUEUED, PARKED, ON_WIRE, ENDED = Phase


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
    settling_ahead: float
    """Seconds of that wait in which the line was settling after somebody's uncertain outcome."""


class Transaction:
    """One command on its way. Made by the caller, changed by the arbiter alone, ended exactly once (R8)."""

    __slots__ = (
        "attempts",
        "check",
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
        "phase",
        "poll",
        "priority",
        "probe",
        "probe_cost",
        "queued",
        "refusals",
        "refused_cycles",
        "refused_until",
        "retried",
        "retries",
        "settling_ahead",
        "start_by",
        "started",
        "superseded",
        "tag",
        "touches",
        "unsure",
        "value",
        "wanted",
        "writes",
    )

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
        *,
        tag: Any = None,
        poll: Poll | None = None,
    ) -> None:
        self.node = node
        self.command = command
        self.priority = priority
        self.writes = command.writes
        self.idempotent = command.idempotent if idempotent is None else idempotent
        if probe or (self.writes and not self.idempotent):
            self.retries = 0  # whatever number was given: that alone does not make a write repeatable
        else:
            self.retries = node.retries if retries is None else retries
        self.start_by = start_by
        self.finish_by = finish_by
        """Its caller waits no longer, and nothing is sent from then on."""
        if finish_by < inf:
            self.start_by = min(start_by, nextafter(finish_by, -inf))
        self.tag = tag
        self.poll = poll
        self.probe = probe
        self.check = False
        """It is asked for the sake of its answer's likeness alone (R15): nobody waits for it, nothing counts it."""
        self.touches: object = None
        """What a write changes, for its owner to know."""
        self.refused_until = -inf
        self.refused_cycles = 0
        self.reset()

    def reset(self) -> None:
        """Fresh for its (next) run: a poll's transaction lives as long as the poll."""
        self.phase = IDLE
        self.attempts = 0
        self.retried = 0
        self.refusals = 0
        self.probe_cost = 0.0
        self.wanted = True
        self.superseded = False
        self.unsure = False
        """An attempt was sent whose outcome is not known: it may have been carried out (R7)."""
        self.late = False
        self.deadline = inf
        self.value: Any = None
        self.error: BusError | None = None
        self.queued = 0.0
        self.started = self.first_byte = self.last_byte = self.ended_at = -inf
        self.exchanges_ahead = 0
        self.settling_ahead = 0.0

    def timeline(self) -> Timeline:
        def known(time: float) -> float | None:
            return None if time == -inf else time

        return Timeline(
            self.queued,
            known(self.started),
            known(self.first_byte),
            known(self.last_byte),
            self.attempts,
            self.exchanges_ahead,
            self.settling_ahead,
        )
