"""`busmaster bench`: latency and throughput of a line, emulated or real, as an application sees them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

import click

from busmaster import Bus, InvalidCommand
from busmaster.app.cli.app import FAILED, OK
from busmaster.app.cli.arguments import Connection, nodes_option
from busmaster.app.cli.emulate import nodes_to_emulate
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.output import Level, columns, emit, emit_all, json_line, note
from busmaster.app.cli.parsing import Whole, option_type, parse_items, parse_seconds, parse_window, parsed
from busmaster.app.cli.protocols import NodeCommand, handle_options, protocol_option, take_options
from busmaster.app.cli.reaching import check_no_owner
from busmaster.emulator import NAMES, Delay
from busmaster.ext import Learned, is_served, read_file
from busmaster.testing.bench import (
    CYCLE,
    FIGURES,
    MOST_CALLERS,
    BenchReport,
    Budget,
    EmulatedLine,
    Measurement,
    Times,
    VirtualTimeLoop,
    Workload,
    check_plot,
    check_scope,
    emulated,
    parse_priorities,
    plot,
    ratios,
)
from busmaster.testing.bench import about as about_line

BAR = 40
"""Columns of the longest bar of the histogram."""
HEAD = ("LATENCY, ms", "COUNT", "MEAN", *FIGURES)


@click.command(cls=NodeCommand)
@click.argument("port", required=False)
@protocol_option(required=False, text="One of {}.")
@nodes_option
@click.option(
    "--seconds",
    type=option_type(parse_seconds),
    default="10",
    metavar="S",
    show_default=True,
    help="How long to measure.",
)
@click.option(
    "--callers",
    type=click.IntRange(0, MOST_CALLERS),
    metavar="N",
    help="Callers that read; one for each node by default.",
)
@click.option(
    "--every",
    type=option_type(parse_seconds),
    metavar="S",
    help="Seconds from read to read of each caller; by default each reads again as soon as it has its value.",
)
@click.option(
    "--priorities",
    type=option_type(parse_priorities),
    metavar="NAME=N,...",
    help="Priorities of the reads and their relative frequency, like command=8,urgent=1; by default only command.",
)
@click.option(
    "--period",
    type=option_type(parse_seconds),
    metavar="S",
    help="Add a poll group with one value of each node, and this period in seconds.",
)
@click.option(
    "--items",
    type=option_type(parse_items),
    metavar="ITEM,ITEM...",
    help="Items to read; by default the protocol's probe and sync reads.",
)
@click.option("--baud", type=Whole(min=1), metavar="N", help="Baud rate; the protocol's by default.")
@click.option(
    "--reply-delay",
    type=option_type(Delay.parse),
    metavar="MS[-MS]",
    help="Reply delay of the emulated nodes, in milliseconds; 2 by default.",
)
@click.option(
    "--fault",
    "faults",
    multiple=True,
    metavar="NAME=VALUE",
    help=f"Fault of every emulated node, like lost=0.1. Repeatable. One of {' '.join(NAMES)}.",
)
@click.option(
    "--seed",
    type=int,
    metavar="N",
    default=1,
    show_default=True,
    help="Seed of all random numbers, for a repeatable run.",
)
@click.option("--virtual", is_flag=True, help="Emulate in virtual time: the same result each time, on any machine.")
@click.option("--echo", is_flag=True, help="The adapter of PORT receives its own transmissions (two-wire).")
@click.option(
    "--timeout",
    type=option_type(parse_window),
    metavar="MS",
    help="The reply window, in milliseconds; or `learned`, from the replies.",
)
@click.option("--retries", type=Whole(min=0), metavar="N", help="How many times a failed read is repeated.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object, for --compare.")
@click.option(
    "--plot",
    "picture",
    metavar="FILE",
    help="Draw histogram and latency over time (.png, .svg, .pdf). Needs matplotlib.",
)
@click.option(
    "--budget",
    "budgets",
    multiple=True,
    type=option_type(Budget.parse),
    metavar="FIGURE=LIMIT",
    help="Exit with 1 if a figure is above its limit in milliseconds, like p99=20, urgent.max=15, 5.p99.9=40, "
    "cycle.p99=90; errors=0 and missed=0 are counts; p99=1.2x, with --compare, is a multiple. Repeatable.",
)
@click.option(
    "--compare", nargs=2, metavar="A.json B.json", help="Measure nothing: print the ratio of B to A. Budgets are for B."
)
@click.pass_context
def command(context: click.Context, /, **given: Any) -> int:
    """Measure how long reads take from the call to the value, and how much of the wire's limit is reached.

    Without a PORT the line is emulated, on a pseudo-terminal in a process of its own or, with --virtual, in virtual
    time; with node 1 only, unless --nodes names others. On a PORT nothing is written. It must not be in use.

    Callers read one after another, of all nodes in turn if there are fewer callers than nodes. A latency is the time
    from the time at which the read was due, or called, until the caller has its value. Failed reads are counted by
    error and have no latency. The limit of the wire follows from the bits of these exchanges and the reply delay. On a
    PORT, the reply delay is the median of those observed.

    The exit status is 1 if a budget is exceeded, or no value was received. Ctrl-C prints the result so far.
    """
    if given["compare"]:
        first, second = given["compare"]
        return compare(context, first, second, given["budgets"], given["as_json"])
    return Run(given).result()


class Run:
    """One measurement, defined by the options. Raises UsageError and InvalidCommand before anything is opened."""

    def __init__(self, given: dict[str, Any]) -> None:
        self.port: str | None = given["port"]
        protocol: str | None = given["protocol"]
        if protocol is None:
            raise click.UsageError("nothing to measure; use --protocol P, or --compare A.json B.json")
        self._check_options(given)
        self.as_json: bool = given["as_json"]
        self.picture: str | None = given["picture"]
        self.budgets: Sequence[Budget] = given["budgets"]
        self.virtual: bool = given["virtual"]
        options = take_options(handle_options(), protocol, given)
        window: float | Learned | None = given["timeout"]
        self.connection = Connection(
            self.port or "", protocol, given["baud"], given["echo"], window, given["retries"], options=options
        )
        profile, nodes = self.connection.profile, given["nodes"]
        self.addresses = tuple(
            nodes_to_emulate(profile, nodes) if self.port is None else self.connection.addresses(nodes)
        )
        self.workload = Workload(
            seconds=given["seconds"],
            callers=given["callers"],
            every=given["every"],
            period=given["period"],
            items=given["items"] or (),
            seed=given["seed"],
            **({} if given["priorities"] is None else {"priorities": given["priorities"]}),
        )
        self.delay: Delay = given["reply_delay"] or Delay()
        self.faults: tuple[str, ...] = given["faults"]
        self._check_budgets()
        if self.picture is not None:
            check_plot(self.picture)

    def _check_options(self, given: Mapping[str, Any]) -> None:
        """Raise UsageError for an option of the other kind of line."""
        if self.port is None:
            if given["echo"]:
                raise click.UsageError("--echo needs a PORT; leave it out for an emulated line")
            return
        if is_served(self.port):
            raise click.UsageError(
                f"{self.port} is a line of another program, whose reads would distort the result; stop it first"
            )
        wrong = {"virtual": "--virtual", "reply_delay": "--reply-delay", "faults": "--fault"}
        for name, option in wrong.items():
            if given[name]:
                raise click.UsageError(f"{option} needs an emulated line; leave out the PORT, or {option}")

    def _check_budgets(self) -> None:
        """Raise UsageError for a budget of something that is not measured."""
        known = [*map(str, self.addresses), *(one.name.lower() for one in self.workload.priorities)]
        known += [CYCLE] if self.workload.period is not None else []
        for budget in self.budgets:
            if budget.relative:
                raise click.UsageError(
                    f"budget {budget}: a multiple ({budget.limit:g}x) needs --compare; use milliseconds"
                )
            parsed(partial(check_scope, budget), known)

    def result(self) -> int:
        """Measure, print the result, also if it was interrupted, and return the exit status."""
        with ExitStack() as lines:
            measurement = self._measurement(lines)
            if not self.virtual:
                note(f"measuring for {self.workload.seconds:g} s; Ctrl-C ends it and prints the result so far")
            try:
                until_ended(measurement.run, loop_factory=VirtualTimeLoop if self.virtual else None)
            finally:
                report = measurement.report() if measurement.begun else None
                if report is not None:
                    self._show(report)
        assert report is not None  # it ended by itself
        return self._status(report)

    def _measurement(self, lines: ExitStack) -> Measurement:
        if self.port is None:
            high = self.delay.low if self.delay.high is None else self.delay.high
            line = EmulatedLine(
                self.connection.protocol,
                self.addresses,
                self.connection.baud,
                (self.delay.low, high),
                self.faults,
                self.workload.seed,
            )
            return lines.enter_context(
                emulated(line, self.workload, virtual=self.virtual, handle=self.connection.open_handle)
            )
        endpoint = self.connection.endpoint()
        check_no_owner(endpoint)
        bus = Bus(endpoint, seed=self.workload.seed)
        handles = [self.connection.open_handle(bus, address) for address in self.addresses]
        return Measurement(bus, handles, self.workload, about=about_line(bus, self.connection.protocol, endpoint.name))

    def _show(self, report: BenchReport) -> None:
        """Print the report, and draw it."""
        if self.as_json:
            emit(report.to_json())
        else:
            emit_all(page(report))
        if self.picture is not None:
            plot(report, self.picture)

    def _status(self, report: BenchReport) -> int:
        status = print_excess(report.exceeded(self.budgets))
        if not report.values:
            note("no value was received; check the port, the protocol and the nodes", Level.ERROR)
            return FAILED
        return status


def print_excess(texts: Sequence[str]) -> int:
    """Print on standard error which budgets are exceeded, and return the exit status."""
    for text in texts:
        note(f"budget exceeded: {text}", Level.ERROR)
    return FAILED if texts else OK


# the report


def page(report: BenchReport) -> Iterator[str]:
    """Yield the lines of a report: workload, percentiles, histogram, share of the wire's limit."""
    yield head(report)
    yield work(report)
    rows = [HEAD, *(row(name, times) for name, times in distributions(report))]
    yield from columns(rows, right=range(1, len(HEAD)))
    yield from bars(report)
    yield (
        f"{report.values} values in {report.elapsed:.2f} s: {report.rate:.1f} a second, {report.share:.1%} of the "
        f"wire's limit of {report.limit:.1f}"
    )
    errors = ", ".join(f"{name} {count}" for name, count in report.errors.items())
    yield f"missed cycles: {report.missed}; errors: {errors or 'none'}"


def head(report: BenchReport) -> str:
    """Return what line it was."""
    line = report.line
    nodes = len(report.workload["nodes"])
    text = f"{line['protocol']}, {nodes} node{'' if nodes == 1 else 's'}, {line['baudrate']} baud {line['framing']}"
    if "virtual" not in line:
        return f"{text}, on {line['port']}"
    low, high = (1000 * bound for bound in line["reply_delay"])
    text += f", replies after {low:g}{'' if low == high else f' to {high:g}'} ms"
    text += f", faults {' '.join(line['faults'])}" if line["faults"] else ""
    return f"{text}, emulated {'in virtual time' if line['virtual'] else 'on a pseudo-terminal'}"


def work(report: BenchReport) -> str:
    """Return the workload as text."""
    load = report.workload
    callers = len(load["nodes"]) if load["callers"] is None else load["callers"]
    every = "without pauses" if load["every"] is None else f"once in {load['every']:g} s"
    shares = ", ".join(f"{name} {share}" for name, share in load["priorities"].items())
    group = "no poll group" if load["period"] is None else f"a poll group every {load['period']:g} s"
    return f"{callers} caller{'' if callers == 1 else 's'}, each {every} ({shares}); {group}; seed {load['seed']}"


def distributions(report: BenchReport) -> Iterator[tuple[str, Times]]:
    """Yield the rows of the table, by their names."""
    for name, times in report.nodes.items():
        yield f"node {name}", times
    if len(report.priorities) > 1:
        yield from report.priorities.items()
    yield "total", report.total
    if report.workload["period"] is not None:
        yield "poll cycles", report.cycles


def row(name: str, times: Times) -> tuple[str, ...]:
    """Return the cells of a distribution, in milliseconds."""
    figures = [times.mean, *times.figures.values()] if times.count else []
    cells = [f"{1000 * figure:.2f}" for figure in figures] or ["-"] * (len(HEAD) - 2)
    return name, str(times.count), *cells


def bars(report: BenchReport) -> Iterator[str]:
    """Yield the histogram: a bar for each bucket."""
    if not report.histogram:
        return
    most = max(count for _, count in report.histogram)
    for edge, count in report.histogram:
        bar = "#" * -(-count * BAR // most)  # a bucket that is not empty shows
        yield f"to {1000 * edge:>9.2f} ms  {bar:{BAR}}  {count}"


# comparing


def compare(context: click.Context, first: str, second: str, budgets: Sequence[Budget], as_json: bool) -> int:
    """Print how the second report differs from the first, and return the exit status."""
    for parameter in context.command.get_params(context):
        source = context.get_parameter_source(parameter.name or "")
        if source is click.core.ParameterSource.COMMANDLINE and parameter.name not in ("compare", "budgets", "as_json"):
            raise click.UsageError(f"--compare does not measure; leave out {parameter.human_readable_name}")
    before, after = read_report(first), read_report(second)
    excess = after.exceeded(budgets, before=before)  # first: a budget of something that is not measured is wrong usage
    found = ratios(before, after)
    if as_json:
        emit(ratios_json(before, after, found))
    else:
        emit_all(comparison(before, after, found))
    return print_excess(excess)


def read_report(path: str) -> BenchReport:
    """Return the report of a file. Raises OSError, and UsageError for a file that holds none."""
    try:
        return BenchReport.from_json(read_file(path))
    except InvalidCommand as error:
        raise click.UsageError(f"{path}: {error}") from None


def comparison(before: BenchReport, after: BenchReport, found: Mapping[str, Mapping[str, float]]) -> Iterator[str]:
    """Yield the lines of a comparison: of each distribution the ratios, then the rates and counts."""
    yield f"A: {head(before)}"
    yield f"B: {head(after)}"
    differing = [name for name, value in before.workload.items() if after.workload.get(name) != value]
    if differing:
        yield f"the workloads differ: {', '.join(differing)}"
    rows: list[tuple[str, ...]] = [("B / A", *FIGURES)]
    for name, figures in found.items():
        title = f"node {name}" if name in after.nodes else name or "total"
        rows.append((title, *(f"{figures[one]:.2f}" if one in figures else "-" for one in FIGURES)))
    yield from columns(rows, right=range(1, len(FIGURES) + 1))
    yield f"values a second: A {before.rate:.1f}, B {after.rate:.1f}"
    yield f"share of the wire's limit: A {before.share:.1%}, B {after.share:.1%}"
    yield f"missed cycles: A {before.missed}, B {after.missed}"
    yield f"errors: A {sum(before.errors.values())}, B {sum(after.errors.values())}"


def ratios_json(before: BenchReport, after: BenchReport, found: Mapping[str, Mapping[str, float]]) -> str:
    """Return the comparison as JSON: the ratios, then rates and counts of both reports."""
    return json_line(
        ratios={name or "total": figures for name, figures in found.items()},
        rate=[before.rate, after.rate],
        share=[before.share, after.share],
        missed=[before.missed, after.missed],
        errors=[sum(before.errors.values()), sum(after.errors.values())],
        same_workload=before.workload == after.workload,
    )


__all__ = ["command"]
