"""A node: one addressed device of a bus."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Hashable, Iterable, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from math import inf
from threading import get_ident
from typing import Any, Protocol, TypeVar, Unpack

from busmaster.arbiter.clients import Hold, LineClient
from busmaster.arbiter.counters import NodeStatistics
from busmaster.arbiter.health import Health, NodeRecord
from busmaster.arbiter.learned import LearnedTimes
from busmaster.arbiter.transaction import LEFT, Priority, Timeline, Transaction
from busmaster.bounds import LONGEST_SUSPENSION
from busmaster.bus.exclusive import HeldNode, checked_hold, hold_ended
from busmaster.bus.limiter import Limiter
from busmaster.bus.limits import Limit
from busmaster.bus.requester import ORDINARY, CommandOptions, Requester, RequestOptions
from busmaster.bus.samples import Sample
from busmaster.bus.shared_line import SharedLine
from busmaster.contract.arguments import seconds
from busmaster.contract.exchange import Command
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import BusError, InvalidCommand, Refused, Superseded
from busmaster.planning import PlannedNode
from busmaster.planning.merging import Merge
from busmaster.transport.pump import Waiter

T = TypeVar("T")
PROBE = RequestOptions(retries=0)
REPLIES_REMEMBERED = 256

__all__ = ["Health", "Journey", "Node", "NodeStatistics", "Priority", "Timeline"]


class HasNode(Protocol):
    """A handle, or a point."""

    @property
    def node(self) -> Requester: ...


class Journey:
    """How far one request has come."""

    transaction: Transaction | None = None

    @property
    def sent(self) -> bool:
        """Whether an attempt of it was handed to the line."""
        return self.transaction is not None and self.transaction.attempts > 0


class Node:
    """One node, made by `Bus.node` or by a handle. Everything that is asked of it goes through `request`."""

    def __init__(self, line: SharedLine, record: NodeRecord, asked: Timings | Learned | None = None) -> None:
        self.shared = line
        self.record = record
        self.timings = record.timings
        """As they were asked for: its record's lateness may have been raised since."""
        self._asked = Learned(record.timings) if isinstance(asked, Learned) else record.timings
        self.kinds: dict[Hashable, Command[Any]] = {}
        """Of each kind of command that was asked of it, the first: the worst case reckons with them."""
        self.reply_time: float | None = None
        """Seconds from a request to its reply, as poll groups measured them; before, as somebody said, or None."""
        self._measured = 0
        self._to_all = record.address == record.profile.broadcast
        """Nobody answers at its address."""
        self.kept = False
        """Whether the program that owns the line has named it itself."""
        self.borrowers = 0
        """How many have it who will give it back."""
        self.returning = asyncio.Lock()
        """Held while its hook runs."""
        self._on_return: Callable[[Node], Awaitable[None]] | None = None
        self._sync_reads: tuple[Command[Any] | None, tuple[Command[Any], ...]] = (None, ())
        """The probe and the sync reads that handles have set."""

    @classmethod
    def of(cls, owner: HasNode) -> Node:
        """Return the node behind a handle or a point: what more can be asked of it than by those.

        Raises InvalidCommand where its line is not this process's.
        """
        if not isinstance(owner.node, cls):
            raise InvalidCommand(f"{owner.node.label} is no node of a bus in this process")
        return owner.node

    @property
    def line(self) -> str:
        """Return the name of its line's port."""
        return self.record.line

    @property
    def profile(self) -> Profile:
        """Return the profile of the node's protocol."""
        return self.record.profile

    @property
    def address(self) -> int:
        """Return the node's address in its protocol."""
        return self.record.address

    @property
    def label(self) -> str:
        """Return how messages call it: "node 5"."""
        return self.record.label

    def rename(self, label: str) -> None:
        """Have messages call it so from now on."""
        self.shared.arbiter.name_node(self.record, label)

    @property
    def stops(self) -> int:
        """Return how often it was told to stop, by whatever handle."""
        return self.record.stops

    def note_stop(self) -> None:
        """Tell the line that this node is being told to stop: what was decided before must not undo it."""
        self.shared.note_stop(self.record)

    def now(self) -> float:
        """Return the time of the bus's clock, in seconds."""
        return self.shared.now()

    def latest(self, point: Any, /) -> Sample[Any] | None:
        """Return the youngest good sample of a point in any poll group, unless a write has made it stale."""
        return self.shared.latest(point)

    def held(self, point: Any, /) -> Any:
        """Return what a point of it would have read last, by whatever name it was polled, alone or with others.

        None where that is not known, or may have been written since.
        """
        return self.shared.held(self.record, point)

    def planned(self) -> PlannedNode:
        """Return the node as the planner sees it, with its reply time as measured so far."""
        record = self.record
        return PlannedNode(record.profile, record.address, record.timings, self.reply_time)

    def note_wait(self, wait: float) -> None:
        """Note that it took so many seconds to reply: the mean of the last replies is what planning goes by."""
        self._measured = min(self._measured + 1, REPLIES_REMEMBERED)
        known = wait if self.reply_time is None else self.reply_time
        self.reply_time = known + (wait - known) / self._measured

    @property
    def health(self) -> Health:
        """Return what is known of the node: up, suspect, down or unknown; offline while the line is lost."""
        return Health.OFFLINE if self.shared.condition.is_lost else self.record.health

    def __repr__(self) -> str:
        return f"<Node {self.profile.name} {self.address} {self.health.value}>"

    @property
    def on_return(self) -> Callable[[Node], Awaitable[None]] | None:
        """Return the hook that is awaited when the node is back from DOWN, before its polls resume.

        Parameters are re-sent in it. By default nothing is done: a master that enables a drive or repeats a reference
        by itself is a danger.
        """
        return self._on_return

    @on_return.setter
    def on_return(self, hook: Callable[[Node], Awaitable[None]] | None) -> None:
        self._on_return = hook
        self.shared.arbiter.expect_hook(self.record, hook is not None)

    def check_shared(self, profile: Profile, timings: Timings | Learned | None, retries: int | None) -> None:
        """Raise InvalidCommand where somebody asks for this node with anything else than it was first asked with.

        What is None was left open: a profile's `merge` too.
        """
        own = self.profile
        if profile is own and timings is None and retries is None:
            return
        if isinstance(timings, Learned):
            timings = timings.of(profile.timings)
        wanted = {
            f"other timings{_windows(timings, self._asked)}": timings not in (None, self._asked),
            f"other retries ({retries}, not {self.record.retries})": retries not in (None, self.record.retries),
            "another profile": profile != own or profile.merge not in (None, own.merge),
        }
        for what, differs in wanted.items():
            if differs:
                raise InvalidCommand(
                    f"{self.label} is in use already, and now asked for with {what}: "
                    "give all handles of an address the same options, or leave them out in all but the first"
                )

    def merge_reads(self, merge: Merge, /) -> None:
        """Have poll groups propose `merge` for this node's reads from now on, in place of what its profile had."""
        self.shared.arbiter.change_profile(self.record, replace(self.record.profile, merge=merge))

    def use_sync_reads(self, probe: Command[Any] | None, sync_reads: Sequence[Command[Any]], /) -> None:
        """Use these reads in place of its profile's; None or an empty sequence leaves what the profile has.

        The probe is sent to a node that may be dead; a sync read is sent where the line must prove that replies match
        requests. Raises InvalidCommand for a write, and if another handle of the node has set other ones.
        """
        before = self._sync_reads
        wanted = (probe or before[0], tuple(sync_reads) or before[1])
        for command in (probe, *sync_reads):
            if command is not None and getattr(command, "writes", False):
                raise InvalidCommand(f"{self.label}: a probe or sync read must read, and {command} writes")
        if any(said and said != now for said, now in zip(before, wanted, strict=True)):
            raise InvalidCommand(
                f"{self.label} is in use already, and now asked for with another probe or other sync reads: "
                "give all handles of an address the same options, or leave them out in all but the first"
            )
        self._sync_reads = wanted
        own = self.record.profile
        changed = replace(own, probe=wanted[0] or own.probe, checks=wanted[1] or own.checks)
        self.shared.arbiter.change_profile(self.record, changed)

    def limit(self, limit: Limit, /) -> None:
        """Refuse, from now on, every write beyond a limit, whatever names it; writes to all nodes too."""
        line = self.shared
        line.limiter = line.limiter or Limiter()
        line.limiter.add(self, limit)

    def lift(self, limit: Limit) -> None:
        """Hold a limit no longer; the others stay."""
        if self.shared.limiter is not None:
            self.shared.limiter.drop(self, limit)

    @property
    def limits(self) -> tuple[Limit, ...]:
        """Return the limits that are held."""
        return () if self.shared.limiter is None else self.shared.limiter.of(self)

    def check(self, *commands: Command[Any], stop: bool | None = None) -> None:
        """Raise InvalidCommand if one of these writes is beyond a limit: before the first of several is sent.

        A `stop` is held by no limit.
        """
        if self.shared.limiter is not None and not stop:
            for command in commands:
                self.shared.limiter.check(self, command)

    async def request(
        self,
        command: Command[T],
        *,
        touches: Command[Any] | None = None,
        stops_seen: int | None = None,
        stop: bool = False,
        **options: Unpack[CommandOptions],
    ) -> T:
        """Run one command and return its value. `RequestOptions` says what the options are.

        A write beyond a limit of the node raises InvalidCommand; but for a `stop`, and for a write of the safe state,
        which are held by none.

        `touches` is the command that reads what a write changes: samples of that which are older than the write are
        marked stale; without it, all of the node's. With `stops_seen` it raises Superseded, and sends nothing, if the
        node was told to stop since `stops` was that.

        Raises a BusError subclass. Cancelling it frees the caller at once and never disturbs the line (R6).
        """
        chosen = self._options(options) if options else ORDINARY
        limiter = self.shared.limiter
        if limiter is not None and getattr(command, "writes", False):
            async with limiter.passing(self, command, chosen, stop or chosen.safe) as left:
                return (await self._timed(command, left, touches, stops_seen, stop=stop))[0]
        transaction = self._prepared(command, chosen, False, touches, stops_seen, None, stop)
        future = self.shared.pump.transact(transaction)
        try:
            value: T = await future
        except asyncio.CancelledError:
            self.give_up(transaction)
            raise
        return value

    async def timed_request(self, command: Command[T], **options: Unpack[CommandOptions]) -> tuple[T, Timeline]:
        """Do what `request` does, and return beside the value the timeline that says why it took so long."""
        chosen, limiter = self._options(options), self.shared.limiter
        if limiter is None or not getattr(command, "writes", False):
            return await self._timed(command, chosen)
        async with limiter.passing(self, command, chosen, chosen.safe) as left:
            return await self._timed(command, left)

    async def followed_request(
        self,
        command: Command[T],
        journey: Journey,
        *,
        touches: Command[Any] | None = None,
        stops_seen: int | None = None,
        stop: bool = False,
        client: LineClient | None = None,
        **options: Unpack[CommandOptions],
    ) -> T:
        """Do what `request` does, for a client of the line or within a sequence, and say by `journey`, also once this
        was cancelled, whether it was ever sent. Raises HoldEnded if the sequence is over."""
        within = self._within(client, command)
        chosen, limiter = self._options(options), self.shared.limiter
        if limiter is None or not command.writes:
            return (await self._timed(command, chosen, touches, stops_seen, journey, client, stop))[0]
        async with limiter.passing(self, command, chosen, stop or chosen.safe, within) as left:
            return (await self._timed(command, left, touches, stops_seen, journey, client, stop))[0]

    @asynccontextmanager
    async def exclusive(self, *, max_hold: float = 0.5) -> AsyncIterator[Requester]:
        """Return, for `async with`, this node for one sequence of requests: see `Requester.exclusive`."""
        hold = self.hold(max_hold)
        try:
            yield _HeldNode(self, hold)
        finally:
            self.shared.release(hold)

    def _within(self, client: LineClient | None, command: Command[Any]) -> Requester | None:
        """Return the node for the sequence that a request is of, if it is of one. Raises HoldEnded if that is over."""
        if not isinstance(client, Hold):
            return None
        if client.over:
            raise hold_ended(self, client.longest, command)
        return _HeldNode(self, client)

    def hold(self, max_hold: float, client: LineClient | None = None) -> Hold:
        """Return what the requests of one sequence, of a client of the line, name as their client.

        It is to be released. Raises InvalidCommand unless `max_hold` is above 0 s, and 5 s at most.
        """
        self.shared.check_loop()
        return self.shared.arbiter.exclusive(self.record, client, checked_hold(max_hold, self.label))

    def begin_reading(
        self,
        command: Command[Any],
        reader: Waiter,
        options: RequestOptions = ORDINARY,
        *,
        stops_seen: int | None = None,
        client: LineClient | None = None,
    ) -> Transaction:
        """Begin a request of what writes nothing; `reader` is told what became of it, perhaps before this returns.

        It returns what says how far it has come, and what `give_up` takes when the reader waits no longer. Raises what
        `request` raises before anything is sent, and HoldEnded as `followed_request`.
        """
        if isinstance(client, Hold):
            self._within(client, command)
        transaction = self._prepared(command, options, stops_seen=stops_seen, client=client)
        self.shared.pump.begin(transaction, reader)
        return transaction

    async def _timed(
        self,
        command: Command[T],
        options: RequestOptions,
        touches: Command[Any] | None = None,
        stops_seen: int | None = None,
        journey: Journey | None = None,
        client: LineClient | None = None,
        stop: bool = False,
    ) -> tuple[T, Timeline]:
        transaction = self._prepared(command, options, False, touches, stops_seen, client, stop)
        if journey is not None:
            journey.transaction = transaction
        future = self.shared.pump.transact(transaction)
        try:
            return await future, transaction.timeline()
        except asyncio.CancelledError:
            self.give_up(transaction)
            raise

    def _options(self, given: CommandOptions) -> RequestOptions:
        options = RequestOptions.of(given, self.label)
        if options.verify:
            raise InvalidCommand(f"{self.label}: verify is for what writes a value through a handle")
        return options

    def _prepared(
        self,
        command: Command[Any],
        options: RequestOptions,
        probe: bool = False,
        touches: Command[Any] | None = None,
        stops_seen: int | None = None,
        client: LineClient | None = None,
        stop: bool = False,
    ) -> Transaction:
        """Return the transaction of a request. Raises what says that it cannot be begun."""
        record, line = self.record, self.shared
        if self._to_all and not command.writes:
            raise InvalidCommand(
                f"{self.profile.name}: address {self.address} is for writes to all; nobody answers a read"
            )
        if get_ident() != line.thread or not line.loop_runs():  # as check_loop does: this is done for every request
            if not line.running:
                raise line.not_open(record=record, command=str(command))
            line.check_loop()
        if type(command) not in self.kinds:
            if not hasattr(command, "open"):
                raise InvalidCommand(f"{self.label}: {command!r} is no command; read it through a handle, or its point")
            self.kinds[type(command)] = command
        if stops_seen is not None and stops_seen != record.stops:
            raise Superseded("the node was told to stop since this was decided", node=record, command=str(command))
        if line.only_safe and command.writes and not options.safe:
            raise Superseded(LEFT, node=record, command=str(command), hint="")
        return Transaction(  # by position: keywords cost more, and this is done for every request
            record,
            command,
            options.priority,
            inf if options.start_within is None else line.now() + options.start_within,
            options.retries,
            options.idempotent,
            probe,
            inf if options.finish_within is None else line.now() + options.finish_within,
            self if touches is None else (self, touches),
            client,
            None,
            None,
            command.writes and (stop or options.safe),
        )

    def give_up(self, transaction: Transaction) -> None:
        """Cancel what nobody waits for any more. A write that is on the wire ends before anything else can be read."""
        line = self.shared
        line.pump.cancel(transaction)
        # Its end is told to nobody, but what it may have changed is: samples that were read before it are stale now.
        if transaction.writes and transaction.attempts:
            line.touched(transaction, line.now())

    async def probe(self) -> bool:
        """Ask the node's cheapest read now, once. Return True if it answered (a refusal is an answer), False if not, or
        if it could not be asked."""
        transaction = self._prepared(self.profile.probe, PROBE, probe=True)
        future = self.shared.pump.transact(transaction)
        try:
            await future
        except asyncio.CancelledError:
            self.give_up(transaction)
            raise
        except Refused:
            return True
        except BusError:
            return False
        return True

    def suspend(self, for_: float) -> None:
        """Let it rest for maintenance: no polls, and NodeDown for requests, for so many seconds; 0 ends that now.

        A day at most: raises InvalidCommand for more.
        """
        if seconds(for_, f"{self.label}: a suspension") > LONGEST_SUSPENSION:
            raise InvalidCommand(f"{self.label}: a suspension lasts {LONGEST_SUSPENSION:g} s at most, not {for_!r}")
        self.shared.suspend(self.record, for_)

    @property
    def suspended(self) -> bool:
        """Return whether it rests: its polls are not sent."""
        return self.shared.now() < self.record.suspended_until

    def times_to_keep(self) -> tuple[LearnedTimes, ...]:
        """Return what `begin_with` may be given in the next run: the reply times that were learned and are trusted."""
        record = self.record
        return () if record.learning is None else record.learning.to_keep(record.timings)

    def begin_with(self, known: Iterable[LearnedTimes]) -> None:
        """Begin with what an earlier run has learned of its reply times, before it is asked anything.

        That is trusted after twenty replies; where nothing is to be learned it is left out.
        """
        if self.record.learning is not None:
            self.record.learning.begin_with(known)

    def statistics(self) -> NodeStatistics:
        """Return counts and latencies since the bus was opened or its statistics were reset."""
        self.shared.check_loop()
        record = self.record
        learning = record.learning
        learned = () if learning is None else learning.times(record.timings)
        return replace(record.counters.snapshot(record.lateness), learned=learned)


def _windows(asked: Timings | Learned | None, own: Timings | Learned) -> str:
    """Return how two reply windows differ, for messages; "" where they do not."""
    if asked is None or (one := _window(asked)) == (other := _window(own)):
        return ""
    return f" (a reply window of {one}, not {other})"


def _window(timings: Timings | Learned) -> str:
    return "what is learned" if isinstance(timings, Learned) else f"{timings.read.window * 1000:g} ms"


class _HeldNode(HeldNode):
    """A node of this process, within one sequence."""

    def __init__(self, node: Node, hold: Hold) -> None:
        super().__init__(node)
        self.hold = hold
        self._own = node

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
        """Run one command within the sequence, see `HeldNode.request`."""
        return await self._own.followed_request(
            command,
            Journey(),
            touches=touches,
            stops_seen=stops_seen,
            stop=stop,
            client=self.hold,
            **options,
        )
