"""The overview of a line for screens: its points, groups, nodes and last events, sent a few times a second.

It is made once for all clients, in slices, so that the line is not delayed. A message replaces the unsent one before
it: a slow client gets fewer pictures, and delays no other client.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from operator import is_
from typing import Any

from busmaster import Bus, Health, LineState, Node, Point, PollGroup, Sample, Snapshot, ext
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.fields import Number
from busmaster.app.service.messages import encode, encode_number
from busmaster.app.service.owner_messages import (
    DetailsResult,
    FrameBody,
    GroupCounts,
    GroupsBody,
    LimitForm,
    NodeCounts,
    NodesBody,
    RowForm,
    RowsBody,
    ShownValue,
    TimelineForm,
    ValuesBody,
)
from busmaster.app.service.streams import Broadcast, Place
from busmaster.app.service.typed import Raw
from busmaster.app.service.values import event_text, value_text
from busmaster.events import AlarmChanged
from busmaster.ext import Placed, RecentUtilisation

INTERVAL = 0.2
"""Seconds between two pictures."""
COUNTED_EVERY = 0.5
"""Seconds between two looks at the counts of nodes and groups."""
PART = 50
"""Points in one message, which is made in one turn of the line's loop."""
COUNTED_AT_ONCE = 5
"""Nodes, or groups, that are."""
MOST_POINTS = 10_000
"""Points of a picture. The number of further points is sent."""
MOST_COUNTED = 2_000
"""Nodes, and groups, of a picture."""
KEPT_EVENTS = 20
UTILISATION_WINDOW = 1.0
"""Seconds."""
STATES = {LineState.OFFLINE: "offline", LineState.RESYNCHRONISING: "resynchronising"}
"""States with a text of their own; in every other state the line is ready."""


class EventLog:
    """The last events of a line, as sentences, for clients that connect later."""

    def __init__(self, bus: Bus) -> None:
        self.entries: deque[tuple[float, str]] = deque(maxlen=KEPT_EVENTS)
        """Each with when it was noted, by the bus's clock."""
        self._bus = bus
        self._stream = bus.events()
        self._task: asyncio.Task[None] | None = None

    def begin(self) -> None:
        """Record the events since this object was made, or since this call after `close`, and from now on."""
        if self._task is not None:  # the line is served again, and its stream of events was closed
            self._stream = self._bus.events()
        self._task = asyncio.ensure_future(self._listen())

    def note(self, text: str) -> None:
        """Keep a sentence."""
        self.entries.append((self._bus.now(), text))

    async def close(self) -> None:
        """Stop listening."""
        self._stream.close()
        if self._task is not None:
            await self._task

    async def _listen(self) -> None:
        async for event in self._stream:
            if text := event_text(event):
                self.note(text)


class Part:
    """Some points of a group, in the form of messages. `first`: the place of the first of them in the picture."""

    def __init__(self, group: PollGroup, points: Sequence[Point[Any]], first: int) -> None:
        self.group = group
        self.first = first
        self._points = points
        self._seen: object = None
        """What its values were worked out of: the cycle, the last write, and whether the line was there."""
        self._snapshot: Snapshot | None = None
        self.rows = b""
        self.values = b""

    def send_rows(self, number: int) -> None:
        """Work out what these points are, in the picture's `number`-th set."""
        rows = [_encode_point(self.group, point) for point in self._points]
        self.rows = encode(RowsBody(number, self.first, rows))
        self.values = encode(ValuesBody(number, self.first, []))

    def send_values(self, number: int, bus: Bus) -> bool:
        """Work out what these points hold now, and return whether that is something else than before."""
        snapshot, line = self.group.latest, ext.line_of(bus)
        if snapshot is None:
            return False
        touched = line.last_touched if line.last_touched > snapshot.due else None  # an older write changes nothing here
        seen = (id(snapshot), snapshot.cycle, touched, line.condition)
        if seen == self._seen:
            return False
        self._seen = seen
        self._snapshot = snapshot  # kept: no other can have its id then, as one with a value read after a write could
        alarms = bus.alarms
        values = [_encode_value(bus, point, snapshot.samples.get(point), alarms.get(point)) for point in self._points]
        before, self.values = self.values, encode(ValuesBody(number, self.first, values))
        return self.values != before


class Overview(Broadcast):
    """The pictures of one line. `title` returns the title above them."""

    def __init__(
        self,
        bus: Bus,
        authorisation: Authorisation,
        journal: EventLog,
        title: Callable[[], str],
        on_end: Callable[[], None],
    ) -> None:
        super().__init__(on_end)
        self._bus = bus
        self._authorisation = authorisation
        self._journal = journal
        self._title = title
        self._fresh: list[Place] = []
        self._set = 0
        self._groups: list[tuple[PollGroup, tuple[Point[Any], ...]]] = []
        self._parts: list[Part] = []
        self._left_out = 0
        self._counted_at = -COUNTED_EVERY
        self._counts: dict[tuple[str, int], bytes] = {}
        self._utilisation = RecentUtilisation(UTILISATION_WINDOW)

    def join(self, reader: Any, stream: int) -> None:
        """Send everything to this client, and from then on the changes."""
        self._fresh.append((reader, stream))
        super().join(reader, stream)

    async def _notify(self) -> None:
        while True:
            fresh, self._fresh = self._fresh, []
            await self._send_points(fresh)
            await self._send_counts(fresh)
            await self._send("frame", 0, encode(self._frame()), tuple(self.readers))
            await asyncio.sleep(INTERVAL)

    async def _send(self, method: str, part: int, body: bytes, places: Sequence[Place]) -> None:
        async for reader, stream in self._in_turns(places):
            reader.notify_surely(stream, method, Raw(body), part)

    # points

    async def _send_points(self, fresh: Sequence[Place]) -> None:
        new = self._regroup()
        for number, part in enumerate(self._parts):
            if new:
                part.send_rows(self._set)
            await self._send("rows", number, part.rows, tuple(self.readers) if new else fresh)
            changed = part.send_values(self._set, self._bus)
            await self._send("values", number, part.values, tuple(self.readers) if changed else fresh)
            if new or changed:
                await asyncio.sleep(0)

    def _regroup(self) -> bool:
        """Take the groups as they are now, and return whether there are other points than before."""
        groups = [(group, group.points) for group in self._bus.groups[:MOST_COUNTED]]
        if len(groups) == len(self._groups) and all(map(_same, groups, self._groups)):
            return False
        self._set += 1
        self._groups = groups
        total = sum(len(points) for _, points in groups)
        self._left_out = max(0, total - MOST_POINTS)
        self._parts = list(self._divide())
        self._counted_at = -COUNTED_EVERY
        return True

    def _divide(self) -> Iterator[Part]:
        first = 0
        for group, points in self._groups:
            for start in range(0, min(len(points), MOST_POINTS - first), PART):
                part = points[start : start + min(PART, MOST_POINTS - first)]
                yield Part(group, part, first)
                first += len(part)

    # counts

    async def _send_counts(self, fresh: Sequence[Place]) -> None:
        now = self._bus.now()
        due = now >= self._counted_at + COUNTED_EVERY
        if due:
            self._counted_at = now
            self._counts = {key: self._counts.get(key, b"") for key in self._count_keys()}
        for (method, first), body in self._counts.items():
            if due:
                body = encode(
                    _encode_groups(self._bus, first) if method == "groups" else _encode_nodes(self._bus, first)
                )
                self._counts[method, first] = body
                await asyncio.sleep(0)
            await self._send(method, first, body, tuple(self.readers) if due else fresh)

    def _count_keys(self) -> Iterator[tuple[str, int]]:
        for method, number in (("groups", len(self._bus.groups)), ("nodes", len(self._bus.nodes))):
            yield from ((method, first) for first in range(0, min(number, MOST_COUNTED), COUNTED_AT_ONCE))

    # the line

    def _frame(self) -> FrameBody:
        now, statistics = self._bus.now(), ext.line_statistics(self._bus)
        condition = self._bus.condition
        settings = self._bus.endpoint.settings
        return FrameBody(
            set=self._set,
            title=self._title(),
            line=self._bus.endpoint.name,
            settings=f"{settings.baudrate} {settings.framing}" if settings else "",
            read_only=self._authorisation.read_only,
            now=now,
            elapsed=statistics.elapsed,
            state=state_text(self._bus),
            why=condition.reason,
            since=condition.since if condition.is_lost else None,
            utilisation=self._utilisation.note(now, statistics),
            backlog=statistics.backlog,
            losses=statistics.losses,
            groups=min(len(self._bus.groups), MOST_COUNTED),
            nodes=min(len(self._bus.nodes), MOST_COUNTED),
            points=sum(len(points) for _, points in self._groups) - self._left_out,
            left_out=self._left_out,
            events=list(self._journal.entries),
        )


def state_text(bus: Bus) -> str:
    """Return what a line does: ready, resynchronising or offline."""
    return STATES.get(bus.state, "ready")


def health_text(node: Node) -> str:
    """Return how a node does: its health, or that it is suspended; a node of a lost line is offline in any case."""
    health = node.health
    return "suspended" if node.suspended and health is not Health.OFFLINE else health.value


def _same(one: tuple[PollGroup, tuple[Point[Any], ...]], other: tuple[PollGroup, tuple[Point[Any], ...]]) -> bool:
    """Return whether these are the same points: equal ones may mean something else."""
    return one[0] is other[0] and len(one[1]) == len(other[1]) and all(map(is_, one[1], other[1]))


def _encode_point(group: PollGroup, point: Point[Any]) -> RowForm:
    return RowForm(
        group=group.name,
        key=point.key,
        node=point.node.label,
        protocol=point.node.profile.name,
        kind=point.node.profile.kind_name,
        address=point.node.address,
        item=point.item,
        unit=point.unit,
        precision=point.meaning.precision,
        writable=point.writable,
    )


def _encode_value(
    bus: Bus, point: Point[Any], sample: Sample[Any] | None, alarm: AlarmChanged | None = None
) -> ShownValue | None:
    """Return the value of a point as it is at present, not at the time of the read.

    None if the cycle did not read the point.
    """
    if sample is None:
        return None
    sample = bus.as_of_now(point, sample)
    requested = sample.finished if sample.started is None else sample.started
    error = "" if sample.error is None else sample.error.what
    value = shown(point, sample.value)
    if isinstance(value, float):
        value = encode_number(value)
    return ShownValue(value, sample.quality.value, requested, error, alarm.name if alarm else "")


def shown(point: Point[Any], value: Any) -> Any:
    """Return a number as it is, by its exact type: words and flags are ints, too, and are shown by their names."""
    return value if type(value) in (int, float) or value is None else value_text(value, point.meaning.precision)


def encode_details(bus: Bus, group: PollGroup, point: Point[Any]) -> DetailsResult:
    """Return the details of one point of a group: its last exchange, its limits, and the meaning of its value."""
    sample = None if group.latest is None else group.latest.samples.get(point)
    if sample is not None:
        sample = bus.as_of_now(point, sample)
    meaning = point.meaning
    node = point.node if isinstance(point.node, Node) else None
    return DetailsResult(
        command=str(point.command),
        sample=_encode_value(bus, point, sample, bus.alarms.get(point)),
        hint="" if sample is None or sample.error is None else sample.error.hint or "",
        timeline=None if sample is None else TimelineForm(*sample.timeline),
        due=None if sample is None else sample.due,
        low=_encode_limit(meaning.low),
        high=_encode_limit(meaning.high),
        labels={str(number): label for number, label in meaning.labels.items()},
        limits=[
            LimitForm(
                limit.name,
                _encode_limit(limit.minimum),
                _encode_limit(limit.maximum),
                _encode_limit(limit.max_step),
                limit.writable,
            )
            for limit in (() if node is None else node.limits)
            if isinstance(point.command, Placed) and set(limit.places) & set(point.command.places)
        ],
    )


def _encode_limit(limit: float | None) -> Number | None:
    return None if limit is None else encode_number(limit)


def _encode_groups(bus: Bus, first: int) -> GroupsBody:
    groups = []
    for group in islice(bus.groups, first, first + COUNTED_AT_ONCE):
        counts = group.statistics()
        groups.append(
            GroupCounts(
                name=group.name,
                period=group.period,
                paused=group.paused,
                cycles=counts.cycles,
                missed=counts.missed,
                achieved=counts.achieved,
                jitter=counts.jitter.p99,
            )
        )
    return GroupsBody(first, groups)


def _encode_nodes(bus: Bus, first: int) -> NodesBody:
    return NodesBody(first, [_encode_node(node) for node in islice(bus.nodes, first, first + COUNTED_AT_ONCE)])


def _encode_node(node: Node) -> NodeCounts:
    counts = node.statistics()
    return NodeCounts(
        label=node.label,
        protocol=node.profile.name,
        kind=node.profile.kind_name,
        address=node.address,
        health=health_text(node),
        requests=counts.attempts,
        failed=counts.fruitless,
        late=counts.late,
        p50=counts.latency.p50,
        p99=counts.latency.p99,
    )
