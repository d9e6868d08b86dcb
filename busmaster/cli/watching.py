"""Watching poll groups: as plain lines, as JSON, or on the screen; and the summary at the end."""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Callable, Coroutine, Iterable, Iterator
from dataclasses import replace
from importlib.util import find_spec
from statistics import fmean
from typing import Any, Protocol

import anyio
from anyio.abc import TaskGroup

from busmaster.arbiter.events import LineChange, LineChanged, NodeChanged, PortFailed
from busmaster.arbiter.health import Health
from busmaster.arbiter.learned import LearnedTimes
from busmaster.arbiter.state import LineState
from busmaster.bus.alarms import AlarmChanged, BusEvent
from busmaster.bus.bus import Bus
from busmaster.bus.points import Point
from busmaster.bus.polling import PollGroup, Quality, Sample, Snapshot
from busmaster.cli.app import FAILED, OK
from busmaster.cli.arguments import View
from busmaster.cli.drawing import draw
from busmaster.cli.messages import Action, Frame, GroupRow, NodeRow, Row
from busmaster.cli.output import Level, SteadyOutput, emit_all, json_line, note, value_text
from busmaster.cli.parsing import parse_value
from busmaster.doctor import uart
from busmaster.errors import BusError, InvalidCommand
from busmaster.gate.gate import Gate, Wish
from busmaster.outputs.values import cycle_fields, event_text

KEPT_PERIODS = 1_000
KEPT_EVENTS = 8
LINE = ""
"""Stands for the line itself among what is in trouble."""
SUSPENDED_FOR = 60.0
UTILISATION_WINDOW = 1.0
COUNTED_EVERY = 0.5
"""Seconds between two looks at the counts of nodes and groups."""
STATES = {LineState.OFFLINE: "offline", LineState.SETTLING: "settling"}
"""What is worth a word: a line in use is ready."""


class Watch:
    """What a person sees of a bus while its groups are polled. Times are in seconds since it was made.

    `view` says how it is shown, `gate` is what the writes of the screen pass. `steady`: that nobody can print any more
    does not end it. It hears what happens to the bus from the start on, before that is entered too.
    """

    def __init__(self, bus: Bus, title: str, view: View, *, gate: Gate | None = None, steady: bool = False) -> None:
        self.bus = bus
        self.output = SteadyOutput(note) if steady else None
        self.title = title
        self.view = view
        self.gate = gate or Gate(bus, read_only=view.read_only)
        self.start = bus.now()
        self.groups: list[PollGroup] = []
        self.events: deque[str] = deque(maxlen=KEPT_EVENTS)
        self._heard = bus.events()
        self._troubles: set[str] = set()
        self._tasks: TaskGroup | None = None
        self._periods: dict[str, deque[float]] = {}
        self._started: dict[str, float] = {}
        self._good: dict[Point[Any], Sample[Any]] = {}
        self._counted = -math.inf
        self._node_rows: tuple[NodeRow, ...] = ()
        self._group_rows: tuple[GroupRow, ...] = ()
        self._loads: deque[tuple[float, float]] = deque()

    def since(self, time: float) -> float:
        """Return a time of the bus in seconds since the start."""
        return round(time - self.start, 6)

    def add(self, group: PollGroup) -> None:
        """Show this group too, from now on."""
        self.groups.append(group)
        self._periods[group.name] = deque(maxlen=KEPT_PERIODS)
        if self._tasks is not None:
            self._begin(self._tasks, group)

    def replace_groups(self, groups: Iterable[PollGroup]) -> None:
        """Show these groups from now on; one that is shown already goes on."""
        wanted = list(groups)
        for gone in [group for group in self.groups if group not in wanted]:
            self.groups.remove(gone)
            self._started.pop(gone.name, None)
        for group in wanted:
            if group not in self.groups:
                self.add(group)
        self.groups.sort(key=wanted.index)
        self._counted = -math.inf

    def show_groups(self, tasks: TaskGroup) -> None:
        """Take in the cycles of all groups, those that are added later too, and print them unless there is a screen."""
        self._tasks = tasks
        for group in self.groups:
            self._begin(tasks, group)

    def _begin(self, tasks: TaskGroup, group: PollGroup) -> None:
        tasks.start_soon(count_cycles if shown_on_screen(self.view) or self.view.silent else print_cycles, self, group)

    def saw(self, snapshot: Snapshot) -> None:
        """Count one cycle, and keep the good values: a point that fails shows its last one, growing old."""
        self._good.update((point, sample) for point, sample in snapshot.samples.items() if sample.error is None)
        if snapshot.started is None:
            return
        before = self._started.get(snapshot.group)
        if before is not None:
            self._periods[snapshot.group].append(snapshot.started - before)
        self._started[snapshot.group] = snapshot.started

    async def listen(self) -> None:
        """Keep the last events, as text, until cancelled."""
        async for event in self._heard:
            text = event_text(event)
            level = self._level(event)
            if text and level is not None:
                self.announce(text, level)
            elif text:
                self.tell(text)

    def _level(self, event: BusEvent) -> Level | None:
        """Return how much an event matters to whoever is not looking: a loss, and its end, once each.

        None stands for the rest.
        """
        match event:
            case PortFailed():
                self._troubles.add(LINE)
                return Level.ERROR
            case AlarmChanged():
                return Level.WARNING if event.active else Level.NOTICE
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

    def tell(self, text: str) -> None:
        """Add to the last events."""
        self.events.append(f"{self.bus.now() - self.start:7.1f} s  {text}")

    def announce(self, text: str, level: Level = Level.NOTICE) -> None:
        """Add to the last events; print a line on standard error, unless the screen that shows them is there."""
        self.tell(text)
        if self.may_print():
            note(text, level)

    def may_print(self) -> bool:
        """Tell whether a line may be printed on standard error: it must not tear the picture that is drawn there."""
        return not (shown_on_screen(self.view) and sys.stderr.isatty())

    def picture(self) -> Frame:
        """Return the frame for the screen. Cheap: it is taken on the loop that owns the line."""
        now = self.bus.now()
        if now >= self._counted + COUNTED_EVERY:
            self._counted = now
            self._node_rows = tuple(self._nodes())
            self._group_rows = tuple(map(self._group, self.groups))
        statistics = self.bus.statistics()
        return Frame(
            title=self.title,
            port=self.port,
            now=now - self.start,
            line=STATES.get(self.bus.state, "ready"),
            utilisation=self._utilisation(now, statistics.busy + statistics.settling),
            backlog=statistics.backlog,
            rows=tuple(self._row(point, group.latest, now) for group in self.groups for point in group.points),
            nodes=self._node_rows,
            groups=self._group_rows,
            events=tuple(self.events),
            read_only=self.view.read_only,
        )

    @property
    def port(self) -> str:
        """The name of the port, with the rate and framing where it has them."""
        settings = self.bus.endpoint.settings
        name = self.bus.endpoint.name
        return f"{name}  {settings.baudrate} {settings.framing}" if settings else name

    async def act(self, action: Action) -> None:
        """Do what the person asked for. What cannot be done is an event."""
        match action.kind:
            case "demand":
                for group in self.groups:
                    group.demand()
            case "pause":
                self._pause()
            case "suspend":
                self._suspend(action.target)
            case "write":
                await self._write(action)
        self._counted = -math.inf

    def _pause(self) -> None:
        """Pause all groups, or go on with them. The time in between is no period."""
        paused = all(group.paused for group in self.groups)
        self._started.clear()
        for group in self.groups:
            group.resume() if paused else group.pause()

    def _suspend(self, label: str) -> None:
        """Suspend the node for SUSPENDED_FOR seconds, or go on with it."""
        for node in self.bus.nodes:
            if node.label == label:
                node.suspend(0.0 if node.suspended else SUSPENDED_FOR)
                self.tell(f"{label} is suspended for {SUSPENDED_FOR:.0f} s" if node.suspended else f"{label} goes on")

    async def _write(self, action: Action) -> None:
        points = {(point.node.label, point.item): point for group in self.groups for point in group.points}
        point = points.get((action.target, action.item))
        if point is None:
            return
        name = f"{action.target} {action.item}"
        try:
            value = parse_value(action.value)
        except InvalidCommand as error:
            self.tell(f"{name} = {action.value}: {error}")
            return
        write = await self.gate.write(Wish(door="screen", by="key w", name=point.key, point=point, value=value))
        self.tell(f"{name} = {action.value}{' written' if write.ok else f': {write.error}'}")

    def _utilisation(self, now: float, busy: float) -> float:
        self._loads.append((now, busy))
        while len(self._loads) > 2 and self._loads[1][0] <= now - UTILISATION_WINDOW:
            self._loads.popleft()
        since, busy_then = self._loads[0]
        return max(0.0, min(1.0, (busy - busy_then) / (now - since))) if now > since else 0.0

    def _nodes(self) -> Iterator[NodeRow]:
        for node in self.bus.nodes:
            counts = node.statistics()
            latency = counts.latency
            health = "suspended" if node.suspended else node.health.value
            failed = counts.no_reply + counts.garbled + counts.refused
            yield NodeRow(node.label, health, counts.attempts, failed, latency.p50, latency.p99)

    def _row(self, point: Point[Any], latest: Snapshot | None, now: float) -> Row:
        good, sample = self._good.get(point), latest.samples.get(point) if latest else None
        value = good.value if good else None
        return Row(
            point.node.label,
            point.item,
            # by its exact type: words and flags are ints, too, and are shown by their names
            value if type(value) in (int, float) or value is None else value_text(value, point.meaning.precision),
            short_unit(point.unit),
            good.age(now) if good else None,
            good is not None and good.quality is Quality.LATE,
            sample.error.what if sample and sample.error else "",
            point.writable,
            point.meaning.precision,
        )

    def _group(self, group: PollGroup) -> GroupRow:
        periods = self._periods[group.name]
        counts = group.statistics()
        mean = fmean(periods) if periods else None
        return GroupRow(group.name, group.period, mean, p99_of(periods), counts.cycles, counts.missed, group.paused)

    def summarise(self) -> None:
        """Print the summary on standard error: cycles, missed, achieved period, utilisation; a line for each node."""
        counts = self.bus.statistics()
        if self.bus.state is LineState.SETTLING and not (counts.exchanges or counts.unasked_bytes):
            note("nothing was asked: a new line rests until replies to an earlier master are past; let it run longer")
        for group in map(self._group, self.groups):
            text = f"{group.name}: {group.cycles} cycles, {group.missed} missed"
            if group.achieved is not None and group.p99 is not None:
                text += f", period {group.achieved * 1000:.2f} ms mean, {group.p99 * 1000:.2f} ms p99"
            note(f"{text}, line {counts.utilisation:.1%} busy")
        for node in self._nodes():
            note(
                f"{node.label}: {node.requests} requests, {node.failed} failed, "
                f"p50 {node.p50 * 1000:.2f} ms, p99 {node.p99 * 1000:.2f} ms"
            )
        for bus_node in self.bus.nodes:
            if text := learned_text(bus_node.statistics().learned):
                note(f"{bus_node.label}: {text}")
        if text := uart.damage_text(uart.damage(counts.damaged, counts.breaks, counts.driver)):
            note(f"uart: {text}; `busmaster doctor` says what to look for")


def learned_text(learned: Iterable[LearnedTimes]) -> str:
    """Return what was learned of a node's reply times: the window of each kind of command that is trusted."""
    windows = ", ".join(
        f"{times.kind}{' (packet)' * times.packet} {times.window * 1000:.2f} ms" for times in learned if times.trusted
    )
    return windows and f"learned windows: {windows}"


def p99_of(periods: Iterable[float]) -> float | None:
    """Return the period that 99 % do not exceed, None without any."""
    ordered = sorted(periods)
    return ordered[math.ceil(0.99 * len(ordered)) - 1] if ordered else None


def short_unit(unit: str) -> str:
    """Shorten a unit: a column has no room for "% of rated current"."""
    return unit.partition(" of ")[0]


class Clock(Protocol):
    """What printed times begin at."""

    start: float

    def since(self, time: float, /) -> float:
        """Return a time of the bus in seconds since the start."""
        ...


def json_cycle(watch: Clock, snapshot: Snapshot) -> str:
    """Return a cycle as one JSON object."""
    return json_line(**cycle_fields(snapshot, watch.since))


def plain_cycle(watch: Clock, snapshot: Snapshot) -> Iterator[str]:
    """Yield a line a sample: seconds since the start, node and item, the value, or what went wrong."""
    for point, sample in snapshot.samples.items():
        value = error_text(sample.error) if sample.error else value_text(sample.value, point.meaning.precision)
        yield f"{snapshot.finished - watch.start:.3f} {point.key} {value}"


def error_text(error: BusError) -> str:
    """Return what stands in place of the value that could not be read."""
    return f"- {error.what}"


def print_cycle(watch: Watch, snapshot: Snapshot) -> None:
    """Print one cycle, as JSON or as plain lines."""
    lines = [json_cycle(watch, snapshot)] if watch.view.as_json else plain_cycle(watch, snapshot)
    emit_all(lines) if watch.output is None else watch.output.print(lines)


async def print_cycles(watch: Watch, group: PollGroup) -> None:
    """Print every cycle, in a thread: a reader that is slow costs snapshots, never line time."""
    async for snapshot in group:
        watch.saw(snapshot)
        # abandoned: a reader that has stopped reading would keep the command from ending
        await anyio.to_thread.run_sync(print_cycle, watch, snapshot, abandon_on_cancel=True)


async def count_cycles(watch: Watch, group: PollGroup) -> None:
    """Count every cycle, and print none."""
    async for snapshot in group:
        watch.saw(snapshot)


async def follow(watch: Watch, beside: Callable[[], Coroutine[Any, Any, None]] | None = None) -> int:
    """Show the watch's groups for its seconds, or until the person quits, and return the exit status.

    `beside` runs meanwhile, and is cancelled at the end.
    """
    view = watch.view
    on_screen = shown_on_screen(view)
    if not on_screen and wants_screen(view):
        note("the live view needs the extra named tui (pip install 'busmaster[tui]'); plain lines instead")
    status = OK

    async def show(tasks: TaskGroup) -> None:
        """Draw beside the others: a screen that takes its time to end holds up nothing else that is to be done then."""
        nonlocal status
        status = await draw(watch.picture, lambda action: tasks.start_soon(watch.act, action))
        if status == FAILED and watch.output is not None:
            status = OK
            watch.view = replace(view, plain=True)  # what happens is told on standard error from now on
            note("the screen is gone; polling goes on without it", Level.WARNING)
        else:
            tasks.cancel_scope.cancel()

    try:
        with anyio.move_on_after(view.seconds):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(watch.listen)
                if beside is not None:
                    tasks.start_soon(beside)
                watch.show_groups(tasks)
                if on_screen:
                    tasks.start_soon(show, tasks)
    finally:
        watch.summarise()
    return status


def wants_screen(view: View) -> bool:
    """Tell whether there is a terminal on both sides, and nobody who would rather have it otherwise."""
    return not (view.plain or view.as_json or view.silent) and sys.stdout.isatty() and sys.stdin.isatty()


def shown_on_screen(view: View) -> bool:
    """Tell whether a screen is wanted, and the library that draws is there."""
    return wants_screen(view) and find_spec("textual") is not None
