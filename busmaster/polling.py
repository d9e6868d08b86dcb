"""Poll groups: points with a period, and the snapshots that their consumers get."""

from __future__ import annotations

import enum
from collections import deque
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import anyio

from busmaster.arbiter.counters import Quantiles
from busmaster.arbiter.schedule import Poll, line_time, set_members
from busmaster.arbiter.transaction import Priority, Timeline, Transaction
from busmaster.errors import BusClosed, BusError, GarbledReply, InvalidCommand
from busmaster.points import Point

if TYPE_CHECKING:
    from busmaster.bus import Bus

T = TypeVar("T")


class Quality(enum.Enum):
    """GOOD; LATE: begun after the nominal reply time; STALE: older than a write to it; BAD: no value."""

    GOOD = "good"
    LATE = "late"
    STALE = "stale"
    BAD = "bad"


class Sample(NamedTuple):
    """One point's outcome in one cycle. Times are the bus's clock (`bus.now()`), in seconds."""

    value: Any
    error: BusError | None
    due: float
    started: float | None
    finished: float
    quality: Quality
    timeline: Timeline

    def age(self, now: float) -> float:
        """Seconds since the value was asked for."""
        return now - (self.finished if self.started is None else self.started)


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot(Mapping[Point[Any], Sample]):
    """One cycle of a poll group. `missed` counts the cycles that could not start since the group was made."""

    group: str
    cycle: int
    due: float
    started: float | None
    finished: float
    missed: int
    samples: dict[Point[Any], Sample]

    def __getitem__(self, point: Point[Any]) -> Sample:
        return self.samples[point]

    def __iter__(self) -> Iterator[Point[Any]]:
        return iter(self.samples)

    def __len__(self) -> int:
        return len(self.samples)


@dataclass(frozen=True, slots=True)
class GroupStatistics:
    """`period` as asked, `achieved` as seen (mean, seconds); `jitter` is from a cycle's due time to its start."""

    cycles: int
    missed: int
    period: float
    achieved: float
    jitter: Quantiles


class Stream(Generic[T]):
    """One consumer, at its own pace: bounded, it drops the oldest and counts them in `dropped`."""

    def __init__(self, listeners: list[Stream[T]], buffer: int) -> None:
        if buffer < 1:
            raise InvalidCommand(f"a buffer holds at least one item, not {buffer}")
        self._listeners = listeners
        self._items: deque[T] = deque(maxlen=buffer)
        self._arrived = anyio.Event()
        self._closed = False
        self.dropped = 0
        listeners.append(self)

    def __aiter__(self) -> AsyncIterator[T]:
        return self

    async def __anext__(self) -> T:
        while not self._items:
            if self._closed:
                raise StopAsyncIteration
            self._arrived = anyio.Event()
            await self._arrived.wait()
        return self._items.popleft()

    def close(self) -> None:
        """It gets nothing more; what it holds can still be read."""
        self._closed = True
        if self in self._listeners:
            self._listeners.remove(self)
        self._arrived.set()

    def put(self, item: T) -> None:
        """Give the consumer one more; the oldest is dropped where it does not keep up."""
        if len(self._items) == self._items.maxlen:
            self.dropped += 1
        self._items.append(item)
        self._arrived.set()


class PollGroup:
    """Points that are read once a period. Made by `Bus.poll_group`; iterate it, or look at `latest`."""

    def __init__(
        self,
        bus: Bus,
        name: str,
        period: float,
        points: Iterable[Point[Any]],
        *,
        phase: float | None,
        priority: Priority,
    ) -> None:
        self.name = name
        self.latest: Snapshot | None = None
        self._bus = bus
        self._priority = priority
        self._poll = Poll(name, period, phase=phase)
        self._poll.waiter = self
        self._points: tuple[Point[Any], ...] = ()
        self._served: dict[Transaction, tuple[Point[Any], ...]] = {}
        self._consumers: list[Stream[Snapshot]] = []
        self._first_due: float | None = None
        self._last_due = 0.0
        self._set_points(points)

    @property
    def points(self) -> tuple[Point[Any], ...]:
        return self._points

    @property
    def period(self) -> float:
        return self._poll.period

    @property
    def poll(self) -> Poll:
        """The arbiter's side of the group."""
        return self._poll

    @property
    def paused(self) -> bool:
        return self._poll.paused

    def add(self, *points: Point[Any]) -> None:
        """From the next cycle on. Points that it has already are left alone."""
        self._set_points((*self._points, *points))

    def remove(self, *points: Point[Any]) -> None:
        """From the next cycle on."""
        self._set_points(point for point in self._points if point not in points)

    def pause(self) -> None:
        """No cycle starts, and none is counted missed, until `resume`."""
        self._poll.paused = True

    def resume(self) -> None:
        """Back on the grid."""
        self._poll.paused = False

    def demand(self) -> None:
        """Poll now, off the grid. A cycle that is running serves."""
        self._bus.demand(self._poll)

    def close(self) -> None:
        """End the group; its consumers end after what they hold."""
        self._bus.remove_group(self)
        for consumer in list(self._consumers):
            consumer.close()

    def subscribe(self, buffer: int = 16) -> Stream[Snapshot]:
        """A consumer with a buffer of so many snapshots. Close it when it is not read any more."""
        if not self._poll.active:
            raise BusClosed(f"poll group {self.name!r} is closed")
        return Stream(self._consumers, buffer)

    async def __aiter__(self) -> AsyncIterator[Snapshot]:
        consumer = self.subscribe()
        try:
            async for snapshot in consumer:
                yield snapshot
        finally:
            consumer.close()

    def statistics(self) -> GroupStatistics:
        poll = self._poll
        achieved = 0.0
        if self._first_due is not None and poll.cycles > 1:
            achieved = (self._last_due - self._first_due) / (poll.cycles - 1)
        return GroupStatistics(poll.cycles, poll.missed, poll.period, achieved, Quantiles.of(poll.jitter))

    def cycle_finished(self) -> None:
        """The arbiter has run a cycle: make its snapshot and hand it round. Runs in the pump: no user code."""
        poll = self._poll
        if self._first_due is None:
            self._first_due = poll.started if poll.started > 0 else poll.due
        self._last_due = poll.started if poll.started > 0 else poll.due
        samples: dict[Point[Any], Sample] = {}
        for transaction in poll.results:
            for point in self._served[transaction]:
                samples[point] = self._sample(point, transaction)
        started = poll.started if poll.started > 0 else None
        snapshot = Snapshot(self.name, poll.cycles, poll.due, started, poll.finished, poll.missed, samples)
        self.latest = snapshot
        for consumer in self._consumers:
            consumer.put(snapshot)

    def _sample(self, point: Point[Any], transaction: Transaction) -> Sample:
        error = transaction.error
        value = None
        quality = Quality.BAD
        if error is None:
            quality = Quality.LATE if transaction.late else Quality.GOOD
            if transaction.started < self._bus.touched_at(point):
                quality = Quality.STALE
            value = transaction.value
            if point.decode is not None:
                try:
                    value = point.decode(value)
                except (ValueError, ArithmeticError) as bad:
                    value, quality = None, Quality.BAD
                    error = GarbledReply(f"{value!r} is no value of {point.item}: {bad}", node=point.node.label)
        timeline = transaction.timeline()
        return Sample(value, error, self._poll.due, timeline.started, transaction.ended_at, quality, timeline)

    def _set_points(self, points: Iterable[Point[Any]]) -> None:
        """Two points with one command behind them cost one exchange."""
        unique = tuple(dict.fromkeys(points))
        for point in unique:
            if point.node.bus is not self._bus:
                raise InvalidCommand(f"poll group {self.name!r}: {point.key} belongs to another bus")
        behind: dict[tuple[Any, Any], list[Point[Any]]] = {}
        for point in unique:
            behind.setdefault((point.node, point.command), []).append(point)
        fresh = {Transaction(node.record, command): tuple(served) for (node, command), served in behind.items()}
        current = {t: self._served[t] for t in self._poll.results if t in self._served}
        self._points = unique
        self._served = {**current, **fresh}
        set_members(self._poll, fresh, self._priority)
        self._poll.cost = sum(
            line_time(t.command.open(t.node.address, t.node.timings), self._bus.byte_time) for t in fresh
        )
