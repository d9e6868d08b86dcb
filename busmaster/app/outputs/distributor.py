"""All outputs of a line: each gets the polled values and the events, and none can delay the line."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import anyio

from busmaster import Bus, BusError, Point, Quality, Sample, Snapshot, ext
from busmaster.app.bounds import AUDIT_WITHIN
from busmaster.app.outputs.base import Happening, Output, OutputLine, OutputStatistics
from busmaster.app.outputs.kinds import find
from busmaster.app.outputs.settings import Settings
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.record import WriteRecord
from busmaster.app.service.values import event_text, micros
from busmaster.events import (
    AlarmChanged,
    BusEvent,
    MaxReplyDelayLowered,
    MaxReplyDelayRaised,
    NodeChanged,
    RepliesLate,
    Stream,
)
from busmaster.ext import Outdated

WAITING = 256
"""Cycles of a group that may wait for a loop that is busy with other things."""
CLOSE_WITHIN = 5.0
"""Seconds in which the outputs write their queues when the line is closed."""

ROUNDING = 1e-6
"""Seconds by which two moments of a grid may seem nearer to each other than they are."""


class Sent(NamedTuple):
    """The last reported value of a point, its due time, and the time of its request."""

    value: Any
    quality: Quality
    error: type[BusError] | None
    due: float
    asked: float


class News:
    """The last values that outputs got from one poll group, to find the values to report.

    A value is reported in three cases: it differs from the last one by more than the deadband, its quality has changed,
    or the heartbeat time has passed. A point without deadband and heartbeat is always reported. `outdated` returns
    whether a value that was requested at that time has since become stale or bad, which an output may have reported.
    Then the next value is reported, even if it is the same.
    """

    def __init__(self, outdated: Callable[[Point[Any], float], bool] = lambda *_: False) -> None:
        self._outdated = outdated
        self._sent: dict[Point[Any], Sent] = {}

    def of(self, snapshot: Snapshot) -> Snapshot:
        """Return the cycle with only the values to report."""
        if not any(point.meaning.by_exception for point in snapshot.samples):
            return snapshot
        due = snapshot.due
        news = {
            point: sample
            for point, sample in snapshot.samples.items()
            if not point.meaning.by_exception or self._is_news(point, sample, due)
        }
        return replace(snapshot, samples=news)

    def forget(self) -> None:
        """Let everything be news once more."""
        self._sent.clear()

    def _is_news(self, point: Point[Any], sample: Sample[Any], due: float) -> bool:
        sent, error = self._sent.get(point), None if sample.error is None else type(sample.error)
        heartbeat = point.meaning.heartbeat
        if (
            sent is not None
            and (sent.quality, sent.error) == (sample.quality, error)
            and (heartbeat is None or due - sent.due < heartbeat - ROUNDING)
            and not differs(sent.value, sample.value, point.meaning.deadband or 0)
            and not self._outdated(point, sent.asked)
        ):
            return False
        asked = sample.finished if sample.started is None else sample.started
        self._sent[point] = Sent(sample.value, sample.quality, error, due, asked)
        return True


def differs(before: Any, now: Any, deadband: float) -> bool:
    """Return whether two values are further from each other than the deadband; of runs, whether any two are."""
    if type(before) is tuple and type(now) is tuple and len(before) == len(now):
        return any(differs(one, other, deadband) for one, other in zip(before, now, strict=True))
    if before == now or (before != before and now != now):  # two NaN are alike
        return False
    numbers = isinstance(before, int | float) and isinstance(now, int | float)
    return not (numbers and abs(now - before) <= deadband)


class Source(Protocol):
    """A source of cycles: a poll group, or the samples of one from another master."""

    @property
    def name(self) -> str: ...

    @property
    def points(self) -> tuple[Point[Any], ...]: ...

    def subscribe(self, buffer: int, /, *, changes: bool = False) -> Stream[Snapshot]: ...


class Wanted(NamedTuple):
    """The settings of one output. `commands`: the points, by their key, that it permits others to write."""

    settings: Settings
    commands: Mapping[str, Point[Any]]

    def same(self, other: Wanted | None) -> bool:
        """Return whether the other is the same output: points that are equal may have another scale."""
        return (
            other is not None
            and self.settings == other.settings
            and self.commands.keys() == other.commands.keys()
            and all(point is other.commands[key] for key, point in self.commands.items())
        )


class Distributor:
    """The outputs of one bus. `report` is called, on the loop, with their events.

    `authorisation` checks the commands that they receive. Without `in_charge`, the state of the line is not reported,
    because another process may own it. With `asks` False, the line only listens, and only that and its samples are
    reported.
    """

    def __init__(
        self,
        bus: Bus,
        report: Callable[[str], None] = lambda _: None,
        *,
        authorisation: Authorisation | None = None,
        in_charge: bool = True,
        asks: bool = True,
    ) -> None:
        self.report = report
        self._log = logging.getLogger("busmaster.app.outputs")
        self.authorisation = authorisation or Authorisation(bus)
        self._in_charge = in_charge
        self._asks = asks
        self._bus = bus
        self._outputs: list[Output] = []
        self._feeding: dict[Source, asyncio.Task[None]] = {}
        self._news: dict[Source, News] = {}
        self._watching: asyncio.Task[None] | None = None
        self._wanted: dict[str, Wanted] = {}
        self._loop: asyncio.AbstractEventLoop | None = None

    def add(self, kind: str, settings: Settings, *, commands: Mapping[str, Point[Any]] | None = None) -> None:
        """Add one more output.

        `commands` are the points that it lets others write. Raises InvalidCommand if an extra is missing.
        """
        self._wanted[kind] = wanted = Wanted(settings, commands or {})
        self._outputs.append(self._make(kind, *wanted))

    def start(self, groups: Iterable[Source]) -> None:
        """Start the outputs and feed them from these groups, from now on, until `close`."""
        self._loop = asyncio.get_running_loop()
        for output in self._outputs:
            output.start()
        self._take_in(groups)

    async def replace(self, wanted: Mapping[str, Wanted], groups: Iterable[Source]) -> None:
        """Run these outputs, and feed them from these groups, from now on.

        An unchanged output is reopened, and continues with its queue. A changed one is closed within CLOSE_WITHIN
        seconds, and new items wait for its successor. Raises InvalidCommand, before any change, if an extra is missing.
        """
        # Made before anything is changed: an extra may be missing.
        fresh = {kind: self._make(kind, *one) for kind, one in wanted.items() if not one.same(self._wanted.get(kind))}
        kept = [output for output in self._outputs if output.kind in wanted and output.kind not in fresh]
        leaving = {output.kind: output for output in self._outputs if output not in kept}
        self._outputs = [*kept, *fresh.values()]
        self._wanted = dict(wanted)
        for output in kept:
            output.reopen()
        self._take_in(groups)
        for news in self._news.values():
            news.forget()  # new and reopened outputs do not have the last values
        with anyio.CancelScope(shield=True):
            await close_all(leaving.values())
        for kind, output in fresh.items():
            if kind in leaving:
                output.succeed(leaving.pop(kind))
            output.start()
        for kind, output in leaving.items():
            counts = output.statistics()
            on_disk = f", {counts.spilled} kept on disk" if counts.spilled else ""
            self.report(f"{kind} is ended: {counts.written} {counts.what}, {counts.dropped} dropped{on_disk}")

    def record(self, write: WriteRecord) -> asyncio.Future[str] | None:
        """Offer an audit entry to all outputs.

        For a write that succeeded, and outputs with `audit = "strict"`, return a future. It is done when all of these
        have the entry on the disk, or with the reason why one of them has not. Otherwise return None.
        """
        waits = write.ok and any(output.is_strict for output in self._outputs)
        durable: asyncio.Future[str] | None = asyncio.get_running_loop().create_future() if waits else None
        missing = {output.kind for output in self._outputs if output.is_strict}
        for output in self._outputs:
            if durable is not None and output.is_strict:
                output.offer_entry(write, partial(self._kept, durable, missing, output.kind))
            else:
                output.offer(write)
        if durable is not None:
            timer = durable.get_loop().call_later(AUDIT_WITHIN, self._not_kept, durable, missing)
            durable.add_done_callback(lambda _: timer.cancel())
        return durable

    def _kept(self, durable: asyncio.Future[str], missing: set[str], kind: str, why_not: str) -> None:
        """Handle, on any thread, that an output has an entry on the disk, or why it never will."""

        def note() -> None:
            missing.discard(kind)
            if not durable.done() and (why_not or not missing):
                durable.set_result(why_not)

        try:
            durable.get_loop().call_soon_threadsafe(note)
        except RuntimeError:
            pass  # the loop is closed

    def _not_kept(self, durable: asyncio.Future[str], missing: set[str]) -> None:
        """Wait no longer for these outputs."""
        if not durable.done():
            down = [f"{output.kind} is down: {output.error}" for output in self._outputs if output.error]
            slow = f"{' and '.join(sorted(missing))} did not write it within {AUDIT_WITHIN:g} s"
            durable.set_result("; ".join([slow, *(text for text in down if text.split()[0] in missing)]))

    async def close(self) -> None:
        """Close the outputs, once the bus is closed.

        The values polled so far are still offered, and written within CLOSE_WITHIN seconds.
        """
        with anyio.CancelScope(shield=True):
            # They end with the bus's streams. If they were cancelled, the values polled last would be missing.
            await asyncio.gather(*self._feeding.values(), return_exceptions=True)
            if self._watching is not None:
                self._watching.cancel()
                await asyncio.gather(self._watching, return_exceptions=True)
            await close_all(self._outputs)
        self._feeding.clear()
        self._watching = None

    def statistics(self) -> tuple[OutputStatistics, ...]:
        """Return the counts of each output."""
        return tuple(output.statistics() for output in self._outputs)

    def _take_in(self, groups: Iterable[Source]) -> None:
        """Feed the outputs in tasks of their own: a task group would tie entering and leaving the line to one task."""
        if not self._outputs:
            return
        for group in groups:
            if group not in self._feeding:
                self._feeding[group] = task = asyncio.ensure_future(
                    self._feed(group.subscribe(WAITING, changes=True), group)
                )
                task.add_done_callback(partial(self._fed, group))
        if self._watching is None:
            self._watching = asyncio.ensure_future(self._watch())

    def _fed(self, group: Source, feeding: asyncio.Task[None]) -> None:
        self._feeding.pop(group, None)
        self._news.pop(group, None)
        # An output that gets no more values looks like a line without changes, so this must be seen.
        if not feeding.cancelled() and (bug := feeding.exception()) is not None:
            what = f"outputs get no more values of {group.name}: {type(bug).__name__}: {bug}"
            self._log.error(what, exc_info=bug)
            self.report(f"{what}; report this bug, and restart the program")

    async def _feed(self, cycles: Stream[Snapshot], group: Source) -> None:
        lost = 0
        news = self._news[group] = News(ext.line_of(self._bus).is_outdated)
        async for snapshot in cycles:
            selected = news.of(snapshot)
            for output in self._outputs:
                if output.groups and group.name not in output.groups:
                    continue
                # cycles for which the loop was too busy count as well
                output.miss((cycles.dropped - lost) * len(group.points))
                if not (isinstance(snapshot, Outdated) and output.finds_outdated):
                    output.suppress(len(snapshot) - len(selected))
                    if selected:
                        output.offer(selected)
            lost = cycles.dropped

    async def _watch(self) -> None:
        async for event in self._bus.events():
            text = event_text(event)
            if text:
                for output in self._outputs:
                    output.offer(Happening(micros(self._bus.wall_time()), label_of(event), text))

    def _report(self, text: str) -> None:
        """Pass a text from any thread to the loop; if the loop has ended, the text is discarded."""
        if self._loop is not None:
            try:
                self._loop.call_soon_threadsafe(self.report, text)
            except RuntimeError:
                pass

    def _make(self, kind: str, settings: Settings, commands: Mapping[str, Point[Any]]) -> Output:
        line = OutputLine(
            bus=self._bus,
            authorisation=self.authorisation,
            report=self._report,
            commands=commands,
            statistics=self.statistics,
            in_charge=self._in_charge,
            polls=self._asks,
        )
        return find(kind).make(settings, line)


async def close_all(outputs: Collection[Output]) -> None:
    """Close them, their interfaces first, so that all of them have the audit entries of their replies."""
    # Closing waits for a thread, and perhaps for a disk: never on the loop that owns the line.
    await asyncio.gather(*(asyncio.to_thread(output.close_interface) for output in outputs))
    await asyncio.gather(*(asyncio.to_thread(output.close, CLOSE_WITHIN) for output in outputs))


def label_of(event: BusEvent) -> str:
    """Return the label of the node that an event is of, "" for one of the line."""
    match event:
        case NodeChanged() | MaxReplyDelayRaised() | MaxReplyDelayLowered() | RepliesLate():
            return event.node.label
        case AlarmChanged():
            return event.point.node.label
        case _:
            return ""
