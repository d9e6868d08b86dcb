"""Snapshots and statistics of a poll group, and the streams that deliver them."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import AsyncIterator, Iterator, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, Generic, TypeVar

import anyio

from busmaster.arbiter.counters import Histogram, Quantiles
from busmaster.arbiter.transaction import Poll
from busmaster.bus.points import Point
from busmaster.bus.samples import Quality, Sample
from busmaster.contract.arguments import whole_number
from busmaster.errors import BusClosed

T = TypeVar("T")

RECENT_PERIODS = 1000
NO_SAMPLES = dict.fromkeys(Quality, 0)
"""Template for counting samples by quality. Copy it."""


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot(Mapping[Point[Any], Sample[Any]]):
    """One cycle of a poll group. `missed`: cycles that could not start since the group was made.

    Times are on the bus's clock (`bus.now()`), in seconds; `wall` is `finished` in seconds since 1970.
    """

    group: str
    cycle: int
    due: float
    started: float | None
    finished: float
    missed: int
    wall: float
    samples: dict[Point[Any], Sample[Any]]

    def __getitem__(self, point: Point[T]) -> Sample[T]:
        return self.samples[point]

    def wall_at(self, moment: float) -> float:
        """Return a time of the bus's clock in seconds since 1970, by the machine's clock of this cycle."""
        return self.wall + (moment - self.finished)

    def __iter__(self) -> Iterator[Point[Any]]:
        return iter(self.samples)

    def __len__(self) -> int:
        return len(self.samples)


class Outdated(Snapshot):
    """The values of a group that a write between two cycles has made stale, with the time of the write."""

    __slots__ = ()


class ReadAfterWrite(Snapshot):
    """The values of a group that were read after a write, between two cycles. The group's `latest` has them too."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class GroupStatistics:
    """Statistics of a group since it was made or they were reset. Times in seconds.

    `period`: as configured. `achieved`: mean measured period, without paused time. `jitter`: from a cycle's due time to
    its start. `cycle_time`: to its last value. `good`, `late`, `stale`, `bad`: number of samples. Mean wait of its
    cycles before they started: `exchanges_ahead` of other requests, and `quiet_time_ahead` seconds of
    resynchronisation.
    """

    cycles: int
    missed: int
    period: float
    achieved: float
    jitter: Quantiles
    cycle_time: Quantiles
    good: int
    late: int
    stale: int
    bad: int
    exchanges_ahead: float
    quiet_time_ahead: float


class Tally:
    """The counters of a group that are not in its poll."""

    __slots__ = (
        *("cycle_time", "cycles", "exchanges_ahead", "last", "missed", "periods", "recent", "samples"),
        *("quiet_time_ahead", "spanned"),
    )

    def __init__(self, poll: Poll) -> None:
        self.missed = poll.missed
        """Cycles missed before the count began."""
        self.cycles = 0
        self.last: float | None = None
        """When the previous cycle began; None if there was none, or after a pause."""
        self.spanned = 0.0
        """Total seconds of all `periods` counted."""
        self.periods = 0
        self.recent: deque[float] = deque(maxlen=RECENT_PERIODS)
        self.exchanges_ahead = 0
        self.quiet_time_ahead = 0.0
        self.cycle_time = Histogram()
        self.samples = NO_SAMPLES.copy()

    def note(self, poll: Poll, qualities: Mapping[Quality, int]) -> None:
        """Count a finished cycle, with the number of samples of each quality.

        The wait of its first exchange is the wait of the cycle.
        """
        for quality, number in qualities.items():
            self.samples[quality] += number
        # No exchange of the cycle was sent, for example because all its nodes are DOWN.
        begun = poll.started if poll.started > -inf else poll.due
        if self.last is not None:
            self.spanned += begun - self.last
            self.periods += 1
            self.recent.append(begun - self.last)
        # A pause is not a period: it would be counted as one long period.
        self.last = None if poll.paused else begun
        self.cycles += 1
        self.cycle_time.record(poll.finished - poll.due)
        for transaction in poll.results[:1]:
            # Until an exchange is sent, these hold the line's counters at the time when it was queued, not the
            # difference.
            if transaction.started > -inf:
                self.exchanges_ahead += transaction.exchanges_ahead
                self.quiet_time_ahead += transaction.quiet_time_ahead

    def statistics(self, poll: Poll) -> GroupStatistics:
        """Return an immutable snapshot of the group's counters."""
        cycles = self.cycles
        return GroupStatistics(
            cycles=cycles,
            missed=poll.missed - self.missed,
            period=poll.period,
            achieved=self.spanned / self.periods if self.periods else 0.0,
            jitter=Quantiles.of(poll.jitter),
            cycle_time=Quantiles.of(self.cycle_time),
            good=self.samples[Quality.GOOD],
            late=self.samples[Quality.LATE],
            stale=self.samples[Quality.STALE],
            bad=self.samples[Quality.BAD],
            exchanges_ahead=self.exchanges_ahead / cycles if cycles else 0.0,
            quiet_time_ahead=self.quiet_time_ahead / cycles if cycles else 0.0,
        )


class Stream(Generic[T]):
    """One consumer with a bounded buffer. If it is too slow, the oldest items are dropped and counted in `dropped`."""

    def __init__(self, listeners: list[Stream[T]], buffer: int) -> None:
        self._listeners = listeners
        self._items: deque[T] = deque(maxlen=whole_number(buffer, 1, sys.maxsize, "a buffer"))
        self._arrived = anyio.Event()
        self._closed = False
        self._cause: Exception | None = None
        """Why it ended, where that is an error."""
        self.dropped = 0
        listeners.append(self)

    def __aiter__(self) -> AsyncIterator[T]:
        return self

    async def __anext__(self) -> T:
        # Checked again after each wake-up: another task that shares the stream may have taken the item.
        while not self._items:
            if self._closed:
                raise StopAsyncIteration if self._cause is None else self._cause
            # A new event only after the old one was set, shared until then: otherwise one of two tasks that wait on the
            # same stream could wait on an event that is never set.
            if self._arrived.is_set():
                self._arrived = anyio.Event()
            await self._arrived.wait()
        return self._items.popleft()

    def close(self, cause: Exception | None = None) -> None:
        """Add no further items. Items in the buffer can still be read; then iteration ends, or raises the cause."""
        # The first cause counts: a stream may be closed again by the `finally` of its consumer.
        if not self._closed:
            self._cause = cause
        self._closed = True
        if self in self._listeners:
            self._listeners.remove(self)
        self._arrived.set()

    def put(self, item: T) -> None:
        """Add an item. Drops the oldest one if the buffer is full."""
        if len(self._items) == self._items.maxlen:
            self.dropped += 1
        self._items.append(item)
        self._arrived.set()


class Cycles:
    """The cycles of a poll group. Iterate over it, or read `latest`."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.latest: Snapshot | None = None
        """Snapshot of its last cycle."""
        self._consumers: list[Stream[Snapshot]] = []
        self._consumers_of_changes: list[Stream[Snapshot]] = []
        self._over = False
        self._cause: Exception | None = None
        """Why it ended, where that is an error."""

    def subscribe(self, buffer: int = 16, *, changes: bool = False) -> Stream[Snapshot]:
        """Return a consumer that buffers this many snapshots. Close it when it is no longer used.

        With `changes` it also gets the changes between two cycles, each as a snapshot of the changed values: `Outdated`
        and `ReadAfterWrite`.
        """
        if self._cause is not None:
            raise self._cause
        if self._over:
            raise BusClosed(f"poll group {self.name!r} is closed")
        return Stream(self._consumers_of_changes if changes else self._consumers, buffer)

    async def __aiter__(self) -> AsyncIterator[Snapshot]:
        consumer = self.subscribe()
        try:
            async for snapshot in consumer:
                yield snapshot
        finally:
            # Also if the application leaves its loop early: the buffer would be filled as long as the group runs.
            consumer.close()

    def _publish(self, snapshot: Snapshot) -> None:
        self.latest = snapshot
        self._publish_change(snapshot)  # first: outputs must get a cycle before a program acts on it
        for consumer in self._consumers:
            consumer.put(snapshot)

    def _publish_change(self, snapshot: Snapshot) -> None:
        for consumer in self._consumers_of_changes:
            consumer.put(snapshot)

    def _end(self, cause: Exception | None = None) -> None:
        """End all consumers after the snapshots in their buffers, with the cause if it is an error."""
        if not self._over:
            self._cause = cause
        self._over = True
        for consumer in (*self._consumers, *self._consumers_of_changes):
            consumer.close(cause)
