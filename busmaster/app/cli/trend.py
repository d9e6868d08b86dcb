"""`busmaster trend`: a few values as fast as the line allows, as a plot in the terminal and a CSV file."""

from __future__ import annotations

import math
import os
import shutil
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from itertools import cycle
from operator import itemgetter
from types import TracebackType
from typing import Any, BinaryIO, NamedTuple

import anyio
import click

from busmaster import Bus, BusClosed, BusError, InvalidCommand, Point, Priority, Refused
from busmaster.app.cli.app import FAILED, OK
from busmaster.app.cli.arguments import Connection, connected, json_option, plain_option, seconds_option
from busmaster.app.cli.capturing import capturing
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.late import late_nodes
from busmaster.app.cli.lines import is_line_file, load
from busmaster.app.cli.output import Level, emit_all, json_line, json_value, name_fields, note, value_text
from busmaster.app.cli.parsing import option_type, parse_seconds
from busmaster.app.cli.protocols import ItemCommand
from busmaster.app.cli.reaching import owner_to_use, reach
from busmaster.app.cli.terminal import printable
from busmaster.app.line import ConfiguredLine
from busmaster.app.outputs.cells import csv_lines, no_formula
from busmaster.app.service.remote import RemoteBus, connect
from busmaster.app.service.values import utc
from busmaster.ext import Requester, is_decimal, open_file

COLUMNS = ("time", "seconds", "point", "value", "unit", "error")
SPAN = 60.0
"""Seconds that the plot shows."""
MOST_SHOWN = 50_000
"""Samples of a point that are kept for the plot."""
MOST_WAITING = 10_000
"""Samples that wait to be printed or written. Beyond it nothing is read until there is room: none is lost."""
AFTER_ERROR = 0.1
"""Seconds until the next read after one that failed. A lost line fails each at once."""
WRITE_EVERY = 0.1
DRAW_EVERY = 0.5
"""Seconds. Drawing takes some 20 ms, in a thread."""
HEAD = 2
"""Lines of the terminal beside the plot."""
SMALLEST = (20, 5)
MARKERS = ("braille", "dot", "x", "o")
OTHER_SCREEN, USUAL_SCREEN = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
"""Without a cursor, and with it again."""
MISSING = "the live plot needs plotext, which the extra named trend brings: pip install 'busmaster[trend]'"


@click.command(cls=ItemCommand)
@partial(connected, or_file=True)
@click.argument("names", nargs=-1, required=True, metavar="NODE/ITEM...")
@click.option(
    "--period",
    type=option_type(parse_seconds),
    metavar="S",
    help="Seconds between two samples of a point; by default as fast as the line allows.",
)
@click.option("--csv", "csv_path", metavar="FILE", help="Write each sample to this new file, too.")
@click.option(
    "--span", type=option_type(parse_seconds), metavar="S", help=f"Seconds that the plot shows; {SPAN:g} by default."
)
@seconds_option
@plain_option
@json_option
def command(
    connection: Connection,
    names: tuple[str, ...],
    period: float | None,
    csv_path: str | None,
    span: float | None,
    seconds: float | None,
    plain: bool,
    as_json: bool,
) -> int:
    """Read each NODE/ITEM again and again until Ctrl-C, and plot the values. A summary on standard error ends it:
    samples, rate, lowest and highest value, lost samples.

    NODE is an address on PORT, or the name of a node in LINE.toml, with values in the point's unit. The reads are in
    the background of other traffic: they use the time that it leaves. Where another busmaster owns the line, they go
    through it. A read that fails is a lost sample.

    On a terminal a live plot; else, or with --plain, a line for each value as `poll` prints it. The CSV file has the
    columns time (UTC), seconds (since the start), point, value, unit and error.
    """
    if csv_path is not None and os.path.exists(csv_path):
        raise click.UsageError(f"{csv_path} exists and is not overwritten; choose another name")
    in_file = is_line_file(connection.port)
    how = How(as_json, plain, span or SPAN, csv_path, in_file)
    names = tuple(dict.fromkeys(names))
    if not in_file:
        bus = reach(connection)
        traces = [trace_on_port(connection, bus, name) for name in names]
        return until_ended(trend, bus, traces, period, seconds, how)
    file = load(connection.port)
    if (owner := owner_to_use(file.port, connection.capture)) is not None:
        remote = connect(owner.address)
        line = ConfiguredLine(file, outputs=False)
        return until_ended(trend, remote, [trace_of_file(line, name, remote) for name in names], period, seconds, how)
    with capturing(connection.capture, port=file.port.name, echo=file.port.echo) as recorder:
        line = ConfiguredLine(file, outputs=False, tap=recorder)
        return until_ended(trend, line.bus, [trace_of_file(line, name) for name in names], period, seconds, how)


class How(NamedTuple):
    """How samples are shown: as JSON or plain lines, how many seconds of them as a plot, and in which file.

    `in_file`: the points are those of a LINE.toml, which defines the reply windows too.
    """

    as_json: bool
    plain: bool
    span: float
    csv_path: str | None
    in_file: bool


# the sampled items


class Row(NamedTuple):
    """One sample: when it was read, in seconds since 1970 and since the start, its value, or why there is none."""

    wall: float
    since: float
    trace: Trace
    value: Any = None
    error: str = ""


@dataclass(slots=True)
class Trace:
    """One point that is sampled, and what came of it. `missed`: samples that were due while one was still read."""

    name: str
    point: Point[Any]
    node: Requester
    samples: int = 0
    lost: int = 0
    missed: int = 0
    lowest: float = math.inf
    highest: float = -math.inf
    last: Any = None
    shown: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=MOST_SHOWN))

    async def read(self) -> Any:
        """Return its value. Raises BusError, and InvalidCommand if it is not one number."""
        value = self.point.value_of(await self.node.request(self.point.command, priority=Priority.BACKGROUND))
        if not isinstance(value, int | float):
            raise InvalidCommand(f"{self.name} is not one number but {value!r}; use an item with one value")
        return value

    def take(self, since: float, value: float) -> None:
        """Count a sample."""
        self.samples += 1
        self.last = value
        if math.isfinite(value):
            self.lowest, self.highest = min(self.lowest, value), max(self.highest, value)
            self.shown.append((since, float(value)))

    def summary(self, seconds: float) -> str:
        """Return what came of it, in one line."""
        text = f"{self.name}: {self.samples} samples"
        if self.samples and seconds > 0:
            text += f", {self.samples / seconds:.1f} a second"
        if self.lowest <= self.highest:
            precision, unit = self.point.meaning.precision, f" {self.point.unit}" if self.point.unit else ""
            low, high = (value_text(value, precision) for value in (self.lowest, self.highest))
            text += f", lowest {low}, highest {high}{unit}"
        text += f", {self.lost} lost"
        return text + (f", {self.missed} missed" if self.missed else "")


def trace_on_port(connection: Connection, bus: Bus | RemoteBus, name: str) -> Trace:
    """Return a point of a node that its address names: "5/axis0.position"; "12" where there are no addresses."""
    node, slash, item = name.partition("/")
    if connection.profile.addressed:
        if not slash or not item or not is_decimal(node):
            raise click.UsageError(f"{name!r} is not a point; on a PORT, write NODE/ITEM, like 5/1")
        address = connection.one_address(int(node))
    else:
        item = name
        address = connection.one_address(None)
    handle = connection.open_handle(bus, address)
    return Trace(name, handle.point(item), handle.node)


def trace_of_file(line: ConfiguredLine, name: str, remote: RemoteBus | None = None) -> Trace:
    """Return a point of a file, read over `remote` if that owns the line."""
    point = line.point(name)
    return Trace(name, point, line.handle(point.where, remote).node)


class Sampler:
    """Reads the points, each as fast as it is answered, or on a grid of `period` seconds."""

    def __init__(self, bus: Bus | RemoteBus, traces: Sequence[Trace], period: float | None) -> None:
        self.traces = traces
        self.rows: deque[Row] = deque()
        """Samples that are not written yet."""
        self._bus = bus
        self._period = period
        self.start = bus.now()

    @property
    def elapsed(self) -> float:
        """Return the seconds since the start."""
        return self._bus.now() - self.start

    def take_rows(self) -> list[Row]:
        """Take the samples that have not been written yet."""
        return [self.rows.popleft() for _ in range(len(self.rows))]

    async def sample(self, trace: Trace) -> None:
        """Sample one point until cancelled. Raises Refused if the node does not have it, LineDown if the owner of the
        line is gone."""
        number = 0
        while True:
            while len(self.rows) >= MOST_WAITING:  # noqa: ASYNC110  # rows are taken by a thread
                await anyio.sleep(WRITE_EVERY)
            failed = not await self._sample_once(trace)
            if self._period is None:
                await anyio.sleep(AFTER_ERROR if failed else 0)
                continue
            # max: a timer may end a little before its time, which is then rounded down to the point of the grid before
            due = max(number, math.floor(self.elapsed / self._period)) + 1
            trace.missed += max(0, due - number - 1)
            number = due
            await anyio.sleep(max(0.0, number * self._period - self.elapsed))

    async def _sample_once(self, trace: Trace) -> bool:
        try:
            value = await trace.read()
        except BusError as error:
            if isinstance(self._bus, RemoteBus):
                self._bus.link.check()
            if isinstance(error, BusClosed) or (isinstance(error, Refused) and not trace.samples):
                raise
            trace.lost += 1
            self.rows.append(Row(time.time(), self.elapsed, trace, error=error.what))
            return False
        since = self.elapsed
        trace.take(since, value)
        self.rows.append(Row(time.time(), since, trace, value))
        return True


# how it is shown


class Output:
    """Where samples go: lines on standard output unless there is a plot, and a CSV file. A context manager.

    Entering it raises OSError if the file cannot be created.
    """

    def __init__(self, as_json: bool, lines: bool, csv_path: str | None) -> None:
        self._as_json = as_json
        self._lines = lines
        self._csv_path = csv_path
        self._csv: BinaryIO | None = None

    def __enter__(self) -> Output:
        if self._csv_path is not None:
            self._csv = open(open_file(self._csv_path, os.O_WRONLY | os.O_EXCL), "wb")
            self._csv.write(csv_lines([COLUMNS]))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._csv is not None:
            self._csv.close()

    def write(self, rows: Sequence[Row]) -> None:
        """Print and write samples. Raises OSError if the file or the reader of the lines is gone."""
        if self._csv is not None:
            self._csv.write(csv_lines(map(cells, rows)))
            self._csv.flush()
        if self._lines:
            emit_all(map(fields if self._as_json else plain_line, rows))


def cells(row: Row) -> tuple[str, ...]:
    """Return the cells of a sample, as COLUMNS names them."""
    value = "" if row.error else value_text(row.value)
    names = no_formula(row.trace.name), value, no_formula(row.trace.point.unit), no_formula(row.error)
    return utc(row.wall), f"{row.since:.6f}", *names


def fields(row: Row) -> str:
    """Return a sample as JSON."""
    value = {"error": row.error} if row.error else {"value": json_value(row.value), **name_fields(row.value)}
    return json_line(point=row.trace.name, **value, seconds=round(row.since, 6), time=utc(row.wall))


def plain_line(row: Row) -> str:
    """Return a sample as a line: the time, the point, and the value, or `-` and what went wrong."""
    value = f"- {row.error}" if row.error else value_text(row.value, row.trace.point.meaning.precision)
    return f"{utc(row.wall)} {row.trace.name} {value}"


class Plot:
    """The last `span` seconds, drawn on the whole terminal. A context manager: leaving it leaves the last plot behind,
    among the lines of the terminal."""

    def __init__(self, sampler: Sampler, plotext: Any, span: float) -> None:
        self._sampler = sampler
        self._plotext = plotext
        self._span = span

    def __enter__(self) -> Plot:
        _print(OTHER_SCREEN)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        _print(USUAL_SCREEN + "\n".join(self.lines()) + "\n")

    def draw(self) -> None:
        """Draw it anew."""
        _print("\x1b[H" + "\n".join(f"{line}\x1b[K" for line in self.lines()) + "\x1b[J")

    def lines(self) -> list[str]:
        """Return the lines of the plot, and one with the last values."""
        size = shutil.get_terminal_size()
        columns, rows = max(size.columns, SMALLEST[0]), max(size.lines - HEAD, SMALLEST[1])
        now = self._sampler.elapsed
        first = max(0.0, now - self._span)
        plot = self._plotext
        plot.clear_figure()
        plot.theme("clear")
        plot.plot_size(columns, rows)
        plot.xlim(first, max(now, first + DRAW_EVERY))
        for trace, marker in zip(self._sampler.traces, cycle(MARKERS), strict=False):
            shown = thinned([one for one in trace.shown.copy() if one[0] >= first], 2 * columns)
            if shown:
                plot.plot(*zip(*shown, strict=True), label=printable(trace.name), marker=marker)
        drawn: str = plot.build()
        return [*drawn.rstrip("\n").split("\n"), printable(self._state(now))[:columns]]

    def _state(self, now: float) -> str:
        parts = [f"{now:.1f} s"]
        for trace in self._sampler.traces:
            value = "-" if trace.last is None else value_text(trace.last, trace.point.meaning.precision)
            rate = trace.samples / now if now > 0 else 0.0
            parts.append(f"{trace.name} {value} {trace.point.unit}".rstrip() + f" ({rate:.1f}/s, {trace.lost} lost)")
        return "  ".join(parts)


def thinned(samples: Sequence[tuple[float, float]], most: int) -> Sequence[tuple[float, float]]:
    """Return at most about so many samples: of each stretch the lowest and the highest, so that no peak is left out."""
    if len(samples) <= most:
        return samples
    size = math.ceil(2 * len(samples) / most)
    found: list[tuple[float, float]] = []
    for start in range(0, len(samples), size):
        part = samples[start : start + size]
        found += sorted({min(part, key=itemgetter(1)), max(part, key=itemgetter(1))})
    return found


def _print(text: str) -> None:
    sys.stdout.write(text)
    sys.stdout.flush()


def plotter(plain: bool) -> Any:
    """Return plotext if a plot is wanted on a terminal, else None. Prints which extra is missing."""
    if plain or not sys.stdout.isatty():
        return None
    try:
        import plotext
    except ImportError:
        note(f"{MISSING}; plain lines instead", Level.ERROR)
        return None
    return plotext


# the whole


async def trend(
    bus: Bus | RemoteBus, traces: Sequence[Trace], period: float | None, seconds: float | None, how: How
) -> int:
    """Sample the points until Ctrl-C, or for so many seconds, print and plot them, and return the exit status."""
    plotext = plotter(how.plain or how.as_json)
    with Output(how.as_json, plotext is None, how.csv_path) as output:
        async with bus, late_nodes(bus, in_file=how.in_file):
            sampler = Sampler(bus, traces, period)
            try:
                with Plot(sampler, plotext, how.span) if plotext is not None else nullcontext() as plot:
                    try:
                        with anyio.move_on_after(seconds):
                            await run(sampler, output, plot)
                    finally:
                        output.write(sampler.take_rows())
            finally:
                elapsed = sampler.elapsed
                for trace in traces:
                    note(trace.summary(elapsed))
    if any(trace.samples for trace in traces):
        return OK
    note("no value was received; see the errors above", Level.ERROR)
    return FAILED


async def run(sampler: Sampler, output: Output, plot: Plot | None) -> None:
    """Sample, write and draw until cancelled."""
    async with anyio.create_task_group() as tasks:
        for trace in sampler.traces:
            tasks.start_soon(sampler.sample, trace)
        if plot is not None:
            tasks.start_soon(repeat, DRAW_EVERY, plot.draw)
        await repeat(WRITE_EVERY, lambda: output.write(sampler.take_rows()))


async def repeat(every: float, work: Callable[[], None]) -> None:
    """Do something in a thread, again and again: neither the disk nor the terminal holds the line up."""
    while True:
        await anyio.sleep(every)
        await anyio.to_thread.run_sync(work)
