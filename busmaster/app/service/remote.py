"""A line that another program owns: the bus of a client."""

from __future__ import annotations

import asyncio
import dataclasses
import sys
import time
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from functools import partial
from math import inf
from types import TracebackType
from typing import Any, Protocol, TypeAlias, TypeVar, Unpack

from busmaster import BusClosed, BusError, InvalidCommand, Point, Priority, Sample, Timings
from busmaster.app.bounds import LONGEST_REQUEST, MOST_CHECKED
from busmaster.app.service.client_messages import (
    CheckParams,
    GatherParams,
    NodeParams,
    NoParams,
    PlanParams,
    PollParams,
    RefusalsParams,
    RequestParams,
    SafeParams,
    StopParams,
    StreamParams,
    SubscribeParams,
)
from busmaster.app.service.encoding import (
    encode_points,
    encode_sync_reads,
    event_of,
    statistics_of,
)
from busmaster.app.service.fields import OptionsForm, protocol_of, shortened
from busmaster.app.service.link import TCP, Link
from busmaster.app.service.messages import encode, value_of
from busmaster.app.service.owner_messages import (
    AccessParams,
    PollGroupsParams,
    PollResult,
    StopsParams,
    StreamMessage,
    SubscribeResult,
    TouchedParams,
)
from busmaster.app.service.plans import encode_groups, plan_of
from busmaster.app.service.remote_exchanges import RemoteExchanges
from busmaster.app.service.remote_group import RemoteGroup
from busmaster.app.service.remote_overview import RemoteOverview
from busmaster.app.service.reply_times import encode_timings
from busmaster.app.service.safe import outcomes_of
from busmaster.app.service.sequences import HoldsLine, RequestLimit, held_remotely
from busmaster.app.service.typed import Struct, replace, to_builtins
from busmaster.events import BusEvent, Stream
from busmaster.ext import (
    ORDINARY,
    URGENT,
    Command,
    CommandOptions,
    Learned,
    Limit,
    LineStatistics,
    Merge,
    Plan,
    PlannedGroup,
    Profile,
    Requester,
    RequestOptions,
    checked_hold,
    checked_priority,
    find_group,
    protocols,
    seconds,
)

T = TypeVar("T")
RequestGroup: TypeAlias = Callable[[RemoteGroup, int], Awaitable[None]]
"""Requests the cycles of a group as a stream of this number."""
EVENT_BUFFER = 256
POINTS_IN_A_MESSAGE = 50
CLOCK_READINGS = 3
"""Number of readings of the owner's clock before the first request: this program may be busy during one."""
CLOCK_PERIOD = 60.0
"""Seconds between two further readings. Two clocks drift apart by some seconds a day, and one stops while its machine
is suspended. A write would seem to be old."""


class RemoteLine(HoldsLine, Protocol):
    """The line of a remote node."""

    @property
    def address(self) -> str: ...

    @property
    def line(self) -> str: ...

    @property
    def room(self) -> RequestLimit: ...

    def opened(self, node: RemoteNode, command: Command[Any], /) -> Link:
        """Return the connection for a request. Raises BusClosed, naming it, before the line is entered."""
        ...

    def prepare(self, node: RemoteNode, commands: tuple[Command[Any], ...], stop: bool, /) -> None:
        """Have these writes checked when the line is entered, if it is not yet."""
        ...

    def now(self) -> float: ...

    def latest(self, point: Point[T], /) -> Sample[T] | None: ...


class RemoteNode:
    """One node of a line that another program owns. Handles and points work on it as on a node of this process."""

    def __init__(self, bus: RemoteLine, profile: Profile, address: int) -> None:
        self.stops = 0
        """Number of stops by any program since this one named the node."""
        self.label = profile.label(address)
        self._bus = bus
        self._profile = profile.with_default_merge()
        self._address = address
        self._protocol = protocol_of(profile.name)

    @property
    def line(self) -> str:
        """Return the name of its line's port."""
        return self._bus.line

    @property
    def address(self) -> int:
        return self._address

    @property
    def profile(self) -> Profile:
        return self._profile

    def __repr__(self) -> str:
        return f"<RemoteNode {self.profile.name} {self.address} of {self._bus.address}>"

    def note_stop(self) -> None:
        """Inform the line that this node is being stopped, before all later requests."""
        self.stops += 1
        self._bus.link.notify("stop", StopParams(self.profile.name, self.address))

    def now(self) -> float:
        """Return the time of the line's clock, in seconds: that of its owner's machine."""
        return self._bus.now()

    def latest(self, point: Any, /) -> Sample[Any] | None:
        """Return the youngest good sample of a point in this program's poll groups, unless a write to the node, by
        any program, has made it stale."""
        return self._bus.latest(point)

    def merge_reads(self, merge: Merge, /) -> None:
        """Let the profile propose `merge`. The line's owner decides which reads are merged."""
        self._profile = dataclasses.replace(self._profile, merge=merge)

    def use_sync_reads(self, probe: Command[Any] | None, sync_reads: Sequence[Command[Any]], /) -> None:
        """Change nothing: the line's owner sends the probes and the sync reads."""

    def limit(self, limit: Limit, /) -> None:
        """Raise InvalidCommand: limits are held by the program that owns the line, for all programs."""
        raise InvalidCommand(f"{self.label}: limits are held by the program that owns the line: set {limit.name} there")

    def check(self, *commands: Command[Any], stop: bool | None = None) -> None:
        """Have the line check these writes when the bus is entered: entering raises InvalidCommand for a bad one.

        Later it does nothing: the line checks each write as it comes. Of several, those before a bad one are written.
        """
        self._bus.prepare(self, commands, stop is True)

    def request(
        self,
        command: Command[T],
        /,
        *,
        touches: Command[Any] | None = None,
        stops_seen: int | None = None,
        stop: bool = False,
        **options: Unpack[CommandOptions],
    ) -> Coroutine[Any, Any, T]:
        """Run one command on the line and return its value: as `Requester.request`, with the same errors.

        If the connection is lost meanwhile, a write raises WriteUnconfirmed, or NotStarted where it was not handed over
        yet, and a read LineDown. Cancelling it cancels it there.
        """
        return self.ask(command, None, touches, stops_seen, stop, options)

    async def ask(
        self,
        command: Command[T],
        sequence: int | None,
        touches: Command[Any] | None,
        stops_seen: int | None,
        stop: bool,
        options: CommandOptions,
        /,
    ) -> T:
        """Do what `request` does, within a sequence of this program, if it is given the number of one."""
        chosen = RequestOptions.of(options, self.label) if options else ORDINARY
        if chosen.verify:
            raise InvalidCommand(f"{self.label}: verify is only available for the write methods of a handle")
        if chosen.safe:
            raise InvalidCommand(f"{self.label}: the safe state is sent by the program that owns the line")
        link, room = self._bus.opened(self, command), self._bus.room
        # A request of a sequence does not wait for the other requests of this program, which wait for the sequence.
        waits = sequence is None and chosen.priority is not URGENT
        waited = await room.wait(chosen, self, command) if waits and not room.take() else 0.0
        try:
            left = shortened(options, waited) if waited else options
            params = self._params(command, left, touches, stops_seen, stop, sequence)
            asked = link.ask("request", params, writes=command.writes, node=self, command=command)
            value: T = value_of(await link.answer(asked, left.get("finish_within")))
            return value
        finally:
            if waits:
                room.give_back()

    def exclusive(self, *, max_hold: float = 0.5) -> AbstractAsyncContextManager[Requester]:
        """Return, for `async with`, this node for one sequence of requests: see `Requester.exclusive`.

        The line is held no longer than the connection lasts.
        """
        return held_remotely(self, self._bus, checked_hold(max_hold, self.label))

    def _params(
        self,
        command: Command[Any],
        options: CommandOptions,
        touches: Command[Any] | None,
        stops_seen: int | None,
        stop: bool,
        sequence: int | None,
    ) -> RequestParams:
        is_limited = command.writes or bool(options)
        return RequestParams(
            self._profile.name,
            self._address,
            self._protocol.write_down(command),
            touches=None if touches is None else self._protocol.write_down(touches),
            options=_encode_options(options) if options else None,
            stops_seen=stops_seen,
            stop=stop,
            requested=self._bus.now() if is_limited else None,
            sequence=sequence,
        )

    def check_params(self, commands: Iterable[Command[Any]], stop: bool) -> CheckParams:
        """Return the message with which the line checks these writes of the node."""
        forms = [self._protocol.write_down(command) for command in commands]
        return CheckParams(self.profile.name, self.address, forms, stop)


def _encode_options(options: CommandOptions) -> OptionsForm:
    """Return the options of a request. `safe` is false, and `verify` is a handle's affair."""
    priority = options.get("priority")
    return OptionsForm(
        None if priority is None else checked_priority(priority),
        options.get("start_within"),
        options.get("finish_within"),
        options.get("retries"),
        options.get("idempotent"),
    )


def connect(address: str, *, token: str | None = None, safe_only: bool = False) -> RemoteBus:
    """Return the bus that another program owns, for `async with`, which connects.

    `address` is `unix:PATH`, or the name of a line or of its port in `busmaster status`, or `tcp://HOST:PORT`, for
    which the line's owner may require a `token`. The token is sent without encryption. Raises InvalidCommand for a
    token with any other address, where the kernel identifies the program. `safe_only`: the program only calls
    `enter_safe_state`, and is admitted even if no other place is free.
    """
    return RemoteBus(address, token=token, safe_only=safe_only)


class RemoteBus:
    """A line that another program owns. Use it in `async with`: entering connects, leaving disconnects.

    Handles take it as they take a Bus: `MicroFlexDrive(remote, 7)`. Safety is the line's: a stop of any program counts
    for all, and limits and the audit log are the owner's. A node that the owner does not have gets the settings of this
    program, and leaves the line with it. Entering raises LineDown if no program serves the line, which may change
    later. It raises InvalidCommand for a write that was prepared before and that the line would not accept. A lost
    connection is not restored: enter a new RemoteBus.
    """

    def __init__(self, address: str, *, token: str | None = None, safe_only: bool = False) -> None:
        if token is not None and not address.startswith(TCP):
            raise InvalidCommand(f"a token needs tcp://HOST:PORT, not {address}; leave out the token")
        if token is not None and not (token.isascii() and token.isprintable() and token.split() == [token]):
            raise InvalidCommand("a token must consist of letters, digits and signs, without spaces")
        self.address = address
        self._token = token
        self._safe_only = safe_only
        self.line = ""
        """The name of the line's port, once it is entered."""
        self.about: Mapping[str, Any] = {}
        """The owner's description of the line: name, settings, process, and whether this program is read-only."""
        self.on_access: list[Callable[[], None]] = []
        """Called when the permission of this program in `about` changes. The functions must not block, nor raise."""
        self.on_touched: list[Callable[[Mapping[str, Any]], None]] = []
        """Called before a write is confirmed, with the values that it makes stale: `touched` in docs/service.md."""
        self._link: Link | None = None
        self._ahead = 0.0
        """Seconds by which the clock of the owner's machine is ahead."""
        self._clock_task: asyncio.Task[None] | None = None
        self._nodes: dict[tuple[str, int], RemoteNode] = {}
        self._named: dict[RemoteNode, tuple[Timings | Learned | None, int | None]] = {}
        self._reported: set[RemoteNode] = set()
        """Nodes that the owner knows."""
        self._streams: dict[int, RemoteGroup | RemoteOverview | RemoteExchanges] = {}
        self._listed: dict[str, float] = {}
        """The poll groups that the owner has, with their periods."""
        self._owners: dict[str, RemoteGroup] = {}
        self._own: dict[str, RemoteGroup] = {}
        self._own_names: set[str] = set()
        """The names that the owner gave to groups of this program: it lists them, also for a moment after their end."""
        self._tasks: set[asyncio.Task[None]] = set()
        self._planning = asyncio.Lock()
        self._count = 0
        self._sequences = 0
        self.room = RequestLimit(self.now)
        """Limits the number of requests in progress."""
        self._touched: dict[tuple[str, int], float] = {}
        """When the last write to a node ended."""
        self._events: list[Stream[BusEvent]] = []
        self._follows_events = False
        self._prepared: list[tuple[RemoteNode, tuple[Command[Any], ...], bool]] = []
        """Writes to check before the first of them is sent."""

    async def __aenter__(self) -> RemoteBus:
        if self._link is not None:
            raise InvalidCommand(f"the bus of {self.address} was already entered; enter it once, and share it")
        link = Link(self.address, self._token, self._receive, self._lost, safe_only=self._safe_only)
        self._link = link
        about = await link.open(sys.argv[0])
        self.about, self.line = to_builtins(about), about.line
        self._listed = {group.name: group.period for group in about.groups}
        for known in about.nodes:
            node = self._nodes.get((known.protocol, known.address))
            if node is not None:
                node.label = known.label
        for node in self._named:
            self._name(node)
        try:
            if self.address.startswith(TCP) and not self._safe_only:
                # another machine, perhaps: its clock began at another moment
                for _ in range(CLOCK_READINGS):
                    await self._read_clock()
                self._clock_task = asyncio.create_task(self._follow_clock())
            for node, commands, stop in self._prepared:
                for first in range(0, len(commands), MOST_CHECKED):
                    await self._ask("check", node.check_params(commands[first : first + MOST_CHECKED], stop))
        except BaseException:
            await link.close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Disconnect: the requests of this program end, and the line continues."""
        await self.link.close()

    @property
    def link(self) -> Link:
        """Return the connection. Raises BusClosed before the bus is entered."""
        if self._link is None:
            raise BusClosed("the bus is not open")
        return self._link

    def new_sequence(self) -> int:
        """Return the number of one more sequence of requests."""
        self._sequences += 1
        return self._sequences

    def opened(self, node: RemoteNode, command: Command[Any]) -> Link:
        """Return the connection for a request. Raises BusClosed with the request before the bus is entered."""
        if self._link is None:
            raise BusClosed("the bus is not open", node=node, command=str(command))
        return self._link

    def prepare(self, node: RemoteNode, commands: tuple[Command[Any], ...], stop: bool) -> None:
        """Check these writes when the bus is entered, if it is not yet."""
        if self._link is None:
            self._prepared.append((node, commands, stop))

    def now(self) -> float:
        """Return the time of the line's clock, in seconds: that of its owner's machine."""
        return time.monotonic() + self._ahead

    # nodes

    def node(
        self, profile: Profile, address: int, *, timings: Timings | Learned | None = None, retries: int | None = None
    ) -> RemoteNode:
        """Return the node at this address, as `Bus.node` does.

        Raises InvalidCommand for an address that the protocol does not have, and for other timings or retries than this
        program named first. The node's requests raise the objections of the line's owner.
        """
        profile.check_address(address)
        node = self._find(profile, address)
        named = self._named.setdefault(node, (timings, retries))
        if timings not in (None, named[0]) or retries not in (None, named[1]):
            raise InvalidCommand(
                f"{node.label} is already in use with other timings or retries; "
                "give all handles of an address the same options, or set them only in the first"
            )
        if self._link is not None:
            self._name(node)
        return node

    @property
    def nodes(self) -> tuple[RemoteNode, ...]:
        """Return the nodes that the owner had when the bus was entered, then those that this program has named.

        Nodes of a protocol that is not installed here are left out.
        """
        installed = {protocol.name for protocol in protocols()}
        known = [node for node in self.about.get("nodes", ()) if node["protocol"] in installed]
        found = {self.find(node["protocol"], node["address"]): None for node in known}
        return tuple({**found, **dict.fromkeys(self._named)})

    def find(self, protocol: str, address: int) -> RemoteNode:
        """Return a node in a message of the owner, by the name of its protocol. This does not name it to the owner."""
        return self._find(protocol_of(protocol).profile, address)

    def _find(self, profile: Profile, address: int) -> RemoteNode:
        if profile != protocol_of(profile.name).profile:
            raise InvalidCommand(f"{profile.label(address)}: another's line only supports the standard {profile.name}")
        key = profile.name, address
        return self._nodes.get(key) or self._nodes.setdefault(key, RemoteNode(self, profile, address))

    def _name(self, node: RemoteNode) -> None:
        """Inform the owner once that this program uses a node, with its settings."""
        if node in self._reported:
            return
        self._reported.add(node)
        timings, retries = self._named[node]
        probe, sync_reads = encode_sync_reads(node.profile)
        params = NodeParams(node.profile.name, node.address, encode_timings(timings), retries, probe, sync_reads)
        asked = self.link.ask("node", params, node=node)

        def named(future: asyncio.Future[Any]) -> None:
            if not future.cancelled() and future.exception() is None:
                node.label = future.result().label

        asked.future.add_done_callback(named)

    # looking

    async def statistics(self) -> LineStatistics:
        """Return an immutable snapshot of the line's counts, as `Bus.statistics`."""
        return statistics_of(await self._ask("statistics", NoParams()))

    async def plan(self, *more: PlannedGroup) -> Plan:
        """Have the line's owner calculate what becomes of the groups that run, and of `more`, as `Bus.plan` does.

        Nodes that the owner has are as it has measured them. Raises InvalidCommand for groups that have more than 200
        reads in all, or merges.
        """
        params = PlanParams(encode_groups(more))
        if len(encode(params)) > LONGEST_REQUEST // 2:
            raise InvalidCommand("these groups are too long for one message; plan fewer of them at once")
        async with self._planning:  # the owner calculates one at a time for each program
            return plan_of(await self.link.answer(self.link.ask("plan", params)))

    @property
    def groups(self) -> tuple[RemoteGroup, ...]:
        """Return the poll groups of the line: those of its owner and of other programs, then this program's own.

        A group that was added or closed there appears or disappears here a moment later. The owner sends the cycles of
        a group that is iterated, subscribed to, or returned by `group`.
        """
        own = tuple(group for group in self._own.values() if not group.over)
        listed = {name: period for name, period in self._listed.items() if name not in self._own_names}
        for name, period in listed.items():
            if (known := self._owners.get(name)) is None or known.over:
                self._owners[name] = self._new_group(name, (), period, partial(self._subscribe, name))
            else:
                known.period = period  # the owner may have closed it and made it again
        return (*(self._owners[name] for name in listed), *own)

    def group(self, name: str) -> RemoteGroup:
        """Return a poll group by its name, this program's own before the owner's, and have its cycles sent.

        Samples of the owner's group are those that the owner makes: of bits, the number. Raises InvalidCommand, with
        the names that exist, for another name.
        """
        found = find_group(self.groups, name)
        found.begin()
        return found

    def poll_group(
        self,
        name: str,
        *,
        period: float,
        points: Iterable[Point[Any]],
        phase: float | None = None,
        priority: Priority = Priority.POLL,
    ) -> RemoteGroup:
        """Have `points` read every `period` seconds, as `Bus.poll_group`; the group ends with this program.

        Raises InvalidCommand for arguments that `Bus.poll_group` rejects. If only the line's owner rejects it, such as
        one group too many, iterating the group or `await group.ready()` raises that.
        """
        self.link.check()
        period = seconds(period, f"poll group {name!r}: a period")
        if phase is not None:
            phase = seconds(phase, f"poll group {name!r}: a phase")
        priority = checked_priority(priority)
        if (before := self._own.get(name)) is not None and not before.over:
            raise InvalidCommand(f"a poll group {name!r} already exists")
        read = tuple(points)
        for point in read:
            if point.node is not self._nodes.get((point.node.profile.name, point.node.address)):
                raise InvalidCommand(f"poll group {name!r}: {point.key} belongs to another bus")
            if point.node.address == point.node.profile.broadcast:
                raise InvalidCommand(
                    f"poll group {name!r}: no node replies to a read of {point.key}, which is the address of all nodes"
                )
        begin = partial(self._poll, read, PollParams(name, period, 0, phase=phase, priority=priority))
        self._own[name] = group = self._new_group(name, read, period, begin)
        group.begin()
        return group

    def latest(self, point: Point[T]) -> Sample[T] | None:
        """Return the youngest good sample of a point in a poll group of this program, unless a write to its node, by
        whatever program, has ended since it was read."""
        node, profile = point.node, point.node.profile
        addresses = (node.address,) if profile.broadcast is None else (node.address, profile.broadcast)
        touched = [self._touched.get((profile.name, address), -inf) for address in addresses]
        groups = [stream for stream in self._streams.values() if isinstance(stream, RemoteGroup)]
        snapshots = [group.latest for group in groups if group.own and group.latest is not None]
        samples = [snapshot.samples[point] for snapshot in snapshots if point in snapshot.samples]
        good = (one for one in samples if one.error is None and one.started is not None and one.started > max(touched))
        return max(good, key=lambda one: one.finished, default=None)

    async def enter_safe_state(self, values: Mapping[str, float]) -> dict[str, BusError | None]:
        """Have the line's owner send its safe state, and return by point why it was not confirmed, None if it was.

        `values`: the safe state that the caller expects, by the names of the file's points. Raises InvalidCommand, and
        nothing is sent, if it is another one, or this program may not write all of it.
        """
        return outcomes_of(await self._ask("safe", SafeParams(dict(values)), writes=True))

    def report_refusals(self, interface: str, kind: str, peers: Mapping[str, int]) -> None:
        """Report to the owner how often the interface that this program serves has refused each peer.

        `kind` is "logins", "connections" or "requests". Without peers, the owner begins to count the kind at 0.
        """
        self.link.notify("refusals", RefusalsParams(interface, kind, dict(peers)))

    def events(self) -> Stream[BusEvent]:
        """Return a stream of what happens to line and nodes from now on; a node in it is this program's."""
        stream: Stream[BusEvent] = Stream(self._events, EVENT_BUFFER)
        if not self._follows_events:
            self._follows_events = True
            asked = self.link.ask("events", StreamParams(0))
            # Nothing waits for the reply: a lost connection ends the streams.
            asked.future.add_done_callback(lambda future: future.cancelled() or future.exception())
        return stream

    async def overview(self, receive: Callable[[str, Mapping[str, Any]], None]) -> RemoteOverview:
        """Call `receive` with the overview of the line, a few times a second, as described in docs/service.md."""
        self._count += 1
        overview = self._streams[self._count] = RemoteOverview(self.link, self.now, receive)
        await self._ask("overview", StreamParams(self._count))
        return overview

    async def exchanges(self, receive: Callable[[Mapping[str, Any]], None]) -> RemoteExchanges:
        """Call `receive` with the exchanges on the line, as described in docs/service.md."""
        self._count += 1
        exchanges = self._streams[self._count] = RemoteExchanges(receive, partial(self.end_stream, self._count))
        await self._ask("exchanges", StreamParams(self._count))
        return exchanges

    def end_stream(self, number: int) -> None:
        """End a stream."""
        stream = self._streams.pop(number, None)
        if stream is not None:
            self.link.notify("end", StreamParams(number))
            stream.end()

    # inside

    async def _read_clock(self) -> None:
        """Read the owner's clock. Correct the offset only if this reply excludes it: a slow reply permits many.

        Of the offsets that are possible, the lowest is used: with a higher one, an old write would seem to be new.
        """
        asked = time.monotonic()
        now: float = await self._ask("now", NoParams())
        lowest, highest = now - time.monotonic(), now - asked
        if not lowest <= self._ahead <= highest:
            self._ahead = lowest

    async def _follow_clock(self) -> None:
        """Read the owner's clock until the connection ends."""
        while True:
            await asyncio.sleep(CLOCK_PERIOD)
            await self._read_clock()

    async def _ask(self, method: str, params: Struct, *, writes: bool = False) -> Any:
        asked = self.link.ask(method, params, writes=writes)
        return await self.link.answer(asked)

    def _new_group(
        self, name: str, points: tuple[Point[Any], ...], period: float, request: RequestGroup
    ) -> RemoteGroup:
        """Return a poll group that requests its cycles once it begins."""

        def begin(group: RemoteGroup) -> tuple[int, asyncio.Task[None]]:
            self._count += 1
            self._streams[self._count] = group
            opening = asyncio.ensure_future(self._open(group, self._count, request))
            self._tasks.add(opening)
            opening.add_done_callback(self._tasks.discard)
            return self._count, opening

        return RemoteGroup(name, points, period=period, find=self.find, begin=begin, end=self.end_stream)

    async def _open(self, group: RemoteGroup, stream: int, request: RequestGroup) -> None:
        """Have the owner send the cycles of a group. An error ends the group, whose consumers raise it."""
        try:
            await request(group, stream)
        except (BusError, InvalidCommand) as error:
            group.end(error)
            self.end_stream(stream)

    async def _subscribe(self, name: str, group: RemoteGroup, stream: int) -> None:
        result: SubscribeResult = await self._ask("subscribe", SubscribeParams(name, stream))
        group.period = result.period

    async def _poll(self, points: tuple[Point[Any], ...], params: PollParams, group: RemoteGroup, stream: int) -> None:
        forms = encode_points(points)
        while len(forms) > POINTS_IN_A_MESSAGE:
            await self._ask("gather", GatherParams(stream, forms[:POINTS_IN_A_MESSAGE]))
            del forms[:POINTS_IN_A_MESSAGE]
        result: PollResult = await self._ask("poll", replace(params, stream=stream, points=forms))
        group.period, group.owners_name = result.period, result.name
        self._own_names.add(group.owners_name)

    def _receive(self, method: str, params: Any) -> None:
        """Handle a notification of the owner."""
        match params:
            case StopsParams():
                node = self._nodes.get((params.protocol, params.address))
                if node is not None:
                    node.stops = params.stops
            case PollGroupsParams():
                self._listed = {group.name: group.period for group in params.groups}
            case AccessParams():
                self.about = {**self.about, "read_only": params.read_only}
                for notify in self.on_access:
                    notify()
            case TouchedParams():
                self._touched[params.protocol, params.address] = params.when
                for take in self.on_touched:
                    take(to_builtins(params))
            case StreamMessage() if method == "event":
                try:
                    event = event_of(params.body, self.find)
                except InvalidCommand:  # a node whose protocol is not installed here, as in `nodes`
                    return
                for stream in self._events:
                    stream.put(event)
            case StreamMessage():
                if (listener := self._streams.get(params.stream)) is not None:
                    listener.receive(method, params)

    def _lost(self) -> None:
        if self._clock_task is not None:
            self._clock_task.cancel()
        for listener in list(self._streams.values()):
            # One that is not accepted yet ends with the error of that.
            if not (isinstance(listener, RemoteGroup) and listener.is_opening):
                listener.end()
        self._streams.clear()  # the results of later writes do not arrive here
        for stream in list(self._events):
            stream.close()
