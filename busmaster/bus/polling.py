"""Poll groups: points with a period, and the exchanges that read their values."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from math import inf, nextafter
from typing import Any, NamedTuple

from busmaster.arbiter.clients import LineClient
from busmaster.arbiter.counters import Histogram
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.schedule import line_time, set_members
from busmaster.arbiter.transaction import Poll, Priority, Transaction
from busmaster.bus.answers import Answer
from busmaster.bus.node import Node
from busmaster.bus.points import Point
from busmaster.bus.samples import Quality, Sample
from busmaster.bus.shared_line import SharedLine
from busmaster.bus.snapshots import (
    NO_SAMPLES,
    Cycles,
    GroupStatistics,
    Outdated,
    ReadAfterWrite,
    Snapshot,
    Stream,
    Tally,
)
from busmaster.contract.exchange import Command
from busmaster.errors import GarbledReply, InvalidCommand, Refused
from busmaster.planning import PlannedGroup, shape
from busmaster.planning.merging import WEIGHING, Merge, Served, cheapest, without_refused

__all__ = ["GroupStatistics", "PollGroup", "Quality", "Sample", "Snapshot", "Stream"]

WEIGHED_AGAIN = 8
"""Number of cycles after which merges are evaluated again, with measured reply times."""


class _Read(NamedTuple):
    """One exchange of a group: its points, each with its place in a batch's value (None: the whole value).

    `bytes_time`: wire time until the end of the reply. `unwaited`: line time without the wait for replies. `steps`:
    number of replies. `guess`: total line time while the node's reply time is unknown. `blank`: all points of the group
    in order.
    """

    node: Node
    served: Served
    points: tuple[tuple[Point[Any], int | None], ...]
    bytes_time: float
    unwaited: float
    steps: int
    guess: float
    blank: dict[Point[Any], Any]

    @property
    def line_time(self) -> float:
        """Return its line time in seconds, with the node's reply time measured so far."""
        wait = self.node._reply_time
        return self.guess if wait is None else self.unwaited + self.steps * wait


class PollGroup(Cycles):
    """Points that are read once per period. Made by `Bus.poll_group`. Iterate over it, or read `latest`."""

    def __init__(
        self,
        line: SharedLine,
        name: str,
        period: float,
        points: Iterable[Point[Any]],
        *,
        phase: float | None,
        priority: Priority,
        merge: Sequence[Merge],
        on_close: Callable[[PollGroup], None],
        client: LineClient | None = None,
    ) -> None:
        super().__init__(name)
        self._line = line
        self._on_close = on_close
        self._priority = priority
        self._client = client
        """The client that is charged for the line time; None: the line's owner."""
        self._merge = tuple(merge)
        # With the node: a batch that one node refuses is still merged for the others.
        self._refused: set[tuple[Node, Command[Any]]] = set()
        self._poll = Poll(name, period, phase=phase)
        # With a group, the arbiter reports each exchange when it ends, and not only the whole cycle.
        self._poll.group = self
        self._points: dict[Point[Any], Node] = {}
        self._watched: tuple[Point[Any], ...] = ()
        self.read_after_write: tuple[Point[Any], ...] = ()
        """Those of its points that are read after a confirmed write to them."""
        self._between: dict[Point[Any], Sample[Any]] = {}
        """Samples read since the end of the last cycle: the running cycle may have read before the write."""
        self._reported_outdated: dict[Point[Any], Sample[Any]] = {}
        """The sample of each point that was last reported as stale."""
        self._tally = Tally(self._poll)
        self._good_at: dict[Point[Any], float] = {}
        """Time of the last good value of each point that cannot be read now, in seconds since 1970."""
        # the cycle that runs
        self._cycle = 0
        self._samples: dict[Point[Any], Sample[Any]] = {}
        self._qualities: dict[Quality, int] = {}
        self._line_time = 0.0
        self._wall_offset = line.wall_offset()
        self._refusals: list[_Read] = []
        self.add(*points)

    @property
    def points(self) -> tuple[Point[Any], ...]:
        """Return the points of a cycle, in order."""
        return tuple(self._points)

    def points_of(self, record: NodeRecord) -> list[Point[Any]]:
        """Return the points of this node."""
        return [point for point, node in self._points.items() if node._record is record]

    @property
    def period(self) -> float:
        """Return the seconds from one cycle to the next."""
        return self._poll.period

    @property
    def poll(self) -> Poll:
        """Return the arbiter's poll of the group."""
        return self._poll

    @property
    def paused(self) -> bool:
        """Return True while it is paused."""
        return self._poll.paused

    def add(self, *points: Point[Any]) -> None:
        """Add points, from the next cycle on; with hundreds of points, some milliseconds later.

        Points that it already has are ignored. Raises InvalidCommand for a point of another bus, and for a point of the
        broadcast address.
        """
        self._line.check_loop()
        fresh: dict[Point[Any], Node] = {}
        for point in points:
            node = point.node
            # A point of another line would silently never be read.
            if not isinstance(node, Node) or node._shared is not self._line:
                raise InvalidCommand(f"poll group {self.name!r}: {point.key} belongs to another bus")
            if node.address == node.profile.broadcast:
                raise InvalidCommand(
                    f"poll group {self.name!r}: no node replies to a read of {point.key}, a broadcast address"
                )
            # A new group has no points. Without a look for them each point is hashed once and not twice, which is slow.
            if not self._points or point not in self._points:
                fresh[point] = node
        # Only after all checks: an error in the middle of the list must leave the group unchanged.
        self._points.update(fresh)
        self._points_changed()

    def remove(self, *points: Point[Any]) -> None:
        """Remove points, from the next cycle on; with hundreds of points, some milliseconds later."""
        self._line.check_loop()
        for point in points:
            self._points.pop(point, None)
            # If the point is added again, it must not report a time from before its removal.
            self._good_at.pop(point, None)
            self._reported_outdated.pop(point, None)
        self._points_changed()

    def pause(self) -> None:
        """Start no cycle until `resume`. These cycles do not count as missed."""
        # A flag, and not a removal from the schedule: the poll keeps its phase, and `resume` continues on the same
        # grid.
        self._poll.paused = True
        # The period that spans the pause is not measured, nor the time until a cycle that is demanded during it.
        self._tally.last = None

    def resume(self) -> None:
        """Continue on the grid. The paused time does not count as a period."""
        self._poll.paused = False

    def demand(self) -> None:
        """Run one cycle now, outside the grid. If a cycle is running, that one is used."""
        self._line.demand(self._poll)

    def close(self) -> None:
        """Close the group. Its consumers end after the snapshots in their buffers."""
        self._line.check_loop()
        # close() may be called again by the bus that closes, or by `async with`.
        if self._poll.active:
            self._on_close(self)
            # First: an alarm of a point that is no longer polled would stay active for ever.
            self._watch(())
            # `Bus.latest` and the audit log would otherwise go on using values that no cycle refreshes any more.
            self._line.latest_of.pop(self.name, None)
            self._line.answers_of.pop(self.name, None)
            self._line.remove_poll(self._poll)
        self._end()

    def subscribe(self, buffer: int = 16, *, changes: bool = False) -> Stream[Snapshot]:
        """Return a consumer that buffers this many snapshots. Close it when it is no longer used.

        With `changes` it also gets the changes between two cycles, each as a snapshot of the changed values.
        """
        # Checked because the pump fills streams in the loop's thread, without a lock.
        self._line.check_loop()
        return super().subscribe(buffer, changes=changes)

    def statistics(self) -> GroupStatistics:
        """Return an immutable snapshot of its counters."""
        self._line.check_loop()
        return self._tally.statistics(self._poll)

    @property
    def recent_periods(self) -> tuple[float, ...]:
        """Return the seconds between the last thousand cycles, without paused time."""
        return tuple(self._tally.recent)

    def reset_statistics(self) -> None:
        """Reset its counters. Cycles keep their numbers."""
        self._poll.jitter = Histogram()
        self._tally = Tally(self._poll)

    def planned(self) -> PlannedGroup:
        """Return the group as the planner uses it, with reply times measured so far."""
        # Refused merges are left out: the plan must use the exchanges that are really sent.
        # Once per node: a plan of a node copies its profile.
        nodes = {node: node.planned() for node in set(self._points.values())}
        for node, plan in nodes.items():
            if self._refused and plan.profile.merge is not None:
                nodes[node] = replace(plan, profile=replace(plan.profile, merge=self._sound(plan.profile.merge, node)))
        reads = [(nodes[node], point.command) for point, node in self._points.items()]
        merges = [self._sound(merge) for merge in self._merge]
        return PlannedGroup(self.name, self._poll.period, reads, self._poll.phase, self._priority, merges)

    def sampled(self, transaction: Transaction) -> None:
        """Create the samples of a finished exchange. Runs in the pump: no user code except decoders."""
        read: _Read = transaction.tag
        # Samples are made at the end of each exchange: making all of a large group at the end of its cycle would block
        # the loop.
        if self._cycle != self._poll.cycles:
            self._cycle = self._poll.cycles
            # All reads of the group share `blank`. The copy becomes the dict of the published snapshot.
            self._samples = read.blank.copy()
            self._qualities = NO_SAMPLES.copy()
            self._line_time = 0.0
            self._wall_offset = self._line.wall_offset()
            self._refusals = []
        self._line_time += read.line_time
        if transaction.error is None:
            _measure(transaction, read)
        # The refusal of a batch does not show which item was refused: they are read in smaller exchanges instead.
        # A node that is busy would refuse those too.
        elif read.served.batch and isinstance(transaction.error, Refused) and not transaction.error.temporary:
            self._refusals.append(read)
        for point, place in read.points:
            sample = self._sample(point, place, transaction)
            if sample.error is not None:
                self._note_good(point)
            self._samples[point] = sample
            self._qualities[sample.quality] += 1

    def cycle_finished(self) -> None:
        """Publish the snapshot of a finished cycle. Runs in the pump: no user code."""
        poll = self._poll
        # With fresh members, `_choosing` has already set their cost; the measured line time is that of the old ones.
        if poll.fresh is None:
            poll.cost = self._line_time  # uses the cost of the last cycle, so that not all groups are calculated again
        if self._refusals:
            self._fall_back()  # no snapshot yet: the single reads follow in the same period
            return
        # A write may have ended since the first exchange of this cycle.
        self._age()
        self._use_readings()
        self._tally.note(poll, self._qualities)
        # No start: every exchange of the cycle was rejected before it was sent.
        started = poll.started if poll.started > -inf else None
        wall = poll.finished + self._wall_offset
        snapshot = Snapshot(self.name, poll.cycles, poll.due, started, poll.finished, poll.missed, wall, self._samples)
        self._line.latest_of[self.name] = snapshot
        # The values are taken out of the transactions, because the next cycle resets these.
        self._line.answers_of[self.name] = [
            Answer(done.tag.node, done.tag.served.command, done.tag.points, done.value, done.started)
            for done in poll.results
            if done.error is None
        ]
        self._publish(snapshot)
        self._line.alarms.look(self._watched, self._samples)
        # Only once: a new choice with each change of a mean would make the cycles differ all the time.
        if poll.cycles == WEIGHED_AGAIN:
            self._choose()

    def _sample(self, point: Point[Any], place: int | None, transaction: Transaction) -> Sample[Any]:
        error = transaction.error
        value = None
        quality = Quality.BAD
        if error is None:
            # R2: a late reply is as right as any other. Only its time is unusual.
            quality = Quality.LATE if transaction.late else Quality.GOOD
            # One comparison on a line without writes; only then the search for the relevant write.
            if self._line.last_touched > transaction.started and self._line.is_stale(point, transaction.started):
                quality = Quality.STALE
            try:
                value = point.value_of(transaction.value if place is None else transaction.value[place])
            except GarbledReply as bad:  # an error of this point only: the other points of the exchange are good
                error, quality = bad, Quality.BAD
        # A copy of the times: the next cycle resets the transaction.
        timeline = transaction.timeline()
        finished = transaction.ended_at
        wall = finished + self._wall_offset
        return Sample(value, error, self._poll.due, timeline.started, finished, quality, timeline, wall)

    def _note_good(self, point: Point[Any]) -> None:
        """Store when a point was last read, because its last good sample is about to be replaced by an error."""
        before = None if self.latest is None else self.latest.samples.get(point)
        # Stored only while a point fails: otherwise the sample has the time.
        if before is not None and before.error is None:
            self._good_at[point] = before.wall

    def good_at(self, point: Point[Any]) -> float | None:
        """Return when a point was last read without an error, in seconds since 1970; None if never.

        Thread-safe.
        """
        # Safe in another thread: `latest` is replaced as a whole and never becomes None again.
        sample = None if self.latest is None else self.latest.samples.get(point)
        if sample is None or sample.error is not None:
            return self._good_at.get(point)
        return sample.wall

    def _age(self) -> None:
        """Mark samples as stale that were read before a write to their point that has ended in the meantime."""
        # The usual case: no write on the whole line during the cycle.
        if self._line.last_touched <= self._poll.started:
            return
        for transaction in self._poll.results:
            # Checked per node first: most nodes of a line are never written.
            if not self._line.written_since(transaction.node, transaction.started):
                continue
            for point, _ in transaction.tag.points:
                sample = self._samples[point]
                if (
                    sample.quality.is_current
                    and sample.started is not None
                    and self._line.is_stale(point, sample.started)
                ):
                    self._qualities[sample.quality] -= 1
                    self._qualities[Quality.STALE] += 1
                    self._samples[point] = sample._replace(quality=Quality.STALE)

    # between two cycles

    def take_reading(self, read: Point[Any], reading: Transaction) -> None:
        """Use the value of a read of one of its quantities if it is newer than the group's sample."""
        latest = self.latest
        # Before the first cycle there is no snapshot that the value could replace.
        if latest is None or not self._poll.active:
            return
        fresh: dict[Point[Any], Sample[Any]] = {}
        for point in self._points:
            before = latest.samples.get(point)
            if point.quantity == read.quantity and before is not None and _is_older(before, reading.started):
                fresh[point] = sample = self._sample(point, None, reading)
                if sample.error is not None:
                    self._note_good(point)
        if not fresh:
            return
        self._between |= fresh
        # A copy: consumers may still hold the snapshot of the cycle, which must not change.
        self._line.latest_of[self.name] = self.latest = replace(latest, samples={**latest.samples, **fresh})
        # In addition to the replies of the cycle: the last values of all other points must stay known.
        answer = Answer(read.node, read.command, [(point, None) for point in fresh], reading.value, reading.started)
        self._line.answers_of[self.name] = [*self._line.answers_of.get(self.name, ()), answer]
        finished = reading.ended_at
        wall = finished + self._wall_offset
        times = (latest.due, reading.started, finished)
        self._publish_change(ReadAfterWrite(self.name, latest.cycle, *times, self._poll.missed, wall, fresh))
        self._line.alarms.look([point for point in self._watched if point in fresh], fresh)

    def report_outdated(self, record: NodeRecord, when: float) -> None:
        """Report to consumers of changes which values a write that has just ended has made stale."""
        latest = self.latest
        # Calculated only if there are consumers of changes: this runs for every confirmed write.
        if latest is None or not self._consumers_of_changes:
            return
        # The instant before the write: a sample is stale if it was read before it.
        to_all, before = record.address == record.profile.broadcast, nextafter(when, -inf)
        wall = when + self._wall_offset
        outdated = {}
        for point in self._points if to_all else self.points_of(record):
            sample = latest.samples.get(point)
            # Once for each sample: the second of several writes in a row makes nothing else stale.
            if sample is None or not sample.quality.is_current or self._reported_outdated.get(point) is sample:
                continue
            if self._line.is_stale(point, before):
                self._reported_outdated[point] = sample
                outdated[point] = sample._replace(quality=Quality.STALE, wall=wall)
        if outdated:
            # The time of the write, not of the read: consumers get changes in the order of their times.
            times = (latest.due, latest.started, when)
            self._publish_change(Outdated(self.name, latest.cycle, *times, self._poll.missed, wall, outdated))

    def _use_readings(self) -> None:
        """Keep values that were read after a write, if the finished cycle has read them before the write."""
        for point, reading in self._between.items():
            sample = self._samples.get(point)
            if sample is None or reading.started is None or not _is_older(sample, reading.started):
                continue
            if self._line.is_stale(point, reading.started):
                # Another write has ended since that read.
                reading = reading._replace(quality=Quality.STALE)
            self._qualities[sample.quality] -= 1
            self._qualities[reading.quality] += 1
            self._samples[point] = reading
        self._between = {}

    # which exchanges bring the values

    def _points_changed(self) -> None:
        self._watch(tuple(point for point in self._points if point.meaning.watched))
        self.read_after_write = tuple(point for point in self._points if point.read_after_write)
        self._choose()

    def _watch(self, points: tuple[Point[Any], ...]) -> None:
        """Set the points that are checked for alarms."""
        before, self._watched = self._watched, points
        # in this order, so that the alarm of a point that stays continues
        self._line.alarms.watch(points)
        self._line.alarms.forget(before)

    def _choose(self) -> None:
        """Choose the exchanges again, in slices, so that the line continues (see Schedule.prepare)."""
        # Replaces an unfinished one: with several changes in a row only the last choice counts.
        self._poll.preparation = self._choosing()
        self._line.prepare(self._poll)

    def _choosing(self) -> Iterator[int]:
        """Give the poll its transactions and its cost, if they have changed."""
        for merged in (True, False):  # if a merge fails, the group runs without merges
            try:
                reads = yield from self._reads(merged)
                break
            except Exception as bug:  # a merge may be code of the application
                self._line.logbook.failed_choice(self.name, bug)
        else:
            # The exchange itself cannot be opened, for example because of a bug in its protocol. The group continues
            # with the members that it has.
            return
        poll = self._poll
        # Members that no cycle has used yet are the current choice too.
        asked = poll.results if poll.fresh is None else poll.fresh
        # Unchanged reads keep their transactions, and with them their count of refusals.
        if [transaction.tag.points for transaction in asked] == [read.points for read in reads]:
            return
        fresh = []
        for read in reads:
            fresh.append(Transaction(read.node._record, read.served.command, tag=read, client=self._client))
            # All points in order, so that a snapshot has the group's order, whichever exchange ends first.
            read.blank.update((point, None) for point, _ in read.points)
            yield 5
        # Only now, all together: cycles that started between the slices have used the old members.
        set_members(poll, fresh, self._priority)
        poll.cost = sum(read.line_time for read in reads)

    def _reads(self, merged: bool) -> Generator[int, None, list[_Read]]:
        """Choose the reads: points with the same command share an exchange, and merges are used if they are cheaper."""
        behind: dict[Node, dict[Command[Any], list[Point[Any]]]] = {}
        for point, node in tuple(self._points.items()):
            # Points that read the same (a word and its bits) share one exchange.
            behind.setdefault(node, {}).setdefault(point.command, []).append(point)
            yield 2
        reads: list[_Read] = []
        blank: dict[Point[Any], Any] = {}
        for node, wanted in behind.items():
            merges = (*self._merge, node.profile.merge) if node.profile.merge else self._merge
            sound = [self._sound(merge, node) for merge in merges] if merged else []
            cost = partial(node.planned().line_time, byte_time=self._line.arbiter.byte_time)
            points = tuple(wanted.values())
            for served in (yield from cheapest(tuple(wanted), sound, cost)):
                serves = tuple(
                    (point, place if served.batch else None)
                    for place, index in enumerate(served.serves)
                    for point in points[index]
                )
                reads.append(self._read(node, served, serves, blank))
                yield WEIGHING
        return reads

    def _read(
        self,
        node: Node,
        served: Served,
        points: tuple[tuple[Point[Any], int | None], ...],
        blank: dict[Point[Any], Any],
    ) -> _Read:
        exchange, byte_time = node.planned().open(served.command), self._line.arbiter.byte_time
        # `Node._transaction` registers the commands of requests only. With the shape, because merged reads of one type
        # differ in length, and the longest one counts in the worst case (R9).
        node._kinds.setdefault((type(served.command), *shape(exchange)), served.command)
        unwaited, guess = line_time(exchange, byte_time, 0.0), line_time(exchange, byte_time)
        bytes_time = unwaited - exchange.closing * byte_time - exchange.timing.driver_release_time
        return _Read(node, served, points, bytes_time, unwaited, 1 + len(exchange.later), guess, blank)

    def _sound(self, merge: Merge, node: Node | None = None) -> Merge:
        """Return the merge without the commands that this node (None: any node) has refused."""
        return without_refused(merge, {command for who, command in self._refused if node in (None, who)})

    def _fall_back(self) -> None:
        """Send the commands of a refused batch now, in smaller exchanges: each of them may still be accepted."""
        # For good: a node that lacks one item of a run would refuse it in each cycle.
        self._refused |= {(read.node, read.served.command) for read in self._refusals}
        self._choose()
        # If the choice takes several slices, the schedule runs this cycle after the last of them.
        self._line.demand(self._poll)


def _is_older(sample: Sample[Any], started: float) -> bool:
    """Return True if a sample was read, or failed, before a read that began at `started`."""
    return (sample.finished if sample.started is None else sample.started) < started


def _measure(transaction: Transaction, read: _Read) -> None:
    """Update the mean reply time of the node."""
    if transaction.attempts == 1:  # the time of a retried request includes its failed attempts
        # Not below 0: behind a network, or on a pseudo-terminal, bytes are faster than the line's baud rate.
        read.node._note_wait(max(0.0, transaction.last_byte - transaction.started - read.bytes_time) / read.steps)
