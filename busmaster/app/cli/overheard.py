"""Samples of a file's points from the requests and replies of another master, without any transmission.

Replies contain neither an address nor a sequence number, and another master has its own rules. It can repeat a request,
or go on to the next node, while the first reply can still arrive. So a request stays *open* until its reply was
received for certain, or its node's maximum reply delay has passed. A reply that an open request could have caused is
discarded. A listener can still miss two frames in a row and attribute a reply to the wrong node. So the quality of its
values is never good, but overheard.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import inf
from typing import Any

import anyio

from busmaster import BusError, InvalidCommand, Node, Point, Quality, Sample, Snapshot, ext
from busmaster.app.config import LineFile
from busmaster.app.line import ConfiguredLine
from busmaster.capture import Direction, Frame, Kind
from busmaster.events import Stream
from busmaster.ext import Changing, Command, Driver, Placed, Protocol, ReadsPlaces, Timeline, find

Question = tuple[int, Command[Any]]
"""The address of a node, and the command."""
Clock = Callable[[], float]
"""Returns the time, in seconds."""
MOST_OPEN = 1000
"""More requests than fit into the longest maximum reply delay; the oldest goes."""


def silent(file: LineFile) -> LineFile:
    """Return the file with outputs that take no commands: nothing may be sent."""
    outputs = {kind: settings.without_commands() for kind, settings in file.outputs.items()}
    return replace(file, outputs=outputs)


def only_protocol(file: LineFile) -> str:
    """Return the protocol that a listener to the file reads.

    Raises InvalidCommand for a file with several kinds of nodes: a listener reads one.
    """
    names = {node.protocol for node in file.nodes.values()}
    used = {find(name).protocol.name for name in names}
    if len(used) > 1:
        raise InvalidCommand(f"monitor supports one protocol per line, and the file has {', '.join(sorted(used))}")
    return names.pop() if len(names) == 1 else used.pop()


class HeardGroup:
    """A poll group of the file: in each period, those of its points whose values passed."""

    def __init__(self, name: str, period: float, points: Sequence[Point[Any]], now: float) -> None:
        self.name = name
        self.period = period
        self.points = tuple(points)
        self.due = now + period
        self._cycle = 0
        self._heard: dict[Point[Any], Sample[Any]] = {}
        self._consumers: list[Stream[Snapshot]] = []

    def subscribe(self, buffer: int, *, changes: bool = False) -> Stream[Snapshot]:
        """Return a stream of the snapshots from now on, which holds `buffer` of them. Nothing changes in between."""
        return Stream(self._consumers, buffer)

    def take(self, point: Point[Any], sample: Sample[Any]) -> None:
        """Keep a sample for this period, if the point is of this group."""
        if point in self.points:
            self._heard[point] = sample

    def turn(self, now: float, wall: float) -> Snapshot | None:
        """Publish the samples since the last call, and return them; None if there are none."""
        # stays on its grid, even after a standstill
        due, self.due = self.due, self.due + self.period * max(1, (now - self.due) // self.period)
        if not self._heard:
            return None
        self._cycle += 1
        started = min(sample.finished for sample in self._heard.values())
        snapshot = Snapshot(self.name, self._cycle, due, started, now, 0, wall, self._heard)
        self._heard = {}
        for consumer in list(self._consumers):
            consumer.put(snapshot)
        return snapshot

    def close(self) -> None:
        """End all streams of this group."""
        for consumer in list(self._consumers):
            consumer.close()


@dataclass(frozen=True, slots=True)
class OpenRequest:
    """A request whose reply may still come, and would begin with one of `answers` (none: with anything)."""

    request: bytes
    answers: frozenset[bytes]
    until: float
    """From then on no reply to it can begin, on the clock of the frames."""


class Overheard:
    """Make samples from the frames of reads and confirmed writes, each of which can contain several points.

    A reply counts only if the exchange of its request accepts it, as in a master, and if it cannot belong to an open
    request. `clock` is the clock of the frames' times.
    """

    def __init__(self, protocol: Protocol, points: Iterable[Point[Any]], clock: Clock) -> None:
        self.groups: list[HeardGroup] = []
        self.ambiguous = 0
        """Number of replies that were discarded because they could have belonged to another request."""
        self._clock = clock
        self._open: list[OpenRequest] = []
        self._request_ended = -inf
        self._max_reply_delay = 0.0
        self._unread = False
        """The open request was not understood: how its reply begins is not known."""
        self._profile = protocol.profile
        self._dialect = protocol.dialect()
        self._nodes: dict[int, Node] = {}
        self._by_command: dict[Question, list[Point[Any]]] = {}
        self._by_place: dict[tuple[int, Hashable], list[Point[Any]]] = {}
        for point in points:
            node = self._nodes[point.node.address] = Node.of(point)
            self._by_command.setdefault((node.address, point.command), []).append(point)
            for place in point.command.places if isinstance(point.command, Placed) else ():
                self._by_place.setdefault((node.address, place), []).append(point)
        self._asked: tuple[Node, Command[Any]] | None = None
        self._driver: Driver | None = None

    def heard(self, frame: Frame) -> None:
        """Take the next frame that passed."""
        from_host = frame.sender is Direction.HOST
        if from_host and frame.kind in (Kind.READ, Kind.WRITE):  # a short command reads one more parameter
            self._ask(frame)
        elif from_host:
            self._give_up()  # in the midst of an exchange, it has given that up
        elif self._driver is not None:
            self._answer(self._driver, frame)
        elif self._unread and frame.answers and not frame.fault:
            self._unread = bool(self._still_open(frame))
        elif frame.fault and frame.sender is Direction.UNKNOWN:  # perhaps a request
            self._request_ended, self._max_reply_delay, self._unread = frame.ended, self._longest(), True

    def _ask(self, frame: Frame) -> None:
        """Begin an exchange. The reply to the request before can still arrive."""
        self._give_up()
        address = frame.node if self._profile.addressed else self._profile.addresses[0]
        node = None if address is None else self._nodes.get(address)
        self._request_ended, self._max_reply_delay, self._unread = frame.ended, self._longest(), True
        if frame.fault or address is None:
            return
        with suppress(InvalidCommand, KeyError, ValueError):
            command = self._dialect.command(frame, ())
            timings = self._profile.timings if node is None else node.timings
            exchange = command.open(address, timings)
            self._max_reply_delay = exchange.timing.max_reply_delay + (
                timings.packet.max_reply_delay if exchange.later else 0.0
            )
            self._driver = Driver(exchange, noise_tolerant=self._profile.noise_tolerant)
            self._asked = None if node is None else (node, command)  # a reply to a node that is in no group
            self._unread = False

    def _answer(self, driver: Driver, frame: Frame) -> None:
        timing, delay = driver.timing, frame.delay or 0.0
        if frame.fault or frame.sender is not Direction.NODE or delay > timing.max_reply_delay:
            self._give_up()  # whatever still comes may be anybody's
            return
        driver.feed(frame.raw)
        if driver.ending is None:
            return
        answers = frozenset(driver.exchange.answers)
        # any request can be refused, whatever its good replies begin with
        refused = not driver.ending.delivered
        possible = [one for one in self._still_open(frame) if refused or not one.answers or answers & one.answers]
        ambiguous = any(one.request != driver.exchange.request for one in possible)
        self.ambiguous += ambiguous
        if not (refused or ambiguous) and self._asked is not None:
            self._deliver(self._found(*self._asked, driver.ending.value), frame.time - frame.earlier)
        if possible:
            self._give_up()  # its own reply may be the one that still comes
        self._driver = None

    def _give_up(self) -> None:
        """Leave the exchange, whose reply may still come."""
        driver, self._driver = self._driver, None
        if self._unread or (driver is not None and driver.exchange.answered):
            request, overdue = (b"", ()) if driver is None else (driver.exchange.request, driver.exchange.overdue)
            self._open.append(OpenRequest(request, frozenset(overdue), self._request_ended + self._max_reply_delay))
            del self._open[:-MOST_OPEN]
        self._unread = False

    def _still_open(self, reply: Frame) -> list[OpenRequest]:
        """Return the earlier requests to which this can be the reply, judged by time."""
        came = reply.time - reply.earlier
        self._open = [request for request in self._open if request.until > came]
        return self._open

    def _longest(self) -> float:
        """Return the maximum reply delay of the node of the last request."""
        timings = (self._profile.timings, *(node.timings for node in self._nodes.values()))
        return max(
            max(each.read.max_reply_delay, each.write.max_reply_delay) + each.packet.max_reply_delay for each in timings
        )

    def _found(self, node: Node, command: Command[Any], value: Any) -> dict[Point[Any], Any]:
        """Return the value that each point of the exchange would have read."""
        found: dict[Point[Any], Any] = dict.fromkeys(self._by_command.get((node.address, command), ()), value)
        known: Mapping[Hashable, Any] = {}
        if isinstance(command, Changing):
            known = {place: now for place, now in command.changes(node.profile).items() if now is not None}
        elif isinstance(command, ReadsPlaces):
            known = command.place_values(value, node.profile)
        for place in known:
            for point in self._by_place.get((node.address, place), ()):
                assert isinstance(point.command, Placed)
                with suppress(KeyError):  # only a part of it was received
                    found.setdefault(point, point.command.shown(known))
        return found

    def _deliver(self, found: Mapping[Point[Any], Any], came: float) -> None:
        """Hand on values whose reply began at `came`, by the clock of the frames."""
        age = max(0.0, self._clock() - came)
        at, wall = time.monotonic() - age, time.time() - age
        timeline = Timeline(at, at, at, at, 1, 0, 0.0)
        for point, raw in found.items():
            with suppress(BusError):  # it stands for no value of the point
                sample = Sample(point.value_of(raw), None, at, at, at, Quality.OVERHEARD, timeline, wall)
                for group in self.groups:
                    group.take(point, sample)


async def feed(line: ConfiguredLine, overheard: Overheard, show: Callable[[Snapshot], None]) -> None:
    """Publish the samples of each group at its period, until cancelled. The outputs then write their queued data."""
    now = asyncio.get_running_loop().time
    for section in line.file.groups.values():
        overheard.groups.append(HeardGroup(section.name, section.period, line.members(section.name), now()))
    line.outputs.start(overheard.groups)
    try:
        while True:
            due = min((group.due for group in overheard.groups), default=now() + 1.0)
            await anyio.sleep(max(0.0, due - now()))
            for group in overheard.groups:
                if group.due <= now():
                    snapshot = group.turn(time.monotonic(), time.time())
                    if snapshot is not None:
                        show(snapshot)
                        ext.take_overheard(line.bus, snapshot.samples)
    finally:
        for group in overheard.groups:  # the samples of the last period, before the outputs end
            group.turn(time.monotonic(), time.time())
            group.close()
        await line.outputs.close()
