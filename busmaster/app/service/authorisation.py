"""The one authorisation of a line for what comes from outside."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, replace
from math import inf
from types import TracebackType
from typing import Any, Protocol, TypeAlias

from busmaster import Bus, Point, ext
from busmaster.app.service.permission import EVERYTHING, Access, Permission
from busmaster.app.service.record import Outcome, WriteRecord, cut, this_user
from busmaster.app.service.refusals import Refusals
from busmaster.bounds import MOST_AT_ONCE
from busmaster.errors import (
    BusError,
    InvalidCommand,
    NodeDown,
    NotStarted,
    Refused,
    Superseded,
    VerifyFailed,
    WriteUnconfirmed,
)
from busmaster.ext import Command

FRESH = 1.0
"""Seconds for which a command may wait that does not say until when it is meant."""
LARGEST_KEPT = 1e100
"""Of what is kept as a number; beyond it nobody means one, and its text is kept."""
NEVER_SENT = (ArithmeticError, TypeError, ValueError, RecursionError)
"""What is raised of values of which no frame can be made, InvalidCommand among them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """What somebody outside wants to have written.

    `arrived` is when it came, by the bus's clock; None of a person who waits for its end. `expires` is when it is no
    longer meant, in seconds since 1970; None where it does not say so. `command` is what a program would have sent,
    which is held against its `permission`; None where the interface's own list has named the point.
    """

    interface: str
    by: str
    name: str
    point: Point[Any] | None
    value: Any
    arrived: float | None = None
    expires: float | None = None
    id: str = ""
    command: Command[Any] | None = None
    permission: Permission = EVERYTHING


Durable: TypeAlias = Awaitable[str] | None
"""What is done when an audit entry is on the disk: "", or the reason why it is not. None where that is not awaited."""
Keep: TypeAlias = Callable[[Wish, Outcome, str, Any, float], tuple[WriteRecord, Durable]]
"""Keeps a record: of what was wished, what became of it and why, the value before, and the seconds that it took."""


class SafeWrites(Protocol):
    """The safe state of a line."""

    @property
    def values(self) -> Mapping[str, float]:
        """Return the value of each of its points, by its name; of no point where there is no safe state."""
        ...

    def refusal(self, permission: Permission, /) -> str:
        """Return why somebody may not have it sent, "" if he may."""
        ...

    async def enter(
        self, authorisation: Authorisation, by: str, /, *, leaving: bool = True
    ) -> Mapping[str, BusError | None]:
        """Send it, and return by point why it was not confirmed, None if it was."""
        ...


class Passage:
    """One write on its way, in `with`: however that ends, a record is kept of it. What is raised is raised on."""

    def __init__(self, wish: Wish, now: Callable[[], float], keep: Keep) -> None:
        self.record: WriteRecord | None = None
        """None until it has ended."""
        self._durable: Durable = None
        self._wish = wish
        self._now = now
        self._keep = keep
        self._began = now()
        self._before = _before(wish.point)

    def __enter__(self) -> Passage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.end(error)

    def end(self, error: BaseException | None) -> None:
        """Keep its record: what it ended with, None for a write that is confirmed."""
        outcome, text = outcome_of(error)
        took = self._now() - self._began
        self.record, self._durable = self._keep(self._wish, outcome, text, self._before, took)

    async def not_durable(self) -> str:
        """Wait until the audit entry of a write is on the disk, where an output must have it there before the write is
        acknowledged. Return the reason why it is not, "" if it is or nothing is to be awaited.
        """
        why = "" if self._durable is None else await self._durable
        return f"it was written, but its audit entry is not on the disk: {why}" if why else ""


def outcome_of(error: BaseException | None) -> tuple[Outcome, str]:
    """Return what became of a write that ended so, and why."""
    match error:
        case None:
            return Outcome.WRITTEN, ""
        case InvalidCommand() | Refused():
            return Outcome.REFUSED, str(error)
        case NotStarted() | Superseded() | NodeDown():
            return Outcome.NOT_STARTED, error.what
        case BusError():
            sent = error.attempts or isinstance(error, WriteUnconfirmed | VerifyFailed)
            return Outcome.UNCONFIRMED if sent else Outcome.NOT_STARTED, error.what
        case ArithmeticError() | TypeError() | ValueError() | RecursionError():
            return Outcome.REFUSED, f"this cannot be sent: {error}"  # before a frame was made of it
        case _:
            return Outcome.UNCONFIRMED, "the program gave up before it was done"


class Authorisation:
    """What all interfaces of one line pass. `read_only` lets no write through, nor does it once the line is `leaving`.

    `record` is told of every one.

    `write` never raises but when it is cancelled: whatever somebody sends, it ends as a record.
    """

    def __init__(self, bus: Bus, *, read_only: bool = False, access: Access | None = None) -> None:
        self.read_only = read_only
        self.leaving = False
        self._access = access or Access()
        self.safe_state: SafeWrites | None = None
        """What the line's file calls safe; None of a line without a file."""
        self.on_access: list[Callable[[], None]] = []
        """Called when other roles or tokens hold."""
        self.record: Callable[[WriteRecord], Durable] = lambda _: None
        self.refusals = Refusals()
        """Connections and logins that were refused, at whatever interface."""
        self.bus = bus
        self._log = logging.getLogger("busmaster.audit")
        self._log.addHandler(logging.NullHandler())
        self._user = this_user()
        self._running: dict[str, int] = {}

    @property
    def access(self) -> Access:
        """Return what other programs may do. Those of `on_access` are told when it is set."""
        return self._access

    @access.setter
    def access(self, access: Access) -> None:
        self._access = access
        for tell in self.on_access:
            tell()

    def take_secrets(self, secrets: Mapping[str, bytes]) -> None:
        """Have these tokens hold from now on, and no other: their digests by their names."""
        self.access = replace(self.access, secrets=secrets)

    def refusal(self, wish: Wish) -> str:
        """Return why it is not let through, "" if it is."""
        if self.leaving:
            return "the line is being left: nothing was sent"
        if self.read_only:
            return "this line is read-only"
        if wish.point is None:
            return "the line's file does not allow this: see allow_commands"
        if wish.command is not None and (refusal := wish.permission.refusal(wish.point.node, wish.command)):
            return refusal
        if self._left(wish) <= 0:
            return "it is too old: nothing was sent"
        if self._running.get(wish.interface, 0) >= MOST_AT_ONCE:
            return f"{MOST_AT_ONCE} commands are being written already"
        return ""

    async def write(self, wish: Wish) -> WriteRecord:
        """Write it, unless it is refused, and return what became of it."""
        passage = self.begin(wish)
        try:
            with passage:
                if refusal := self.refusal(wish):
                    raise InvalidCommand(refusal)
                await self._pass(wish)
        except (BusError, *NEVER_SENT):
            pass  # it is in the record
        assert passage.record is not None
        if why := await passage.not_durable():
            return passage.record._replace(outcome=Outcome.UNCONFIRMED, error=cut(why))
        return passage.record

    def begin(self, wish: Wish) -> Passage:
        """Let pass what this process itself wishes: its safe state, or what a person writes on its command line.

        Nothing of it is refused here. The write is for the caller to do, within `with`; a record is kept of it.
        """
        return Passage(wish, self.bus.now, self._keep)

    def refuse(self, wish: Wish, error: str) -> WriteRecord:
        """Keep a record of what was not even tried."""
        return self._keep(wish, Outcome.REFUSED, error, _before(wish.point), 0.0)[0]

    async def _pass(self, wish: Wish) -> None:
        assert wish.point is not None
        self._running[wish.interface] = self._running.get(wish.interface, 0) + 1
        try:
            left = self._left(wish)
            await wish.point.write(wish.value, start_within=None if left == inf else max(0.0, left))
        finally:
            self._running[wish.interface] -= 1

    def _left(self, wish: Wish) -> float:
        """Return for how many seconds it may still wait; inf for one of a person who waits for its end."""
        if wish.expires is not None:
            return wish.expires - time.time()
        return inf if wish.arrived is None else wish.arrived + FRESH - self.bus.now()

    def _keep(self, wish: Wish, outcome: Outcome, error: str, before: Any, took: float) -> tuple[WriteRecord, Durable]:
        record = WriteRecord(
            time=self.bus.wall_time(),
            interface=wish.interface,
            by=cut(wish.by),
            user=self._user,
            process=os.getpid(),
            point=cut(wish.name),
            before=before,
            value=_shown(wish.value),
            outcome=outcome,
            error=cut(error),
            took=took,
            id=wish.id,
        )
        # of one that is unconfirmed somebody has to find out what became of it
        level = logging.WARNING if outcome is Outcome.UNCONFIRMED else logging.INFO
        self._log.log(level, "%s", record.text)
        return record, self.record(record)


def _before(point: Point[Any] | None) -> Any:
    """Return what it held when it was last read, None if that may not be so any more."""
    return None if point is None else ext.last_value(point)


def _shown(value: Any) -> Any:
    """Return the value as it fits into a record."""
    if isinstance(value, bytes):  # a command that was not read: as it came, but for what could harm a terminal
        return cut(repr(value.decode(errors="replace"))[1:-1])
    return value if isinstance(value, int | float) and abs(value) < LARGEST_KEPT else cut(repr(value))
