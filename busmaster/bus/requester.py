"""What handles and points need of a node, whoever owns its line; and the options that their coroutines take."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Any, Protocol, TypedDict, TypeVar, Unpack, cast

from busmaster.arbiter.transaction import COMMAND, Priority
from busmaster.bounds import MOST_RETRIES
from busmaster.bus.limits import Limit
from busmaster.bus.samples import Sample
from busmaster.contract.arguments import seconds, whole_number
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
    """Return the class that `value` is, or is the number of. Raises InvalidCommand for anything else."""
    return Priority(whole_number(value, min(Priority), max(Priority), "a priority"))


def checked_retries(value: int) -> int:
    """Return `value` as an int. Raises InvalidCommand unless it is 0 to 100."""
    return whole_number(value, 0, MOST_RETRIES, "retries")


class ReadOptions(TypedDict, total=False):
    """The keyword arguments of what reads: see `RequestOptions`. None is as good as left out."""

    priority: Priority | None
    start_within: float | None
    finish_within: float | None
    retries: int | None


class CommandOptions(ReadOptions, total=False):
    """The keyword arguments of what runs one command."""

    idempotent: bool | None
    safe: bool | None


class WriteOptions(CommandOptions, total=False):
    """The keyword arguments of a handle's `write`."""

    verify: bool | None


@dataclass(frozen=True, slots=True)
class RequestOptions:
    """How a request is to be made. Raises InvalidCommand for what is no such option.

    `priority`: its class, a Priority or its number. `start_within`, in seconds: NotStarted if it could not be sent by
    then; for each exchange, where a call takes several. `finish_within`, in seconds, for the call as a whole: a caller
    who gives up knows what became of it. NotStarted: nothing was sent. WriteUnconfirmed: a write, or a part of it, was
    sent, and how it ended is not known. NoReply: a read was sent, and not answered yet. What is on the wire by then
    runs out unheard, and is not repeated. `retries`, 0 to 100, in place of the node's. `idempotent`: whether a write
    may be repeated after an unknown outcome (R7), in place of what its command says. `verify`: a handle's `write`
    reads back what it wrote, and raises VerifyFailed if that differs. `safe`: this write is of the safe state in which
    a line is left, and accepted when no other is (`ext.take_only_safe_writes`); no limit of its point holds it.
    """

    priority: Priority = COMMAND
    start_within: float | None = None
    finish_within: float | None = None
    retries: int | None = None
    idempotent: bool | None = None
    verify: bool = False
    safe: bool = False

    def __post_init__(self) -> None:
        # A bare 0 is not the member URGENT: such a write would pass R7 by.
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
        """Return what a caller gave. Raises InvalidCommand, naming the node, for what is no such option."""
        chosen = cast("dict[str, Any]", {name: value for name, value in given.items() if value is not None})
        try:
            return cls(**chosen)
        except InvalidCommand as bad:
            raise InvalidCommand(f"{label}: {bad}") from None


ORDINARY = RequestOptions()
"""Those of a caller who gave none."""


class Requester(Protocol):
    """One node of a line. `Node` is one; so is whatever passes the requests on to the process that owns the line."""

    @property
    def line(self) -> str:
        """Return the name of the line's port."""
        ...

    @property
    def label(self) -> str:
        """Return what messages call it: "node 5"."""
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
        """Return how often it was told to stop, by whatever handle, of whatever program."""
        ...

    def note_stop(self) -> None:
        """Tell the line that this node is being told to stop: what was decided before must not undo it."""
        ...

    def now(self) -> float:
        """Return the time of the line's clock, in seconds."""
        ...

    def latest(self, point: Hashable, /) -> Sample[Any] | None:
        """Return the youngest good sample of a point in any poll group, unless a write has made it stale."""
        ...

    def merge_reads(self, merge: Merge, /) -> None:
        """Have poll groups propose `merge` for this node's reads from now on, in place of what its profile had."""
        ...

    def use_sync_reads(self, probe: Command[Any] | None, sync_reads: Sequence[Command[Any]], /) -> None:
        """Use these reads in place of its profile's; None or an empty sequence leaves what the profile has."""
        ...

    def limit(self, limit: Limit, /) -> None:
        """Refuse, from now on, every write beyond a limit, whatever names what it writes."""
        ...

    def check(self, *commands: Command[Any], stop: bool | None = None) -> None:
        """Raise InvalidCommand if one of these writes is beyond a limit: before the first of several is sent.

        A `stop` is held by no limit.
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
        """Run one command and return its value. One that stops the node (`stop`) is held by no limit.

        `touches` is the command that reads what a write changes: samples of that which are older than the write are
        marked stale; without it, all of the node's. With `stops_seen` it raises Superseded, and sends nothing, if the
        node was told to stop since `stops` was that. Raises a BusError subclass. Cancelling it frees the caller at once
        and never disturbs the line (R6).
        """
        ...

    def exclusive(self, *, max_hold: float = 0.5) -> AbstractAsyncContextManager[Requester]:
        """Return, for `async with`, this node for a sequence of requests: nothing but what is urgent comes between.

        From when the first of them is sent, the line is held until the block is left, `max_hold` seconds at most (up to
        5), to the end of the exchange that is on the wire then; what is asked in it later raises HoldEnded, and is not
        sent. Only what is asked of the node that the block is given is of the sequence: anything else, of this program
        too, waits.
        """
        ...


class NodeSource(Protocol):
    """What has nodes: a bus, wherever its line is."""

    def node(
        self, profile: Profile, address: int, /, *, timings: Timings | Learned | None = None, retries: int | None = None
    ) -> Requester:
        """Return the node at this address, as `Bus.node` does. Raises InvalidCommand."""
        ...


class SeveralRequests:
    """The requests of one call, one after the other, by the call's options: `finish_within` is for all of them.

    Once a part is written, what cannot be sent any more ends as WriteUnconfirmed: NotStarted would say that nothing
    was. Raises InvalidCommand for a write to all nodes that is to be verified.
    """

    def __init__(self, node: Requester, given: WriteOptions | ReadOptions) -> None:
        self._node = node
        chosen = RequestOptions.of(given, node.label) if given else ORDINARY
        if chosen.verify and node.address == node.profile.broadcast:
            raise InvalidCommand(f"{node.profile.name}: a write to all cannot be verified: nobody answers a read")
        self.verify = chosen.verify
        self._finish_by = None if chosen.finish_within is None else node.now() + chosen.finish_within
        several = {name: value for name, value in given.items() if name not in ("verify", "finish_within")}
        self._options = cast("CommandOptions", several)
        self._reading: CommandOptions = {"priority": chosen.priority} if given else {}
        self._written = False

    async def request(self, command: Command[T], *, touches: Command[Any] | None = None) -> T:
        """Run one more command. Raises as `Requester.request`."""
        value = await self._in_time(command, self._options, "only a part of it was written", touches)
        self._written = self._written or command.writes
        return value

    async def read_back(self, command: Command[T]) -> T:
        """Read what was written, by the call's priority and within its time."""
        return await self._in_time(command, self._reading, "acknowledged, but not read back")

    async def _in_time(
        self, command: Command[T], options: CommandOptions, so_far: str, touches: Command[Any] | None = None
    ) -> T:
        if self._finish_by is not None:
            options = {**options, "finish_within": max(0.0, self._finish_by - self._node.now())}
        try:
            return await self._node.request(command, touches=touches, **options)
        except (NotStarted, NoReply) as error:
            in_time = self._finish_by is None or self._node.now() < self._finish_by
            if not self._written or (in_time and isinstance(error, NoReply)):
                raise
            what = f"{so_far}, then: {error.what}"
            raise WriteUnconfirmed(what, node=self._node, command=error.command, attempts=error.attempts) from error
