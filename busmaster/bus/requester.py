"""The interface of a node for handles and points, wherever its line is, and the options of requests."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Any, Protocol, TypedDict, TypeVar, Unpack, cast

from busmaster.arbiter.transaction import COMMAND, Priority
from busmaster.bus.limits import Limit
from busmaster.bus.samples import Sample
from busmaster.contract.arguments import seconds, whole_number
from busmaster.contract.bounds import MOST_RETRIES
from busmaster.contract.exchange import Command
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import InvalidCommand, NoReply, NotStarted, WriteUnconfirmed
from busmaster.planning.merging import Merge

__all__ = [
    "ORDINARY",
    "CommandOptions",
    "NodeSource",
    "Priority",
    "ReadOptions",
    "RequestOptions",
    "Requester",
    "SeveralRequests",
    "WriteOptions",
    "checked_priority",
    "checked_retries",
]

T = TypeVar("T")


def checked_priority(value: Priority | int) -> Priority:
    """Return a priority from a Priority or its number. Raises InvalidCommand for any other value."""
    if isinstance(value, Priority):
        return value
    return Priority(whole_number(value, min(Priority), max(Priority), "a priority"))


def checked_retries(value: int) -> int:
    """Return `value` as an int. Raises InvalidCommand unless it is 0 to 100."""
    return whole_number(value, 0, MOST_RETRIES, "retries")


class ReadOptions(TypedDict, total=False):
    """Keyword arguments of reading methods; see `RequestOptions`. None is the same as omitted."""

    priority: Priority | None
    start_within: float | None
    finish_within: float | None
    retries: int | None


class CommandOptions(ReadOptions, total=False):
    """Keyword arguments of methods that run one command."""

    idempotent: bool | None
    safe: bool | None


class WriteOptions(CommandOptions, total=False):
    """Keyword arguments of a handle's `write`."""

    verify: bool | None


# Frozen, because most requests share the one object `ORDINARY`.
@dataclass(frozen=True, slots=True)
class RequestOptions:
    """Options of a request. Raises InvalidCommand for invalid values.

    `priority`: its class, a Priority or its number. `start_within`: seconds after which an unsent request fails with
    NotStarted; applies to each exchange if a call takes several. `finish_within`: seconds for the whole call. After
    that the caller gets NotStarted if nothing was sent, or NoReply if a read was sent and has no reply yet. If a write
    or a part of it was sent, the outcome is unknown, and the caller gets WriteUnconfirmed. An exchange on the wire is
    finished without its caller and not repeated. `retries`: 0 to 100, instead of the node's. `idempotent`: a write may
    be repeated after an unknown outcome (R7), instead of the command's own setting. `verify`: a handle's `write` reads
    the value back and raises VerifyFailed if it differs. `safe`: the write belongs to the safe state in which a line is
    left. It is accepted when other writes are not (`ext.take_only_safe_writes`) and is not limited.
    """

    priority: Priority = COMMAND
    start_within: float | None = None
    finish_within: float | None = None
    retries: int | None = None
    idempotent: bool | None = None
    verify: bool = False
    safe: bool = False

    def __post_init__(self) -> None:
        # A bare 0 is not the member URGENT, and such a write would bypass R7.
        if type(self.priority) is not Priority:
            object.__setattr__(self, "priority", checked_priority(self.priority))
        if self.start_within is not None:
            seconds(self.start_within, "start_within")
        if self.finish_within is not None:
            seconds(self.finish_within, "finish_within")
        if self.retries is not None:
            checked_retries(self.retries)

    @classmethod
    def of(cls, given: WriteOptions | CommandOptions | ReadOptions, label: str) -> RequestOptions:
        """Return the options of a caller. Raises InvalidCommand with the node's name for invalid options."""
        chosen = cast("dict[str, Any]", {name: value for name, value in given.items() if value is not None})
        try:
            return cls(**chosen)
        except InvalidCommand as bad:
            raise InvalidCommand(f"{label}: {bad}") from None


ORDINARY = RequestOptions()
"""The options of a caller that gave none."""


class Requester(Protocol):
    """One node of a line. Implemented by `Node`, and by objects that pass requests to the process that owns the
    line."""

    @property
    def line(self) -> str:
        """Return the name of the line's port."""
        ...

    @property
    def label(self) -> str:
        """Return its name in messages: "node 5"."""
        ...

    @property
    def address(self) -> int:
        """Return the node's address in its protocol."""
        ...

    @property
    def profile(self) -> Profile:
        """Return the profile of the node's protocol."""
        ...

    @property
    def stops(self) -> int:
        """Return the number of stop commands to this node, by any handle of any program."""
        ...

    def note_stop(self) -> None:
        """Count a stop command, so that a write decided before it cannot undo it."""
        ...

    def now(self) -> float:
        """Return the time of the line's clock, in seconds."""
        ...

    def latest(self, point: Hashable, /) -> Sample[Any] | None:
        """Return the newest good sample of a point in any poll group. None if a write has made it stale."""
        ...

    def merge_reads(self, merge: Merge, /) -> None:
        """Replace the merge of this node's profile. Poll groups use it for this node's reads from now on."""
        ...

    def use_sync_reads(self, probe: Command[Any] | None, sync_reads: Sequence[Command[Any]], /) -> None:
        """Replace the probe and the sync reads of its profile. None or an empty sequence keeps those of the profile."""
        ...

    def limit(self, limit: Limit, /) -> None:
        """Add a limit: reject every write that violates it, under any name of the quantity."""
        ...

    def check(self, *commands: Command[Any], stop: bool | None = None) -> None:
        """Raise InvalidCommand if one of these writes violates a limit, before the first of several is sent.

        A `stop` is not limited.
        """
        ...

    async def request(
        self,
        command: Command[T],
        /,
        *,
        touches: Command[Any] | None = None,
        stops_seen: int | None = None,
        stop: bool = False,
        **options: Unpack[CommandOptions],
    ) -> T:
        """Run one command and return its value. A command that stops the node (`stop`) is not limited.

        `touches`: the command that reads what the write changes. Samples of it that are older than the write become
        stale; by default all samples of the node do. `stops_seen`: if the node was sent a stop since `stops` had this
        value, raise Superseded and send nothing. Raises a BusError subclass. Cancelling it frees the caller immediately
        and does not disturb the line (R6).
        """
        ...

    def exclusive(self, *, max_hold: float = 0.5) -> AbstractAsyncContextManager[Requester]:
        """Return this node for an exclusive sequence of requests, for `async with`. Only urgent requests go between
        them.

        The line is held from the first request until the block is left, for at most `max_hold` seconds (up to 5). An
        exchange that is then on the wire is finished. Later requests in the block raise HoldEnded and are not sent.
        Only requests to the node returned for the block belong to the sequence; all other requests, of this program
        too, wait.
        """
        ...


class NodeSource(Protocol):
    """An object that has nodes: a bus, wherever its line is."""

    def node(
        self, profile: Profile, address: int, /, *, timings: Timings | Learned | None = None, retries: int | None = None
    ) -> Requester:
        """Return the node at this address, as `Bus.node` does. Raises InvalidCommand."""
        ...


class SeveralRequests:
    """The requests of one call, one after the other. `finish_within` applies to all of them together.

    If a part is written and the rest cannot be sent, the call raises WriteUnconfirmed: NotStarted would mean that
    nothing was sent. Raises InvalidCommand for a write to all nodes with `verify`.
    """

    def __init__(self, node: Requester, given: WriteOptions | ReadOptions) -> None:
        self._node = node
        chosen = RequestOptions.of(given, node.label) if given else ORDINARY
        # Before the first write: an error after it would leave the caller with written values.
        if chosen.verify and node.address == node.profile.broadcast:
            raise InvalidCommand(f"{node.profile.name}: a write to all cannot be verified: no node replies to a read")
        self.verify = chosen.verify
        self._finish_by = None if chosen.finish_within is None else node.now() + chosen.finish_within
        # A node rejects `verify`, and `finish_within` is calculated again for each request from the remaining time.
        several = {name: value for name, value in given.items() if name not in ("verify", "finish_within")}
        self._options = cast("CommandOptions", several)
        self._reading: CommandOptions = {"priority": chosen.priority} if given else {}
        self._written = False

    async def request(self, command: Command[T], *, touches: Command[Any] | None = None) -> T:
        """Run the next command. Raises as `Requester.request` does."""
        value = await self._in_time(command, self._options, "only a part of it was written", touches)
        self._written = self._written or command.writes
        return value

    async def read_back(self, command: Command[T]) -> T:
        """Read the written value back, with the call's priority and within its time."""
        return await self._in_time(command, self._reading, "acknowledged, but not read back")

    async def _in_time(
        self, command: Command[T], options: CommandOptions, so_far: str, touches: Command[Any] | None = None
    ) -> T:
        if self._finish_by is not None:
            # Not below 0, which is rejected as a mistake of the caller: the request then ends with NotStarted.
            options = {**options, "finish_within": max(0.0, self._finish_by - self._node.now())}
        try:
            return await self._node.request(command, touches=touches, **options)
        except (NotStarted, NoReply) as error:
            in_time = self._finish_by is None or self._node.now() < self._finish_by
            # The first request's error is exact. A later NotStarted would mean that nothing at all was sent.
            if not self._written or (in_time and isinstance(error, NoReply)):
                raise
            what = f"{so_far}, then: {error.what}"
            raise WriteUnconfirmed(what, node=self._node, command=error.command, attempts=error.attempts) from error
