"""The authorisation of a line for writes from outside."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, replace
from math import inf
from types import TracebackType
from typing import Any, Protocol, TypeAlias

from busmaster import (
    Bus,
    BusError,
    InvalidCommand,
    NodeDown,
    NotStarted,
    Point,
    Refused,
    Superseded,
    VerifyFailed,
    WriteUnconfirmed,
    ext,
)
from busmaster.app.bounds import MOST_AT_ONCE
from busmaster.app.service.permission import EVERYTHING, Access, Permission
from busmaster.app.service.record import Outcome, WriteRecord, cut, this_user
from busmaster.app.service.refusals import Refusals
from busmaster.ext import Command

FRESH = 1.0
"""Seconds for which a command without an expiry time may wait."""
LARGEST_KEPT = 1e100
"""Largest number that is stored as a number. Larger ones are invalid, and stored as text."""
NEVER_SENT = (ArithmeticError, TypeError, ValueError, RecursionError)
"""Exceptions for values that cannot be encoded into a frame, including InvalidCommand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WriteRequest:
    """A write that a client requests.

    `arrived`: time of arrival, by the bus's clock; None if a user waits for the result. `expires`: time after which the
    write is not valid, in seconds since 1970; None for no limit. `command`: the command that a program would send,
    which is checked against its `permission`; None if the interface's own list permits the point.
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
"""Result when an audit entry is on the disk: "", or the reason why it is not. None if that is not awaited."""
Keep: TypeAlias = Callable[[WriteRequest, Outcome, str, Any, float], tuple[WriteRecord, Durable]]
"""Stores an audit entry: the request, its outcome and the reason, the value before, and the duration in seconds."""


class SafeWrites(Protocol):
    """The safe state of a line."""

    @property
    def values(self) -> Mapping[str, float]:
        """Return the value of each point, by name; empty if there is no safe state."""
        ...

    def refusal(self, permission: Permission, /) -> str:
        """Return why a client may not send it, "" if it may."""
        ...

    async def enter(
        self, authorisation: Authorisation, by: str, /, *, leaving: bool = True
    ) -> Mapping[str, BusError | None]:
        """Send it, and return by point why it was not confirmed, None if it was."""
        ...


class WriteInProgress:
    """One write in progress, for `with`: every end is stored in the audit log. Exceptions are raised again."""

    def __init__(self, request: WriteRequest, now: Callable[[], float], keep: Keep) -> None:
        self.record: WriteRecord | None = None
        """None until it has ended."""
        self._durable: Durable = None
        self._write_request = request
        self._now = now
        self._keep = keep
        self._began = now()
        self._before = _before(request.point)

    def __enter__(self) -> WriteInProgress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.end(error)

    def end(self, error: BaseException | None) -> None:
        """Store the audit entry with the error, or None for a confirmed write."""
        outcome, text = outcome_of(error)
        took = self._now() - self._began
        self.record, self._durable = self._keep(self._write_request, outcome, text, self._before, took)

    async def not_durable(self) -> str:
        """Wait until the audit entry of a write is on the disk, if an output requires that before the acknowledgement.
        Return the reason why it is not, "" if it is or no output requires it.
        """
        why = "" if self._durable is None else await self._durable
        return f"the value was written, but its audit entry is not on the disk: {why}" if why else ""


def outcome_of(error: BaseException | None) -> tuple[Outcome, str]:
    """Return the outcome of a write that ended with this error, and the reason."""
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
            return Outcome.REFUSED, f"the value cannot be sent: {error}"  # before a frame was made of it
        case _:
            return Outcome.UNCONFIRMED, "the program cancelled the write before it ended"


class Authorisation:
    """Checks the writes of all interfaces of one line. `read_only` rejects every write, and so does `leaving`.

    `record` is called with each audit entry.

    `write` raises nothing except for a cancellation. Every request results in an audit entry.
    """

    def __init__(self, bus: Bus, *, read_only: bool = False, access: Access | None = None) -> None:
        self.read_only = read_only
        self.leaving = False
        self._access = access or Access()
        self.safe_state: SafeWrites | None = None
        """The safe state of the line's file; None for a line without a file."""
        self.on_access: list[Callable[[], None]] = []
        """Called when roles or tokens have changed."""
        self.record: Callable[[WriteRecord], Durable] = lambda _: None
        self.refusals = Refusals()
        """Connections and logins that were refused, at whatever interface."""
        self.bus = bus
        self._log = logging.getLogger("busmaster.audit")
        if not self._log.handlers:  # all services of a process share it
            self._log.addHandler(logging.NullHandler())
        self._user = this_user()
        self._running: dict[str, int] = {}

    @property
    def access(self) -> Access:
        """Return the permissions of other programs. Setting it calls the functions in `on_access`."""
        return self._access

    @access.setter
    def access(self, access: Access) -> None:
        self._access = access
        for report in self.on_access:
            report()

    def take_secrets(self, secrets: Mapping[str, bytes]) -> None:
        """Replace the tokens: digests by name."""
        self.access = replace(self.access, secrets=secrets)

    def refusal(self, request: WriteRequest) -> str:
        """Return why a write is not permitted, "" if it is."""
        if self.leaving:
            return "the line is closing; nothing was sent"
        if self.read_only:
            return "this line is read-only"
        if request.point is None:
            return "the line's file does not permit this write; add the point to allow_commands"
        if request.command is not None and (refusal := request.permission.refusal(request.point.node, request.command)):
            return refusal
        if self._left(request) <= 0:
            return "the command has expired; nothing was sent"
        if self._running.get(request.interface, 0) >= MOST_AT_ONCE:
            return f"{MOST_AT_ONCE} commands are already being written; wait for them"
        return ""

    async def write(self, request: WriteRequest) -> WriteRecord:
        """Write it, unless it is refused, and return the audit entry."""
        in_progress = self.begin(request)
        try:
            with in_progress:
                if refusal := self.refusal(request):
                    raise InvalidCommand(refusal)
                await self._pass(request)
        except (BusError, *NEVER_SENT):
            pass  # it is in the audit log
        assert in_progress.record is not None
        if why := await in_progress.not_durable():
            return in_progress.record._replace(outcome=Outcome.UNCONFIRMED, error=cut(why))
        return in_progress.record

    def begin(self, request: WriteRequest) -> WriteInProgress:
        """Begin a write of this process itself: its safe state, or a write from its command line.

        It is not checked here. The caller does the write within `with`, and it is stored in the audit log.
        """
        return WriteInProgress(request, self.bus.now, self._keep)

    def refuse(self, request: WriteRequest, error: str) -> WriteRecord:
        """Store the audit entry of a write that was refused before it began."""
        return self._keep(request, Outcome.REFUSED, error, _before(request.point), 0.0)[0]

    async def _pass(self, request: WriteRequest) -> None:
        assert request.point is not None
        self._running[request.interface] = self._running.get(request.interface, 0) + 1
        try:
            left = self._left(request)
            await request.point.write(request.value, start_within=None if left == inf else max(0.0, left))
        finally:
            self._running[request.interface] -= 1

    def _left(self, request: WriteRequest) -> float:
        """Return for how many seconds the write may still wait; inf if a user waits for the result."""
        if request.expires is not None:
            return request.expires - time.time()
        return inf if request.arrived is None else request.arrived + FRESH - self.bus.now()

    def _keep(
        self, request: WriteRequest, outcome: Outcome, error: str, before: Any, took: float
    ) -> tuple[WriteRecord, Durable]:
        record = WriteRecord(
            time=self.bus.wall_time(),
            interface=request.interface,
            by=cut(request.by),
            user=self._user,
            process=os.getpid(),
            point=cut(request.name),
            before=before,
            value=_shown(request.value),
            outcome=outcome,
            error=cut(error),
            took=took,
            id=request.id,
        )
        # an unconfirmed write has an unknown result, which the user must check
        level = logging.WARNING if outcome is Outcome.UNCONFIRMED else logging.INFO
        self._log.log(level, "%s", record.text)
        return record, self.record(record)


def _before(point: Point[Any] | None) -> Any:
    """Return the last value that was read, None if it may have changed since."""
    return None if point is None else ext.last_value(point)


def _shown(value: Any) -> Any:
    """Return the value in the form of an audit entry."""
    if isinstance(value, bytes):  # a command that was not decoded: unchanged, except for control characters
        return cut(repr(value.decode(errors="replace"))[1:-1])
    return value if isinstance(value, int | float) and abs(value) < LARGEST_KEPT else cut(repr(value))
