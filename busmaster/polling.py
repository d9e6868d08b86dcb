"""Poll groups: points with a period, and the exchanges that bring their values."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Any, NamedTuple

from busmaster.arbiter.histogram import Histogram
from busmaster.arbiter.schedule import Poll, line_time, set_members
from busmaster.arbiter.transaction import Priority, Transaction
from busmaster.errors import BusClosed, GarbledReply, InvalidCommand, Refused
from busmaster.exchange import Command
from busmaster.merging import Merge, Served, cheapest
from busmaster.planning import PlannedGroup
from busmaster.points import Point
from busmaster.profile import Batch
from busmaster.samples import GroupStatistics, Quality, Sample, Snapshot, Stream, Tally

if TYPE_CHECKING:
    from busmaster.bus import Bus
    from busmaster.node import Node

__all__ = ["GroupStatistics", "PollGroup", "Quality", "Sample", "Snapshot", "Stream"]

REPLIES_REMEMBERED = 256
WEIGHED_AGAIN = 8
"""Cycles after which merges are weighed once more: by then reply times are measured."""


class _Read(NamedTuple):
    """One exchange of a group: the points that it serves, each with its place in a batch's value (None: all of it).

    `bytes_time` is what its bytes take, `legs` how often a reply is waited for.
    """

    served: Served
    points: tuple[tuple[Point[Any], int | None], ...]
    bytes_time: float
    legs: int


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
        merge: Sequence[Merge],
    ) -> None:
        self.name = name
        self.latest: Snapshot | None = None
        self._bus = bus
        self._priority = priority
        self._merge = tuple(merge)
        self._refused: set[tuple[Node, Command[Any]]] = set()
        self._poll = Poll(name, period, phase=phase)
        self._poll.waiter = self
        self._points: tuple[Point[Any], ...] = ()
        self._reads: dict[Transaction, _Read] = {}
        self._consumers: list[Stream[Snapshot]] = []
        self._tally = Tally(self._poll)
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
        self._bus.check_loop()
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
        """An immutable snapshot of its counts."""
        self._bus.check_loop()
        return self._tally.statistics(self._poll)

    def reset_statistics(self) -> None:
        """Start its counts again; cycles keep their numbers."""
        self._poll.jitter = Histogram()
        self._tally = Tally(self._poll)

    def planned(self) -> PlannedGroup:
        """The group as the planner sees it, with reply times as measured so far."""
        nodes = {node: node.planned() for node in {point.node for point in self._points}}
        for node, plan in nodes.items():
            if self._refused and plan.profile.merge is not None:
                nodes[node] = replace(plan, profile=replace(plan.profile, merge=self._sound(plan.profile.merge, node)))
        reads = [(nodes[point.node], point.command) for point in self._points]
        merges = [self._sound(merge) for merge in self._merge]
        return PlannedGroup(self.name, self._poll.period, reads, self._poll.phase, self._priority, merges)

    def cycle_finished(self) -> None:
        """The arbiter has run a cycle: make its snapshot and hand it round. Runs in the pump: no user code."""
        poll = self._poll
        if self._fall_back():
            return
        samples: dict[Point[Any], Sample] = {}
        for transaction in poll.results:
            read = self._reads[transaction]
            if transaction.error is None:
                _measure(transaction, read)
            for point, place in read.points:
                samples[point] = self._sample(point, place, transaction)
        self._tally.note(poll)
        started = poll.started if poll.started > -inf else None
        snapshot = Snapshot(self.name, poll.cycles, poll.due, started, poll.finished, poll.missed, samples)
        self.latest = snapshot
        for consumer in self._consumers:
            consumer.put(snapshot)
        if poll.cycles == WEIGHED_AGAIN:
            self._choose()

    def _sample(self, point: Point[Any], place: int | None, transaction: Transaction) -> Sample:
        error = transaction.error
        value = None
        quality = Quality.BAD
        if error is None:
            quality = Quality.LATE if transaction.late else Quality.GOOD
            if transaction.started < self._bus.touched_at(point):
                quality = Quality.STALE
            try:
                value = point.value_of(transaction.value if place is None else transaction.value[place])
            except GarbledReply as bad:
                error, quality = bad, Quality.BAD
        self._tally.samples[quality] += 1
        timeline = transaction.timeline()
        return Sample(value, error, self._poll.due, timeline.started, transaction.ended_at, quality, timeline)

    # which exchanges bring the values

    def _set_points(self, points: Iterable[Point[Any]]) -> None:
        self._bus.check_loop()
        unique = tuple(dict.fromkeys(points))
        for point in unique:
            if point.node.bus is not self._bus:
                raise InvalidCommand(f"poll group {self.name!r}: {point.key} belongs to another bus")
        self._points = unique
        self._choose()

    def _choose(self) -> None:
        """Two points with one command behind them cost one exchange, and merges are taken where they are cheaper."""
        behind: dict[Node, dict[Command[Any], list[Point[Any]]]] = {}
        for point in self._points:
            behind.setdefault(point.node, {}).setdefault(point.command, []).append(point)
        reads = [read for node, wanted in behind.items() for read in self._reads_of(node, wanted)]
        asked = self._poll.fresh if self._poll.fresh is not None else self._poll.results
        if [self._reads[t].points for t in asked] == [read.points for _, read in reads]:
            return
        fresh = {Transaction(node.record, read.served.command): read for node, read in reads}
        self._reads = {t: self._reads[t] for t in self._poll.results} | fresh
        set_members(self._poll, fresh, self._priority)
        self.weigh()

    def _reads_of(self, node: Node, wanted: dict[Command[Any], list[Point[Any]]]) -> Iterator[tuple[Node, _Read]]:
        merges = (*self._merge, node.profile.merge) if node.profile.merge else self._merge
        planned, byte_time = node.planned(), self._bus.byte_time
        points = tuple(wanted.values())
        sound = [self._sound(merge, node) for merge in merges]
        for served in cheapest(tuple(wanted), sound, partial(planned.line_time, byte_time=byte_time)):
            serves = tuple(
                (point, place if served.batch else None)
                for place, index in enumerate(served.serves)
                for point in points[index]
            )
            exchange = planned.open(served.command)
            after = exchange.closing * byte_time + exchange.timing.turnaround
            bytes_time = line_time(exchange, byte_time, 0.0) - after
            yield node, _Read(served, serves, bytes_time, 1 + len(exchange.later))

    def _sound(self, merge: Merge, node: Node | None = None) -> Merge:
        """The same merge without what this node (or any, if None) has refused."""
        refused = {command for who, command in self._refused if node in (None, who)}

        def sound(commands: Sequence[Command[Any]]) -> Sequence[Batch]:
            return [batch for batch in merge(commands) if batch.command not in refused]

        return sound if refused else merge

    def _fall_back(self) -> bool:
        """A batch that was refused says nothing of its commands: they are asked at once, one by one."""
        refused = {
            (point.node, self._reads[t].served.command)
            for t in self._poll.results
            if isinstance(t.error, Refused) and self._reads[t].served.batch
            for point, _ in self._reads[t].points
        }
        if not refused:
            return False
        self._refused |= refused
        self._choose()
        self._bus.demand(self._poll)
        return True

    def weigh(self) -> None:
        """Tell the schedule what a cycle takes, by the reply times measured so far."""
        asked = self._poll.fresh if self._poll.fresh is not None else self._poll.results
        byte_time = self._bus.byte_time
        self._poll.cost = sum(self._reads[t].points[0][0].node.planned().line_time(t.command, byte_time) for t in asked)


def _measure(transaction: Transaction, read: _Read) -> None:
    """The mean of what the node takes to reply, over the last of its replies."""
    node = transaction.node
    if transaction.attempts == 1:
        wait = (transaction.last_byte - transaction.started - read.bytes_time) / read.legs
        node.measured = min(node.measured + 1, REPLIES_REMEMBERED)
        known = wait if node.reply_time is None else node.reply_time
        node.reply_time = known + (wait - known) / node.measured
