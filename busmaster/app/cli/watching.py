"""Watching poll groups: as plain lines, as JSON, or on the screen; and the summary at the end."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Coroutine, Iterable, Iterator
from contextlib import AsyncExitStack
from dataclasses import replace
from typing import Any, Protocol

import anyio
from anyio.abc import TaskGroup

from busmaster import Bus, BusError, Health, InvalidCommand, LineState, PollGroup, Service, Snapshot, ext
from busmaster.app.cli.app import FAILED, OK
from busmaster.app.cli.arguments import View
from busmaster.app.cli.drawing import draw, served_here
from busmaster.app.cli.late import advice
from busmaster.app.cli.output import Level, SteadyOutput, emit_all, json_line, note, value_text
from busmaster.app.cli.top import what_is_missing
from busmaster.app.diagnostics import uart
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.values import cycle_fields, event_text, utc
from busmaster.events import AlarmChanged, BusEvent, LineChange, LineChanged, NodeChanged, PortFailed, RepliesLate
from busmaster.ext import LearnedTimes

LINE = ""
"""Key of the line itself in the set of current faults."""


class Watch:
    """Shows and reports the polling of a bus. Times are in seconds since this object was created.

    `view`: the form of the output. `authorisation`: checks the writes of the screen. `steady`: failures of standard
    output do not end it. `of_file`: the groups are those of a LINE.toml. Events of the bus are received from the start,
    also before it is entered.
    """

    def __init__(
        self,
        bus: Bus,
        title: str,
        view: View,
        *,
        authorisation: Authorisation | None = None,
        steady: bool = False,
        of_file: bool = False,
    ) -> None:
        self.bus = bus
        self._of_file = of_file
        self.output = SteadyOutput(note) if steady else None
        self.title = title
        self.view = view
        self.authorisation = authorisation or Authorisation(bus, read_only=view.read_only)
        self.start = bus.now()
        self.groups: list[PollGroup] = []
        self.service: Service | None = None
        """What the screen is a client of, while there is one."""
        self._heard = bus.events()
        self._troubles: set[str] = set()
        self._tasks: TaskGroup | None = None

    def since(self, time: float) -> float:
        """Return a time of the bus in seconds since the start."""
        return round(time - self.start, 6)

    def add(self, group: PollGroup) -> None:
        """Show this group too, from now on."""
        self.groups.append(group)
        if self._tasks is not None:
            self._begin(self._tasks, group)

    def replace_groups(self, groups: Iterable[PollGroup]) -> None:
        """Show these groups from now on; one that is shown already goes on."""
        wanted = list(groups)
        for gone in [group for group in self.groups if group not in wanted]:
            self.groups.remove(gone)
        for group in wanted:
            if group not in self.groups:
                self.add(group)
        self.groups.sort(key=wanted.index)

    def show_groups(self, tasks: TaskGroup) -> None:
        """Print the cycles of all groups, those that are added later too, unless there is a screen."""
        self._tasks = tasks
        for group in self.groups:
            self._begin(tasks, group)

    def _begin(self, tasks: TaskGroup, group: PollGroup) -> None:
        if not (shown_on_screen(self.view) or self.view.silent):
            tasks.start_soon(print_cycles, self, group)

    async def listen(self) -> None:
        """Report important events of the bus on standard error, until cancelled."""
        async for event in self._heard:
            level = self._level(event)
            if (text := event_text(event)) and level is not None and self.may_print():
                if isinstance(event, RepliesLate):
                    text = f"{event.node.label}: {advice(event.age, in_file=self._of_file)}"
                note(text, level)

    def _level(self, event: BusEvent) -> Level | None:
        """Return the level at which an event is logged: the start and the end of a fault, once each.

        None for other events.
        """
        match event:
            case PortFailed():
                self._troubles.add(LINE)
                return Level.ERROR
            case AlarmChanged():
                return Level.WARNING if event.active else Level.NOTICE
            case RepliesLate():
                return Level.WARNING
            case LineChanged():
                lost = event.change in (LineChange.DOWN, LineChange.NOISY)
                return self._turn(LINE, Level.ERROR if lost else None)
            case NodeChanged() if event.after in (Health.DOWN, Health.UP):
                return self._turn(event.node.label, Level.WARNING if event.after is Health.DOWN else None)
            case _:
                return None

    def _turn(self, what: str, trouble: Level | None) -> Level | None:
        """Note that `what` is in trouble, or no longer, and return how much that matters if it is new."""
        if trouble is None:
            known = what in self._troubles
            self._troubles.discard(what)
            return Level.NOTICE if known else None
        if what in self._troubles:
            return None
        self._troubles.add(what)
        return trouble

    def show(self, text: str) -> None:
        """Add to what the screen shows of the last events."""
        if self.service is not None:
            self.service.line.journal.note(text)

    def announce(self, text: str, level: Level = Level.NOTICE) -> None:
        """Add to the last events; print a line on standard error, unless the screen that shows them is there."""
        self.show(text)
        if self.may_print():
            note(text, level)

    def may_print(self) -> bool:
        """Return whether a line may be printed on standard error without damage to the screen."""
        return not (shown_on_screen(self.view) and sys.stderr.isatty())

    def summarise(self) -> None:
        """Print the summary on standard error: cycles, missed, achieved period, utilisation; a line for each node."""
        counts = ext.line_statistics(self.bus)
        if self.bus.state is LineState.RESYNCHRONISING and not (counts.exchanges or counts.unexpected_bytes):
            note("no request was sent: a new line first waits for replies to an earlier master; let it run longer")
        if text := loss_text(self.bus):
            note(text, Level.WARNING)
        for group in self.groups:
            seen, periods = group.statistics(), group.recent_periods
            text = f"{group.name}: {seen.cycles} cycles, {seen.missed} missed"
            if seen.bad:
                text += f", {seen.bad} of {seen.good + seen.late + seen.stale + seen.bad} values not read"
            if periods:
                text += f", period {seen.achieved * 1000:.2f} ms mean, {p99_of(periods) * 1000:.2f} ms p99"
            note(f"{text}, line {counts.utilisation:.1%} busy")
        for node in self.bus.nodes:
            of_node = node.statistics()
            text = f"{node.label}: {of_node.attempts} requests, {of_node.fruitless} failed"
            if of_node.ok:
                text += f", p50 {of_node.latency.p50 * 1000:.2f} ms, p99 {of_node.latency.p99 * 1000:.2f} ms"
            note(text)
        for bus_node in self.bus.nodes:
            if text := learned_text(bus_node.statistics().learned):
                note(f"{bus_node.label}: {text}")
        if text := uart.damage_text(uart.damage(counts.damaged, counts.breaks, counts.driver)):
            note(f"uart: {text}; run `busmaster doctor` for advice")


def loss_text(bus: Bus) -> str:
    """Return how often and for how long the line was lost, and why it is if it still is; "" where it never was."""
    losses, lost = ext.line_statistics(bus).losses, bus.condition
    if not (losses or lost.is_lost):
        return ""
    times = f"{losses} disconnect{'s' * (losses != 1)}, " if losses else "never connected, "
    return f"line: {times}offline for {ext.lost_seconds(bus):.1f} s" + (
        f"; still offline: {lost.reason}" if lost.is_lost else ""
    )


def learned_text(learned: Iterable[LearnedTimes]) -> str:
    """Return the learned windows of a node: one for each kind of command with enough replies."""
    windows = ", ".join(
        f"{times.kind}{' (packet)' * times.packet} {times.window * 1000:.2f} ms" for times in learned if times.trusted
    )
    return windows and f"learned windows: {windows}"


def p99_of(periods: Iterable[float]) -> float:
    """Return the period that 99 % do not exceed."""
    ordered = sorted(periods)
    return ordered[math.ceil(0.99 * len(ordered)) - 1]


class Clock(Protocol):
    """What printed times begin at."""

    start: float

    def since(self, time: float, /) -> float:
        """Return a time of the bus in seconds since the start."""
        ...


def json_cycle(watch: Clock, snapshot: Snapshot) -> str:
    """Return a cycle as one JSON object: times are seconds since the start, but `time` is the time of day."""
    return json_line(**cycle_fields(snapshot, watch.since), time=utc(snapshot.wall_at(snapshot.finished)))


def plain_cycle(snapshot: Snapshot) -> Iterator[str]:
    """Yield a line a sample: the time of day at the end of its cycle, node and item, the value, or what went wrong."""
    time = utc(snapshot.wall_at(snapshot.finished))
    for point, sample in snapshot.samples.items():
        value = error_text(sample.error) if sample.error else value_text(sample.value, point.meaning.precision)
        yield f"{time} {point.key} {value}"


def error_text(error: BusError) -> str:
    """Return what stands in place of the value that could not be read."""
    return f"- {error.what}"


def print_cycle(watch: Watch, snapshot: Snapshot) -> None:
    """Print one cycle, as JSON or as plain lines."""
    lines = [json_cycle(watch, snapshot)] if watch.view.as_json else plain_cycle(snapshot)
    emit_all(lines) if watch.output is None else watch.output.print(lines)


async def print_cycles(watch: Watch, group: PollGroup) -> None:
    """Print every cycle, in a thread: a reader that is slow costs snapshots, never line time."""
    async for snapshot in group:
        # abandoned: a reader that has stopped reading would keep the command from ending
        await anyio.to_thread.run_sync(print_cycle, watch, snapshot, abandon_on_cancel=True)


async def follow(watch: Watch, beside: Callable[[], Coroutine[Any, Any, None]] | None = None) -> int:
    """Show the watch's groups for its seconds, or until the person quits, and return the exit status.

    `beside` runs meanwhile, and is cancelled at the end.
    """
    view = watch.view
    if wants_screen(view) and (missing := what_is_missing()):
        note(f"the live view needs {missing}; showing plain lines")
    status = OK

    async def show(tasks: TaskGroup) -> None:
        """Draw beside the others: a screen that takes its time to end holds up nothing else that is to be done then."""
        nonlocal status
        assert watch.service is not None
        status = await draw(watch.service.address)
        if status == FAILED and watch.output is not None:
            status = OK
            watch.view = replace(view, plain=True)  # events are reported on standard error from now on
            note("the terminal was closed; polling continues without it", Level.WARNING)
        else:
            tasks.cancel_scope.cancel()

    async with AsyncExitStack() as stack:
        if shown_on_screen(view) and watch.service is None:
            try:
                watch.service = await stack.enter_async_context(served_here(watch.authorisation, watch.title))
            except (OSError, InvalidCommand) as error:  # for example without a folder for it: the line runs in any case
                note(f"no live view: {error}; showing plain lines", Level.WARNING)
                watch.view = view = replace(view, plain=True)
        try:
            with anyio.move_on_after(view.seconds):
                async with anyio.create_task_group() as tasks:
                    tasks.start_soon(watch.listen)
                    if beside is not None:
                        tasks.start_soon(beside)
                    watch.show_groups(tasks)
                    if shown_on_screen(view):
                        tasks.start_soon(show, tasks)
        finally:
            watch.summarise()
    return status


def wants_screen(view: View) -> bool:
    """Return whether input and output are a terminal, and no option selects another form."""
    return not (view.plain or view.as_json or view.silent) and sys.stdout.isatty() and sys.stdin.isatty()


def shown_on_screen(view: View) -> bool:
    """Return whether a screen is wanted, and its package is installed."""
    return wants_screen(view) and not what_is_missing()
