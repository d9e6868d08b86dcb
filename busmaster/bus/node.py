"""A node: one addressed device of a bus."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Hashable, Iterable, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from math import inf
from typing import Any, Generic, Protocol, TypeVar, Unpack

from busmaster.arbiter.clients import Hold, LineClient
from busmaster.arbiter.counters import NodeStatistics
from busmaster.arbiter.health import Health, NodeRecord
from busmaster.arbiter.learned import LearnedTimes
from busmaster.arbiter.transaction import LEFT, Priority, Timeline, Transaction
from busmaster.bus.exclusive import HeldNode, checked_hold, hold_ended
from busmaster.bus.limiter import Limiter
from busmaster.bus.limits import Limit
from busmaster.bus.requester import ORDINARY, CommandOptions, Requester, RequestOptions
from busmaster.bus.samples import Sample
from busmaster.bus.shared_line import SharedLine, running_loop
from busmaster.contract.arguments import seconds
from busmaster.contract.bounds import LONGEST_SUSPENSION
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

__all__ = ["Health", "Node", "NodeStatistics", "Priority", "Request", "Timeline"]


class HasNode(Protocol):
    """A handle or a point."""

    @property
    def node(self) -> Requester: ...


class Request(Generic[T]):
    """One request to a node, and its result once it is started.

    `touches`, `stops_seen` and `stop`: see `Requester.request`. `client`: the program that is charged for the line
    time, or the sequence that the request belongs to; by default the program that owns the line. `probe`: sent to a
    node that is DOWN, within the probe budget.
    """

    # Not a data class: the decorator would generate its methods at each import, which costs start-up time.
    __slots__ = ("client", "command", "options", "probe", "stop", "stops_seen", "touches", "transaction")

    transaction: Transaction | None
    """The arbiter's transaction, from the start of the request on."""

    def __init__(
        self,
        command: Command[T],
        options: RequestOptions = ORDINARY,
        touches: Command[Any] | None = None,
        stops_seen: int | None = None,
        stop: bool = False,
        client: LineClient | None = None,
        *,
        probe: bool = False,
    ) -> None:
        self.command = command
        self.options = options
        self.touches = touches
        self.stops_seen = stops_seen
        self.stop = stop
        self.client = client
        self.probe = probe
        self.transaction = None

    @property
    def sent(self) -> bool:
        """True if an attempt was handed to the line."""
        return self.transaction is not None and self.transaction.attempts > 0


class Node:
    """One node, made by `Bus.node` or by a handle. All requests to it go through `request`."""

    def __init__(self, line: SharedLine, record: NodeRecord, asked: Timings | Learned | None = None) -> None:
        self._shared = line
        self._record = record
        self.timings = record.timings
        """The timings as configured. The maximum reply delay of its record may have been raised since."""
        # With the times of the profile filled in, so that a second handle that names the same times is accepted.
        self._asked = Learned(record.timings) if isinstance(asked, Learned) else record.timings
        self._kinds: dict[Hashable, Command[Any]] = {}
        """The first command of each kind that was sent to it. The worst case is calculated with them."""
        self._reply_time: float | None = None
        """Seconds from a request to its reply, measured by poll groups; before that, a given value or None."""
        self._measured = 0
        self._to_all = record.address == record.profile.broadcast
        """True for the broadcast address, from which no node replies."""
        self._kept = False
        """True if the program that owns the line has named the node itself."""
        self._borrowers = 0
        """Number of clients that will give it back."""
        self._returning = asyncio.Lock()
        """Held while its on_return hook runs."""
        self._on_return: Callable[[Node], Awaitable[None]] | None = None
        self._sync_reads: tuple[Command[Any] | None, tuple[Command[Any], ...]] = (None, ())
        """The probe and the sync reads set by handles."""

    @classmethod
    def of(cls, owner: HasNode) -> Node:
        """Return the node behind a handle or a point, which offers more operations.

        Raises InvalidCommand if its line belongs to another process.
        """
        if not isinstance(owner.node, cls):
            raise InvalidCommand(f"{owner.node.label} is not a node of a bus in this process")
        return owner.node

    @property
    def line(self) -> str:
        """Return the name of its line's port."""
        return self._record.line

    @property
    def profile(self) -> Profile:
        """Return the profile of the node's protocol."""
        return self._record.profile

    @property
    def address(self) -> int:
        """Return the node's address in its protocol."""
        return self._record.address

    @property
    def label(self) -> str:
        """Return its name in messages: "node 5"."""
        return self._record.label

    def _rename(self, label: str) -> None:
        """Set its name in messages."""
        self._shared.arbiter.name_node(self._record, label)

    @property
    def stops(self) -> int:
        """Return the number of stop commands to this node, by any handle."""
        return self._record.stops

    def note_stop(self) -> None:
        """Count a stop command, so that a write decided before it cannot undo it."""
        self._shared.note_stop(self._record)

    def now(self) -> float:
        """Return the time of the bus's clock, in seconds."""
        return self._shared.now()

    def latest(self, point: Any, /) -> Sample[Any] | None:
        """Return the newest good sample of a point in any poll group. None if a write has made it stale."""
        return self._shared.latest(point)

    def _held(self, point: Any, /) -> Any:
        """Return the value that a point would have read last, whichever point or batch read it.

        None if it is not known, or may have been written since.
        """
        return self._shared.held(self._record, point)

    def planned(self) -> PlannedNode:
        """Return the node as the planner uses it, with its reply time measured so far."""
        record = self._record
        return PlannedNode(record.profile, record.address, record.timings, self._reply_time)

    def _note_wait(self, wait: float) -> None:
        """Record a reply time, in seconds. Planning uses the mean of the last replies."""
        # A moving mean: a drive gets slower when its program grows, and plans must follow.
        self._measured = min(self._measured + 1, REPLIES_REMEMBERED)
        known = wait if self._reply_time is None else self._reply_time
        self._reply_time = known + (wait - known) / self._measured

    @property
    def health(self) -> Health:
        """Return the health of the node: up, suspect, down or unknown; offline while the line is lost."""
        # Without a port there is no reply to judge the node by: its record would stay UP for the whole loss.
        return Health.OFFLINE if self._shared.condition.is_lost else self._record.health

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
        # The arbiter holds the polls of a returning node only if there is a hook that releases them afterwards.
        self._shared.arbiter.expect_hook(self._record, hook is not None)

    def _check_shared(self, profile: Profile, timings: Timings | Learned | None, retries: int | None) -> None:
        """Raise InvalidCommand if this node is requested with options that differ from those of the first call.

        None means not specified, for a profile's `merge` too.
        """
        # The usual case, without building the table below.
        own = self.profile
        if profile is own and timings is None and retries is None:
            return
        # LEARNED alone stands for the times of the profile.
        if isinstance(timings, Learned):
            timings = timings.of(profile.timings)
        wanted = {
            f"other timings{_windows(timings, self._asked)}": timings not in (None, self._asked),
            f"other retries ({retries}, not {self._record.retries})": retries not in (None, self._record.retries),
            "another profile": profile != own or profile.merge not in (None, own.merge),
        }
        for what, differs in wanted.items():
            if differs:
                raise InvalidCommand(
                    f"{self.label} is already in use, and was requested again with {what}. "
                    "Give all handles of an address the same options, or leave them out in all but the first"
                )

    def merge_reads(self, merge: Merge, /) -> None:
        """Replace the merge of this node's profile. Poll groups use it for this node's reads from now on."""
        self._shared.arbiter.change_profile(self._record, replace(self._record.profile, merge=merge))

    def use_sync_reads(self, probe: Command[Any] | None, sync_reads: Sequence[Command[Any]], /) -> None:
        """Replace the probe and the sync reads of its profile. None or an empty sequence keeps those of the profile.

        The probe is sent to a node that may be dead. A sync read is sent if the line must prove that replies match
        requests. Raises InvalidCommand for a write, and if another handle of the node has set different ones.
        """
        before = self._sync_reads
        wanted = (probe or before[0], tuple(sync_reads) or before[1])
        for command in (probe, *sync_reads):
            # The arbiter sends these without a caller, at any time: a write would change the drive by itself.
            if command is not None and getattr(command, "writes", False):
                raise InvalidCommand(f"{self.label}: a probe or sync read must read, and {command} writes")
        # Before anything is stored: a rejected handle must not change the node of the others.
        if any(earlier and earlier != now for earlier, now in zip(before, wanted, strict=True)):
            raise InvalidCommand(
                f"{self.label} is already in use, and was requested again with another probe or other sync reads. "
                "Give all handles of an address the same options, or leave them out in all but the first"
            )
        self._sync_reads = wanted
        own = self._record.profile
        changed = replace(own, probe=wanted[0] or own.probe, sync_reads=wanted[1] or own.sync_reads)
        self._shared.arbiter.change_profile(self._record, changed)

    def limit(self, limit: Limit, /) -> None:
        """Add a limit: reject every write that violates it, under any name of the quantity, and in writes to all nodes
        too."""
        line = self._shared
        # Made with the first limit: a line without one has no extra work for a write.
        line.limiter = line.limiter or Limiter()
        line.limiter.add(self, limit)

    def lift(self, limit: Limit) -> None:
        """Remove one limit. The others stay."""
        if self._shared.limiter is not None:
            self._shared.limiter.drop(self, limit)

    @property
    def limits(self) -> tuple[Limit, ...]:
        """Return the active limits."""
        return () if self._shared.limiter is None else self._shared.limiter.of(self)

    def check(self, *commands: Command[Any], stop: bool | None = None) -> None:
        """Raise InvalidCommand if one of these writes violates a limit, before the first of several is sent.

        A `stop` is not limited.
        """
        if self._shared.limiter is not None and not stop:
            for command in commands:
                self._shared.limiter.check(self, command)

    def request(
        self,
        command: Command[T],
        *,
        touches: Command[Any] | None = None,
        stops_seen: int | None = None,
        stop: bool = False,
        **options: Unpack[CommandOptions],
    ) -> Coroutine[Any, Any, T]:
        """Run one command and return its value: `await` it. The options are those of `RequestOptions`.

        A write that violates a limit of the node raises InvalidCommand. A `stop` and a write of the safe state are not
        limited.

        `touches`: the command that reads what the write changes. Samples of it that are older than the write become
        stale; by default all samples of the node do. `stops_seen`: if the node was sent a stop since `stops` had this
        value, raise Superseded and send nothing.

        Raises a BusError subclass. Cancelling it frees the caller immediately and does not disturb the line (R6).
        """
        # No `async def`: a second coroutine costs time for every request (benchmark `turnaround`).
        return self._send(command, self._options(options) if options else ORDINARY, touches, stops_seen, stop)

    async def timed_request(self, command: Command[T], **options: Unpack[CommandOptions]) -> tuple[T, Timeline]:
        """Run one command as `request` does. Returns the value and the timeline of the request."""
        request = Request(command, self._options(options))
        value = await self._run(request)
        assert request.transaction is not None
        return value, request.transaction.timeline()

    @asynccontextmanager
    async def exclusive(self, *, max_hold: float = 0.5) -> AsyncIterator[Requester]:
        """Return this node for one exclusive sequence of requests, for `async with`; see `Requester.exclusive`."""
        hold = self._hold(max_hold)
        try:
            yield _HeldNode(self, hold)
        finally:
            # However the block is left: otherwise the line would be held for the rest of `max_hold`.
            self._shared.release(hold)

    def _within(self, request: Request[Any]) -> Requester | None:
        """Return the node of the sequence that a request belongs to, if any. Raises HoldEnded if the sequence has
        ended."""
        hold = request.client
        if not isinstance(hold, Hold):
            return None
        if hold.over:
            raise hold_ended(self, hold.longest, request.command)
        # The limiter reads the current value through it: another read would wait until the sequence is over.
        return _HeldNode(self, hold)

    def _hold(self, max_hold: float, client: LineClient | None = None) -> Hold:
        """Return a hold that the requests of one sequence of a client use as their client. The caller must release it.

        Raises InvalidCommand unless `max_hold` is above 0 s and at most 5 s.
        """
        self._shared.check_loop()
        return self._shared.arbiter.exclusive(self._record, client, checked_hold(max_hold, self.label))

    async def _send(
        self,
        command: Command[T],
        options: RequestOptions,
        touches: Command[Any] | None,
        stops_seen: int | None,
        stop: bool,
    ) -> T:
        """Run a request of which only the value is wanted: as `_run`, without a `Request`.

        That object costs 3 % of the processor time of a read (benchmark `turnaround`).
        """
        # Most requests are reads, and most lines have no limits: neither needs a check.
        if self._shared.limiter is not None and getattr(command, "writes", False):
            return await self._run(Request(command, options, touches, stops_seen, stop))
        transaction = self._transaction(command, options, touches, stops_seen, stop, None, False)
        self._shared.pump.begin(transaction, None)
        try:
            value: T = await transaction.tag
        # R6: the caller is free at once, whatever the line does with the request.
        except asyncio.CancelledError:
            self._give_up(transaction)
            raise
        return value

    async def _run(self, request: Request[T], checked: bool = False) -> T:
        """Run a request that keeps its progress, also after a cancellation. `checked`: its limits were checked.

        Raises HoldEnded if the request's sequence has ended.
        """
        limiter = self._shared.limiter
        if limiter is not None and not checked and getattr(request.command, "writes", False):
            free, within = request.stop or request.options.safe, self._within(request)
            # The options are replaced: the time spent on earlier writes and on reading the value counts for the
            # caller's limits.
            async with limiter.passing(self, request.command, request.options, free, within) as request.options:
                return await self._run(request, checked=True)
        transaction = self._start(request)
        try:
            value: T = await transaction.tag
        except asyncio.CancelledError:  # R6, as in `_send`
            self._give_up(transaction)
            raise
        return value

    def _options(self, given: CommandOptions) -> RequestOptions:
        """Return the options of a caller. Raises InvalidCommand with the node's name."""
        options = RequestOptions.of(given, self.label)
        # One command has no item to read back. A handle knows it.
        if options.verify:
            raise InvalidCommand(f"{self.label}: verify is only available for the write methods of a handle")
        return options

    def _start(self, request: Request[Any], waiter: Waiter | None = None) -> Transaction:
        """Start a request. Limits were checked before.

        `waiter` gets the value or the error, possibly before this returns. Without one, the transaction's tag is a
        future for them. Pass the transaction to `give_up` if its caller stops waiting. Raises what `request` raises
        before anything is sent.
        """
        request.transaction = transaction = self._transaction(
            request.command,
            request.options,
            request.touches,
            request.stops_seen,
            request.stop,
            request.client,
            request.probe,
        )
        self._shared.pump.begin(transaction, waiter)
        return transaction

    def _transaction(
        self,
        command: Command[Any],
        options: RequestOptions,
        touches: Command[Any] | None,
        stops_seen: int | None,
        stop: bool,
        client: LineClient | None,
        probe: bool,
    ) -> Transaction:
        """Return the transaction of a request. Each request to a node is checked here; only its limits are not."""
        record, line = self._record, self._shared
        if client is not None and isinstance(client, Hold) and client.over:
            raise hold_ended(self, client.longest, command)
        # Before anything is sent: the request would time out, and count as a failure.
        if self._to_all and not command.writes:
            raise InvalidCommand(
                f"{self.profile.name}: address {self.address} is for writes to all nodes; no node replies to a read"
            )
        # same as check_loop, written out: this runs for every request
        if running_loop() is not line.loop:
            if not line.running:
                raise line.not_open(record=record, command=str(command))
            line.check_loop()
        if type(command) not in self._kinds:
            # Checked once per type of command, not per request.
            if not hasattr(command, "open"):
                raise InvalidCommand(f"{self.label}: {command!r} is not a command; read it through a handle or a point")
            self._kinds[type(command)] = command
        # Checked in the same step in which it is queued, so that no stop can come in between.
        if stops_seen is not None and stops_seen != record.stops:
            raise Superseded("the node was stopped after this write was decided", node=record, command=str(command))
        # The safe state is being sent: a late write of the application would undo it.
        if line.only_safe and command.writes and not options.safe:
            raise Superseded(LEFT, node=record, command=str(command), hint="")
        # positional arguments: keywords cost more, and this runs for every request
        return Transaction(
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
            # Only such writes may share an outcome: equal ones that wait for the same node are sent once (R9).
            command.writes and (stop or options.safe),
        )

    def _give_up(self, transaction: Transaction) -> None:
        """Cancel a transaction whose caller has gone. A write on the wire ends before anything else can be read."""
        line = self._shared
        line.pump.cancel(transaction)
        # Its end is not reported, but the drive may have carried it out: samples read before it are stale now.
        if transaction.writes and transaction.attempts:
            line.touched(transaction, line.now())

    async def probe(self) -> bool:
        """Send the node's cheapest read once, now. Returns True if it replied (a refusal counts), else False.

        Also returns False if the request could not be sent.
        """
        request = Request(self.profile.probe, PROBE, probe=True)
        # A refusal proves that the node is there: that is what a probe is for.
        try:
            await self._run(request)
        except Refused:
            return True
        except BusError:
            if request.transaction is None:  # the bus is not open, so nothing is known about the node
                raise
            return False
        return True

    def suspend(self, for_: float) -> None:
        """Suspend the node for maintenance, in seconds: no polls, and NodeDown for requests. 0 ends the suspension.

        Raises InvalidCommand for more than a day.
        """
        # A suspension does not end with the program that requested it, so it has to end by itself.
        if seconds(for_, f"{self.label}: a suspension") > LONGEST_SUSPENSION:
            raise InvalidCommand(f"{self.label}: a suspension lasts {LONGEST_SUSPENSION:g} s at most, not {for_!r}")
        self._shared.suspend(self._record, for_)

    @property
    def suspended(self) -> bool:
        """Return True while it is suspended: its polls are not sent."""
        return self._shared.now() < self._record.suspended_until

    def _times_to_keep(self) -> tuple[LearnedTimes, ...]:
        """Return the trusted learned reply times, for `begin_with` in the next run."""
        record = self._record
        return () if record.learning is None else record.learning.to_keep(record.timings)

    def _begin_with(self, known: Iterable[LearnedTimes]) -> None:
        """Start with the reply times learned in an earlier run, before the first request.

        They are trusted after twenty replies. Ignored if learning is disabled.
        """
        if self._record.learning is not None:
            self._record.learning.begin_with(known)

    def statistics(self) -> NodeStatistics:
        """Return counters and latencies since the bus was opened or its statistics were reset."""
        self._shared.check_loop()
        record = self._record
        learning = record.learning
        learned = () if learning is None else learning.times(record.timings)
        return replace(record.counters.snapshot(record.max_reply_delay), learned=learned)


def _windows(asked: Timings | Learned | None, own: Timings | Learned) -> str:
    """Return the difference of two reply windows for messages; "" if they are equal."""
    if asked is None or (one := _window(asked)) == (other := _window(own)):
        return ""
    return f" (a reply window of {one}, not {other})"


def _window(timings: Timings | Learned) -> str:
    return "the learned time" if isinstance(timings, Learned) else f"{timings.read.window * 1000:g} ms"


class _HeldNode(HeldNode):
    """A node of this process within one sequence."""

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
        own = self._own
        # Not `Node.request`, which sends on behalf of the line's owner: the arbiter would let it wait for the hold's
        # end.
        return await own._run(Request(command, own._options(options), touches, stops_seen, stop, self.hold))
