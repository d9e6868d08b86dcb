"""A line that another program owns: what a client of it holds in its hands."""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import AsyncIterator, Callable, Hashable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from types import TracebackType
from typing import Any, TypeVar, Unpack

from busmaster.arbiter.counters import LineStatistics
from busmaster.bus.alarms import BusEvent
from busmaster.bus.limits import Limit
from busmaster.bus.points import Point
from busmaster.bus.requester import ORDINARY, CommandOptions, Priority, RequestOptions
from busmaster.bus.samples import Sample
from busmaster.bus.snapshots import Snapshot, Stream
from busmaster.contract.exchange import Command
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import BusClosed, BusError, InvalidCommand
from busmaster.planning.merging import Merge
from busmaster.service.link import TCP, Asked, Link
from busmaster.service.messages import MOST_CHECKED, said_timings, value_of
from busmaster.service.remote_exchanges import RemoteExchanges
from busmaster.service.remote_overview import RemoteOverview
from busmaster.service.safe import outcomes_of
from busmaster.service.telling import (
    event_of,
    point_of,
    protocol_of,
    said_points,
    snapshot_of,
    statistics_of,
)

T = TypeVar("T")
EVENT_BUFFER = 256


def connect(address: str, *, token: str | None = None) -> RemoteBus:
    """Return the bus that another program owns, for `async with`, which connects.

    `address` is `unix:PATH`, or the name of a line or of its port, as `busmaster status` lists them; or
    `tcp://HOST:PORT`, where a `token` that the line's owner knows may be needed. The token goes over the network as it
    is. Raises InvalidCommand for a token anywhere else: there the kernel says who comes.
    """
    return RemoteBus(address, token=token)


class RemoteNode:
    """One node of a line that another program owns. Handles and points work on it as on a node of this process."""

    def __init__(self, bus: RemoteBus, profile: Profile, address: int) -> None:
        self.stops = 0
        """How often it was told to stop, by whatever program, since this one named it."""
        self.label = profile.label(address)
        self._bus = bus
        self._profile = profile
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
        """Tell the line that this node is being told to stop, ahead of whatever is asked of it from now on."""
        self.stops += 1
        self._bus.link.tell("stop", {"protocol": self.profile.name, "address": self.address})

    def now(self) -> float:
        """Return the time of the line's clock, in seconds: that of the machine, which is the same for all programs."""
        return self._bus.now()

    def latest(self, point: Hashable, /) -> Sample[Any] | None:
        """Return None: only the line knows of every write that makes a sample stale."""
        return None

    def merge_reads(self, merge: Merge, /) -> None:
        """Have the profile propose `merge`. What is merged on the line is its owner's affair."""
        self._profile = replace(self._profile, merge=merge)

    def limit(self, limit: Limit, /) -> None:
        """Raise InvalidCommand: limits are held by the program that owns the line, for all programs."""
        raise InvalidCommand(f"{self.label}: limits are held by the program that owns the line: set {limit.name} there")

    def check(self, *commands: Command[Any], stop: bool | None = None) -> None:
        """Have the line check these writes when the bus is entered: entering raises InvalidCommand for a bad one.

        Later it does nothing: the line checks each write as it comes. Of several, those before a bad one are written.
        """
        self._bus.prepare(self, commands, stop is True)

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
        """Run one command on the line and return its value: as `Requester.request`, with the same errors.

        If the connection is lost meanwhile, a write raises WriteUnconfirmed, or NotStarted where it was not handed over
        yet, and a read LineDown. Cancelling it cancels it there.
        """
        chosen = RequestOptions.of(options, self.label) if options else ORDINARY
        if chosen.verify:
            raise InvalidCommand(f"{self.label}: verify is for what writes a value through a handle")
        if chosen.safe:
            raise InvalidCommand(f"{self.label}: the safe state is sent by the program that owns the line")
        params = self._said(command, options, touches, stops_seen, stop)
        link = self._bus.opened(self, str(command))
        asked = link.ask("request", params, writes=command.writes, node=self, command=str(command))
        value: T = value_of(await link.answer(asked, chosen.finish_within))
        return value

    def _said(
        self,
        command: Command[Any],
        options: Mapping[str, Any],
        touches: Command[Any] | None,
        stops_seen: int | None,
        stop: bool,
    ) -> dict[str, Any]:
        params: dict[str, Any] = {
            "protocol": self.profile.name,
            "address": self.address,
            "command": self._protocol.write_down(command),
            "asked": self.now(),
        }
        if touches is not None:
            params["touches"] = self._protocol.write_down(touches)
        if stops_seen is not None:
            params["stops_seen"] = stops_seen
        if stop:
            params["stop"] = True
        if given := {name: value for name, value in options.items() if value is not None and name not in LEFT_OUT}:
            params["options"] = given
        return params

    def said_check(self, commands: Iterable[Command[Any]], stop: bool) -> dict[str, Any]:
        """Return writes of this node as the line is asked whether it would take them."""
        said = [self._protocol.write_down(command) for command in commands]
        return {"protocol": self.profile.name, "address": self.address, "commands": said, "stop": stop}


LEFT_OUT = ("verify", "safe")


class RemoteGroup:
    """A poll group of the line. Iterate it, or look at `latest`; close it when it is not read any more."""

    def __init__(self, bus: RemoteBus, name: str, number: int, points: tuple[Point[Any], ...]) -> None:
        self.name = name
        self.period = 0.0
        self.latest: Snapshot | None = None
        """That of its last cycle."""
        self.dropped = 0
        """Cycles that this program was too slow for, counted by the line's owner."""
        self._bus = bus
        self._number = number
        self._own = points
        self._points = points
        self._set = -1
        self._consumers: list[Stream[Snapshot]] = []
        self._over = False

    @property
    def points(self) -> tuple[Point[Any], ...]:
        return self._points

    def subscribe(self, buffer: int = 16) -> Stream[Snapshot]:
        """Return a consumer with a buffer of so many snapshots. Close it when it is not read any more."""
        if self._over:
            raise BusClosed(f"poll group {self.name!r} is closed")
        return Stream(self._consumers, buffer)

    async def __aiter__(self) -> AsyncIterator[Snapshot]:
        consumer = self.subscribe()
        try:
            async for snapshot in consumer:
                yield snapshot
        finally:
            consumer.close()

    def close(self) -> None:
        """Read it no more; one that this program made ends."""
        if not self._over:
            self._bus.end_stream(self._number)

    def hear(self, method: str, params: Mapping[str, Any]) -> None:
        """Take what the line's owner says of it."""
        body = params["body"]
        for consumer in self._consumers:
            consumer.dropped += params["dropped"] - self.dropped
        self.dropped = params["dropped"]
        if method == "points":
            self._set = body["set"]
            # By its own points, a program gets the values that they decode.
            if not self._own:
                self._points = tuple(point_of(said, self._bus.find) for said in body["points"])
        elif method == "snapshot" and body["set"] == self._set:
            self.latest = snapshot_of(body, self.name, self._points)
            for consumer in self._consumers:
                consumer.put(self.latest)
        elif method == "ended":
            self._bus.end_stream(self._number)

    def end(self) -> None:
        """End those who read it, after what they hold."""
        self._over = True
        for consumer in list(self._consumers):
            consumer.close()


class RemoteBus:
    """A line that another program owns. Use it in `async with`: entering connects, leaving lets go.

    Handles take it as they take a Bus: `MicroFlexDrive(remote, 7)`. What is safe lives with the line: a stop of any
    program counts for all, limits and the record of writes are the owner's. A node that the owner does not have is
    asked as this program says, and leaves the line with it. Entering raises LineDown if nobody serves the line, and
    InvalidCommand for a name that nobody's line has, and for a write that was prepared before and that the line would
    not take. A lost connection is not made again: enter a new RemoteBus.
    """

    def __init__(self, address: str, *, token: str | None = None) -> None:
        if token is not None and not address.startswith(TCP):
            raise InvalidCommand(f"{address} takes no token: it is for tcp://HOST:PORT")
        if token is not None and not (token.isascii() and token.isprintable() and token.split() == [token]):
            raise InvalidCommand("a token is of letters, digits and signs, without spaces")
        self.address = address
        self._token = token
        self.line = ""
        """The name of the line's port, once it is entered."""
        self.about: Mapping[str, Any] = {}
        """What the owner says of the line: its name, settings and process."""
        self._link: Link | None = None
        self._nodes: dict[tuple[str, int], RemoteNode] = {}
        self._named: dict[RemoteNode, tuple[Timings | Learned | None, int | None]] = {}
        self._told: set[RemoteNode] = set()
        """Those of them of which the owner knows."""
        self._streams: dict[int, RemoteGroup | RemoteOverview | RemoteExchanges] = {}
        self._count = 0
        self._events: list[Stream[BusEvent]] = []
        self._hears_events = False
        self._prepared: list[tuple[RemoteNode, tuple[Command[Any], ...], bool]] = []
        """Writes that are to be checked before the first of them is sent."""

    async def __aenter__(self) -> RemoteBus:
        if self._link is not None:
            raise InvalidCommand(f"the bus of {self.address} was entered already: enter it once, and share it")
        link = Link(self.address, self._token, self._hear, self._lost)
        self._link = link
        said = await link.open(sys.argv[0])
        self.about, self.line = said, said["line"]
        for known in said["nodes"]:
            node = self._nodes.get((known["protocol"], known["address"]))
            if node is not None:
                node.label = known["label"]
        for node in self._named:
            self._name(node)
        try:
            for node, commands, stop in self._prepared:
                for first in range(0, len(commands), MOST_CHECKED):
                    await self._ask("check", node.said_check(commands[first : first + MOST_CHECKED], stop))
        except BaseException:
            await link.close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Let go: what this program asked for ends, and the line goes on."""
        await self.link.close()

    @property
    def link(self) -> Link:
        """Return the connection. Raises BusClosed before the bus is entered."""
        if self._link is None:
            raise BusClosed("the bus is not open")
        return self._link

    def opened(self, node: RemoteNode, command: str) -> Link:
        """Return the connection for a request. Raises BusClosed, naming it, before the bus is entered."""
        if self._link is None:
            raise BusClosed("the bus is not open", node=node, command=command)
        return self._link

    def prepare(self, node: RemoteNode, commands: tuple[Command[Any], ...], stop: bool) -> None:
        """Have these writes checked when the bus is entered, if it is not yet."""
        if self._link is None:
            self._prepared.append((node, commands, stop))

    def now(self) -> float:
        """Return the time of the line's clock, in seconds: that of the machine, which is the same for all programs."""
        return time.monotonic()

    # nodes

    def node(
        self, profile: Profile, address: int, *, timings: Timings | Learned | None = None, retries: int | None = None
    ) -> RemoteNode:
        """Return the node at this address, as `Bus.node` does.

        Raises InvalidCommand for an address that the protocol does not have, and for other timings or retries than this
        program named first. What the line's owner has against them, the node's requests raise.
        """
        profile.check_address(address)
        node = self._find(profile, address)
        said = self._named.setdefault(node, (timings, retries))
        if timings not in (None, said[0]) or retries not in (None, said[1]):
            raise InvalidCommand(
                f"{node.label} is in use already, and now asked for with other timings or retries: "
                "give all handles of an address the same options, or leave them out in all but the first"
            )
        if self._link is not None:
            self._name(node)
        return node

    def find(self, protocol: str, address: int) -> RemoteNode:
        """Return a node that the owner speaks of, by the name of its protocol. It is not named for that."""
        return self._find(protocol_of(protocol).profile, address)

    def _find(self, profile: Profile, address: int) -> RemoteNode:
        if profile != protocol_of(profile.name).profile:
            raise InvalidCommand(f"{profile.label(address)}: only the usual {profile.name} is spoken on another's line")
        key = profile.name, address
        return self._nodes.get(key) or self._nodes.setdefault(key, RemoteNode(self, profile, address))

    def _name(self, node: RemoteNode) -> None:
        """Tell the owner that this program uses a node, and how: once."""
        if node in self._told:
            return
        self._told.add(node)
        timings, retries = self._named[node]
        params: dict[str, Any] = {"protocol": node.profile.name, "address": node.address}
        if timings is not None:
            params["timings"] = said_timings(timings)
        if retries is not None:
            params["retries"] = retries
        asked = self.link.ask("node", params, node=node)

        def named(future: asyncio.Future[Any]) -> None:
            if not future.cancelled() and future.exception() is None:
                node.label = future.result()["label"]

        asked.future.add_done_callback(named)

    # looking

    async def statistics(self) -> LineStatistics:
        """Return an immutable snapshot of the line's counts, as `Bus.statistics`."""
        return statistics_of(await self._ask("statistics", {}))

    async def group(self, name: str) -> RemoteGroup:
        """Return a poll group of the line by its name. Raises InvalidCommand if there is none.

        Its samples are those that the line's owner makes: of bits, the number.
        """
        return await self._follow("subscribe", name, (), {"group": name})

    async def poll_group(
        self,
        name: str,
        *,
        period: float,
        points: Iterable[Point[Any]],
        phase: float | None = None,
        priority: Priority = Priority.POLL,
    ) -> RemoteGroup:
        """Have `points` read every `period` seconds, as `Bus.poll_group`; it ends with this program."""
        wanted = tuple(points)
        params: dict[str, Any] = {"name": name, "period": period, "points": said_points(wanted)}
        params |= {"phase": phase, "priority": priority}
        return await self._follow("poll", name, wanted, params)

    async def enter_safe_state(self, values: Mapping[str, float]) -> dict[str, BusError | None]:
        """Have the line's owner send its safe state, and return by point why it was not confirmed, None if it was.

        `values` is what the caller takes that to be, by the names of the file's points. Raises InvalidCommand, and
        nothing is sent, if it is something else, or this program may not write all of it.
        """
        return outcomes_of(await self._ask("safe", {"writes": dict(values)}, writes=True))

    async def groups(self) -> tuple[str, ...]:
        """Return the names of the line's poll groups."""
        return tuple(group["name"] for group in await self._ask("groups", {}))

    def events(self) -> Stream[BusEvent]:
        """Return a stream of what happens to line and nodes from now on; a node in it is this program's."""
        stream: Stream[BusEvent] = Stream(self._events, EVENT_BUFFER)
        if not self._hears_events:
            self._hears_events = True
            self.link.ask("events", {"stream": 0})
        return stream

    async def overview(self, hear: Callable[[str, Mapping[str, Any]], None]) -> RemoteOverview:
        """Have `hear` told what a person sees of the line, some times a second, as docs/service.md has it."""
        self._count += 1
        overview = self._streams[self._count] = RemoteOverview(self.link, self.now, hear)
        await self._ask("overview", {"stream": self._count})
        return overview

    async def exchanges(self, hear: Callable[[Mapping[str, Any]], None]) -> RemoteExchanges:
        """Have `hear` told what passes on the line, exchange by exchange, as docs/service.md has it."""
        self._count += 1
        exchanges = self._streams[self._count] = RemoteExchanges(hear, partial(self.end_stream, self._count))
        await self._ask("exchanges", {"stream": self._count})
        return exchanges

    def end_stream(self, number: int) -> None:
        """Have a stream told no more."""
        stream = self._streams.pop(number, None)
        if stream is not None:
            self.link.tell("end", {"stream": number})
            stream.end()

    # inside

    async def _ask(self, method: str, params: Mapping[str, Any], *, writes: bool = False) -> Any:
        asked = self.link.ask(method, params, writes=writes)
        return await self.link.answer(asked)

    async def _follow(
        self, method: str, name: str, points: tuple[Point[Any], ...], params: Mapping[str, Any]
    ) -> RemoteGroup:
        self._count += 1
        number = self._count
        group = self._streams[number] = RemoteGroup(self, name, number, points)
        asked: Asked = self.link.ask(method, {**params, "stream": number})
        try:
            group.period = (await self.link.answer(asked))["period"]
        except BaseException:
            self.end_stream(number)
            raise
        return group

    def _hear(self, method: str, params: Mapping[str, Any]) -> None:
        if method == "stops":
            node = self._nodes.get((params["protocol"], params["address"]))
            if node is not None:
                node.stops = params["stops"]
        elif method == "event":
            event = event_of(params["body"], self.find)
            for stream in self._events:
                if event is not None:
                    stream.put(event)
        elif (listener := self._streams.get(params.get("stream", -1))) is not None:
            listener.hear(method, params)

    def _lost(self) -> None:
        for listener in list(self._streams.values()):
            listener.end()
        for stream in list(self._events):
            stream.close()
