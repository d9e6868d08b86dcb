"""`busmaster trend`: samples as lines, as CSV and as a plot, and the summary that ends it."""

from __future__ import annotations

import contextlib
import csv
import enum
import importlib.util
import io
import json
import math
import os
import pty
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from busmaster import Bus, Hcp2Controller, MemoryPort, MscController, Priority
from busmaster.app.cli import trend
from busmaster.app.cli.trend import Sampler, Trace, thinned
from busmaster.app.outputs.cells import csv_lines
from busmaster.app.service.remote import RemoteBus
from busmaster.emulator.device import Device
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer
from busmaster.errors import BusClosed, InvalidCommand, Refused
from busmaster.protocols._comms.mint import EmulatedMint
from tests.app.cli.conftest import ENVIRONMENT, ROOT, Command, ended_once, owner, owner_here, serve
from tests.patience import PATIENCE
from tests.stories import in_virtual_time

HCP2 = ("--protocol", "hcp2", "--timeout", "1000")
NOBODY = "socket://127.0.0.1:1"
needs_plotext = pytest.mark.skipif(importlib.util.find_spec("plotext") is None, reason="plotext is not installed")


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as opened:
        return list(csv.DictReader(opened))


# the sampler, in virtual time


def traces_of(bus: Bus, *names: str) -> list[Trace]:
    points = [Hcp2Controller(bus, int(name.partition("/")[0])).point(name.partition("/")[2]) for name in names]
    return [Trace(name, point, point.node) for name, point in zip(names, points, strict=True)]


async def sampler_of(bus: Bus, *names: str, period: float | None = None) -> Sampler:
    """A sampler of a line that has resynchronised."""
    await bus.node(Hcp2Controller.profile, 1).request(Hcp2Controller.profile.probe)
    return Sampler(bus, traces_of(bus, *names), period)


async def sampled(sampler: Sampler, seconds: float) -> None:
    with anyio.move_on_after(seconds):
        async with anyio.create_task_group() as tasks:
            for trace in sampler.traces:
                tasks.start_soon(sampler.sample, trace)


def memory_bus(*devices: Device) -> Bus:
    return Bus(MemoryPort(Line(Hcp2Controller.profile.line, devices or (EmulatedMint(1), EmulatedMint(2)))))


@in_virtual_time
async def test_it_samples_as_fast_as_the_line_allows() -> None:
    async with memory_bus() as bus:
        sampler = await sampler_of(bus, "1/10", "2/axis0.position")
        before, began = (await bus.statistics()).busy, bus.now()
        await sampled(sampler, 10)
        statistics = await bus.statistics()
        assert (statistics.busy - before) / (bus.now() - began) > 0.95
        assert all(trace.samples > 300 and trace.lost == 0 for trace in sampler.traces)


@in_virtual_time
async def test_the_lowest_and_the_highest_are_those_of_all_samples() -> None:
    mint = EmulatedMint(1)
    async with memory_bus(mint) as bus:
        sampler = await sampler_of(bus, "1/10", period=0.1)
        [trace] = sampler.traces
        for value in (5.0, -3.0, 40.0, 2.0):
            mint.preset("10", value)
            await sampled(sampler, 0.35)
        assert (trace.lowest, trace.highest, trace.last) == (-3.0, 40.0, 2.0)
        assert ", lowest -3, highest 40, 0 lost" in trace.summary(1.4)
        assert [value for _, value in trace.shown][:: len(trace.shown) // 4][:4] == [5.0, -3.0, 40.0, 2.0]


def test_a_value_that_is_not_finite_is_counted_but_is_neither_lowest_nor_highest() -> None:
    point = Hcp2Controller(memory_bus(), 1).point("10")
    trace = Trace("1/10", point, point.node)
    for since, value in enumerate((1.0, math.inf, -2.0, math.nan, -math.inf)):
        trace.take(since, value)
    assert (trace.samples, trace.lowest, trace.highest) == (5, -2.0, 1.0)
    assert [value for _, value in trace.shown] == [1.0, -2.0]
    assert trace.last == -math.inf, "the last value is printed as it is"


@in_virtual_time
async def test_with_a_period_it_keeps_to_the_grid() -> None:
    async with memory_bus() as bus:
        sampler = await sampler_of(bus, "1/10", period=0.1)
        await sampled(sampler, 2.05)
        [trace] = sampler.traces
        assert (trace.samples, trace.lost, trace.missed) == (21, 0, 0)
        assert [int(row.since / 0.1) for row in sampler.rows] == list(range(21))


@in_virtual_time
async def test_samples_that_the_line_is_too_slow_for_are_missed() -> None:
    async with memory_bus() as bus:
        sampler = await sampler_of(bus, "1/10", period=0.001)
        await sampled(sampler, 1)
        [trace] = sampler.traces
        assert 20 < trace.samples < 500
        assert 990 <= trace.samples + trace.missed <= 1000  # the last is under way


@in_virtual_time
async def test_nothing_is_read_while_the_samples_before_are_not_written() -> None:
    async with memory_bus() as bus:
        sampler = await sampler_of(bus, "1/10")
        [trace] = sampler.traces
        sampler.rows.extend([trend.Row(0.0, 0.0, trace)] * trend.MOST_WAITING)
        await sampled(sampler, 1)
        assert trace.samples == 0
        assert len(sampler.take_rows()) == trend.MOST_WAITING
        await sampled(sampler, 1)
        assert trace.samples > 0


@in_virtual_time
async def test_a_node_that_is_gone_costs_samples_and_one_that_returns_is_sampled_again() -> None:
    mint = EmulatedMint(1)
    async with memory_bus(mint) as bus:
        sampler = Sampler(bus, traces_of(bus, "1/10"), None)
        [trace] = sampler.traces
        await sampled(sampler, 1)
        assert (trace.samples > 0, trace.lost) == (True, 0)
        mint.faults.dead = 1.0
        await sampled(sampler, 5)
        lost, samples = trace.lost, trace.samples
        assert 0 < lost < 60
        assert {row.error for row in sampler.rows if row.error} != set()
        mint.faults.dead = 0.0
        await sampled(sampler, 10)
        assert trace.samples > samples
        assert trace.lost + trace.samples == len(sampler.rows)


@in_virtual_time
async def test_a_run_of_values_is_no_point_to_trend() -> None:
    from busmaster.protocols.msc.device import EmulatedMsc

    async with Bus(MemoryPort(Line(MscController.profile.line, [EmulatedMsc(3)]))) as bus:
        point = MscController(bus, 3).point("2008:4")
        with pytest.raises(InvalidCommand, match="3/2008:4 is not one number"):
            await Trace("3/2008:4", point, point.node).read()


def test_thinned_samples_keep_every_peak() -> None:
    samples = [(float(i), 0.0) for i in range(1000)]
    samples[333], samples[777] = (333.0, 9.0), (777.0, -9.0)
    shown = thinned(samples, 100)
    assert len(shown) <= 110
    assert {(333.0, 9.0), (777.0, -9.0)} <= set(shown)
    assert shown == sorted(shown)
    assert thinned(samples[:50], 100) == samples[:50]


# the command


@pytest.mark.slow
def test_lines_csv_and_summary_agree(three_controllers: TcpServer, tmp_path: Path) -> None:
    path = tmp_path / "trend.csv"
    three_controllers.call(lambda line, now: line.device(1).preset("10", 12.5))
    arguments = ("1/10", "2/axis0.idle", "--csv", str(path))
    ran = ended_once(lambda lines: len(lines) >= 20, "trend", three_controllers.path, *HCP2, *arguments)
    assert ran.status == 130
    found = rows(path)
    assert [f"{row['time']} {row['point']} {row['value']}" for row in found] == ran.lines
    assert {(row["point"], row["value"], row["error"]) for row in found} == {
        ("1/10", "12.5", ""),
        ("2/axis0.idle", "1", ""),
    }
    times = [float(row["seconds"]) for row in found]
    assert times == sorted(times)
    for name, low in (("1/10", "12.5"), ("2/axis0.idle", "1")):
        count = sum(row["point"] == name for row in found)
        pattern = rf"busmaster: {name}: {count} samples, [\d.]+ a second, lowest {low}, highest {low}, 0 lost"
        assert re.search(pattern, ran.err), ran.err


@pytest.mark.slow
def test_it_ends_by_itself_and_says_so_in_json(busmaster: Command, three_controllers: TcpServer) -> None:
    ran = busmaster("trend", three_controllers.path, *HCP2, "3/1", "--period", "0.5", "--seconds", "2.75", "--json")
    assert ran.status == 0
    said = [json.loads(line) for line in ran.lines]
    assert 1 <= len(said) <= 6
    assert [set(one) for one in said] == [{"point", "value", "seconds", "time"}] * len(said)
    assert f"3/1: {len(said)} samples" in ran.err


def test_a_node_that_does_not_answer_is_no_value_and_status_1(busmaster: Command, three_controllers: TcpServer) -> None:
    options = ("--retries", "0", "--seconds", "0.5", "--protocol", "hcp2", "--timeout", "20")
    ran = busmaster("trend", three_controllers.path, "99/1", *options)
    assert ran.status == 1
    assert all(" 99/1 - " in line for line in ran.lines)
    assert "attempt" not in ran.out  # as poll prints it: without node, command and attempts
    assert re.search(r"99/1: 0 samples, \d+ lost", ran.err)
    assert "no value was received" in ran.err


@pytest.mark.slow
def test_an_item_that_the_node_does_not_have_ends_it(busmaster: Command) -> None:
    with serve("mentor", 12) as server:
        ran = busmaster("trend", server.path, "--protocol", "mentor", "--timeout", "1000", "12/1.99")
    assert (ran.status, ran.out) == (1, "")
    assert "node 12: refused, 2 attempts (read 01.99)" in ran.err


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("10",), "'10' is not a point; on a PORT, write NODE/ITEM"),
        (("1/",), "on a PORT, write NODE/ITEM"),
        (("one/10",), "on a PORT, write NODE/ITEM"),
        (("1/axis0.positoin",), "did you mean 'axis0.position'?"),
        (("256/1",), "256"),
        (("1/1", "--period", "0"), "a time must be above 0"),
        (("1/1", "--csv", "HERE"), "exists and is not overwritten"),
        ((), "missing argument"),
    ],
)
def test_wrong_usage_is_status_2_and_nothing_is_sent(
    busmaster: Command, tmp_path: Path, arguments: tuple[str, ...], complaint: str
) -> None:
    (tmp_path / "there.csv").touch()
    said = [text.replace("HERE", str(tmp_path / "there.csv")) for text in arguments]
    ran = busmaster("trend", NOBODY, "--protocol", "hcp2", *said)
    assert (ran.status, ran.out) == (2, "")
    assert complaint in ran.err


def test_a_csv_file_that_cannot_be_made_is_status_1(busmaster: Command, tmp_path: Path) -> None:
    ran = busmaster("trend", NOBODY, "--protocol", "hcp2", "1/1", "--csv", str(tmp_path / "none" / "a.csv"))
    assert (ran.status, ran.out) == (1, "")
    assert "a.csv: No such file or directory" in ran.err


def test_a_line_of_a_file_is_sampled_in_the_units_of_its_points(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    three_controllers.call(lambda line, now: line.device(1).preset("10", 125))
    ran = busmaster("trend", str(file), "winder/force", "--seconds", "0.5")
    assert ran.status == 0
    assert {line.split(" ", 1)[1] for line in ran.lines} == {"winder/force 12.5"}
    assert "lowest 12.5, highest 12.5 N, 0 lost" in ran.err
    assert busmaster("trend", str(file), "winder/farce").status == 2


@pytest.mark.slow
def test_on_a_line_that_is_owned_it_takes_its_turn(
    busmaster: Command, file: Path, three_controllers: TcpServer, tmp_path: Path
) -> None:
    three_controllers.call(lambda line, now: line.device(1).preset("10", 125))
    path = tmp_path / "trend.csv"
    with owner("serve", str(file)) as (process, _):
        ran = busmaster("trend", str(file), "winder/force", "winder/11", "--seconds", "1", "--csv", str(path))
        assert ran.status == 0
        assert "is owned by process" in ran.err
        assert {(row["point"], row["value"], row["unit"]) for row in rows(path)} == {
            ("winder/force", "12.5", "N"),
            ("winder/11", "0", ""),
        }
        with subprocess.Popen(
            [sys.executable, "-m", "busmaster", "trend", str(file), "winder/force"],
            cwd=ROOT,
            env=ENVIRONMENT,
            stdin=subprocess.DEVNULL,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        ) as trending:
            assert trending.stdout is not None
            assert "winder/force" in trending.stdout.readline()
            process.terminate()  # the owner ends: nobody reads the line any more
            _, err = trending.communicate(timeout=PATIENCE)
    assert trending.returncode == 1
    assert "samples" in err


# the plot


def on_a_terminal(*arguments: str, environment: dict[str, str] | None = None, until: bytes) -> tuple[int, str, str]:
    """Status, output and standard error of a command on a terminal of 80 by 24, ended by Ctrl-C after `until`."""
    master, slave = pty.openpty()
    wide = {"COLUMNS": "80", "LINES": "24", **(environment or {})}
    with subprocess.Popen(
        [sys.executable, "-m", "busmaster", *arguments],
        cwd=ROOT,
        env=ENVIRONMENT | wide,
        stdin=subprocess.DEVNULL,
        stdout=slave,
        stderr=subprocess.PIPE,
        start_new_session=True,
    ) as process:
        os.close(slave)
        found, signalled = b"", False
        while True:
            try:
                found += os.read(master, 65536)
            except OSError:  # it has ended
                break
            if until in found and not signalled:
                process.send_signal(signal.SIGINT)
                signalled = True
        _, err = process.communicate(timeout=PATIENCE)
    os.close(master)
    return process.returncode, found.decode(), err.decode()


@pytest.mark.slow
@needs_plotext
def test_the_plot_is_drawn_and_left_behind(three_controllers: TcpServer) -> None:
    status, out, err = on_a_terminal("trend", three_controllers.path, *HCP2, "1/10", until=b" 1/10 0 (")
    assert status == 130
    assert out.startswith(trend.OTHER_SCREEN)
    before, _, after = out.rpartition(trend.USUAL_SCREEN)
    for text in (before, after):  # what is left behind is drawn anew
        assert "┤" in text
        assert "1/10 0 (" in text
    assert "1/10" in after
    assert "\x1b[H" not in after
    assert re.search(r"1/10: \d+ samples, .* 0 lost", err)


@pytest.mark.slow
def test_without_plotext_it_prints_lines_and_names_the_extra(three_controllers: TcpServer, tmp_path: Path) -> None:
    (tmp_path / "plotext.py").write_text("raise ImportError")
    path = {"PYTHONPATH": f"{tmp_path}:{ROOT}"}
    status, out, err = on_a_terminal(
        "trend", three_controllers.path, *HCP2, "1/10", environment=path, until=b" 1/10 0\r\n"
    )
    assert status == 130
    assert "pip install 'busmaster[trend]'; plain lines instead" in err
    assert "\x1b" not in out


@needs_plotext
@in_virtual_time
async def test_the_plot_shows_the_last_seconds_alone() -> None:
    import plotext

    async with memory_bus() as bus:
        sampler = Sampler(bus, traces_of(bus, "1/10", "2/10"), 0.1)
        await sampled(sampler, 3)
        sampler.traces[0].shown.appendleft((0.0, 1e6))
        sampler.traces[1].name = "a\x1b[2Jb"
        text = "\n".join(trend.Plot(sampler, plotext, 1.0).lines())
        assert "1000000" not in text
        assert "\x1b[2J" not in text


def test_a_formula_in_a_name_is_none_in_the_csv() -> None:
    point: Any = type("P", (), {"unit": "=1+1", "meaning": None})()
    row = trend.Row(0.0, 0.0, Trace("=cmd", point, point), 1)
    [read] = csv.reader(io.StringIO(csv_lines([trend.cells(row)]).decode()))
    assert read[2:5] == ["'=cmd", "1", "'=1+1"]


# the options, and the samples as they are shown


class HandedOver:
    """What the command samples, and how, instead of sampling it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(trend, "until_ended", self._until_ended)
        self.bus: Any = None
        self.names: list[str] = []
        self.items: list[tuple[str, str]] = []
        self.rest: tuple[Any, ...] = ()

    def _until_ended(self, _: Any, bus: Any, traces: list[Trace], *rest: Any) -> int:
        self.bus, self.names, self.rest = bus, [trace.name for trace in traces], rest
        self.items = [(trace.node.label, trace.point.item) for trace in traces]
        return 0


@pytest.fixture
def handed(monkeypatch: pytest.MonkeyPatch) -> HandedOver:
    return HandedOver(monkeypatch)


ALL = ("--period", "0.5", "--seconds", "7", "--span", "9", "--csv", "CSV", "--plain", "--json")


def test_each_option_reaches_the_samples_of_a_port_a_file_and_an_owner(
    busmaster: Command, file: Path, tmp_path: Path, handed: HandedOver
) -> None:
    path = str(tmp_path / "x.csv")
    options = [path if word == "CSV" else word for word in ALL]

    def both(*command: str, in_file: bool = True) -> None:
        expected: Any = (None, None, trend.How(False, False, trend.SPAN, None, in_file))
        assert busmaster("trend", *command).status == 0
        assert handed.rest == expected
        assert busmaster("trend", *command, *options).status == 0
        assert handed.rest == (0.5, 7.0, trend.How(True, True, 9.0, path, in_file))

    both(NOBODY, "1/10", "2/axis0.position", "1/10", "--protocol", "hcp2", in_file=False)
    assert handed.names == ["1/10", "2/axis0.position"]
    assert handed.items == [("node 1", "10"), ("node 2", "axis0.position")]
    both(str(file), "winder/force", "winder/11", "winder/force")
    assert handed.names == ["winder/force", "winder/11"]
    with owner_here(file):
        both(str(file), "winder/force", "winder/11")
    assert handed.names == ["winder/force", "winder/11"]
    assert isinstance(handed.bus, RemoteBus)


def test_an_item_of_a_node_without_an_address_is_its_whole_name(busmaster: Command, handed: HandedOver) -> None:
    assert busmaster("trend", NOBODY, "12", "--protocol", "dc104").status == 0
    assert handed.names == ["12"]
    assert [item for _, item in handed.items] == ["12"]


def trace_of(unit: str = "mm", precision: int | None = 2) -> Trace:
    point: Any = SimpleNamespace(unit=unit, meaning=SimpleNamespace(precision=precision))
    return Trace("winder/force", point, point)


@pytest.mark.parametrize(
    ("counts", "text"),
    [
        ({}, "winder/force: 0 samples, 0 lost"),
        ({"lost": 3, "missed": 2}, "winder/force: 0 samples, 3 lost, 2 missed"),
        (
            {"samples": 5, "lowest": 1.0, "highest": 2.5},
            "winder/force: 5 samples, 2.5 a second, lowest 1.00, highest 2.50 mm, 0 lost",
        ),
        ({"samples": 1, "lost": 1}, "winder/force: 1 samples, 0.5 a second, 1 lost"),
    ],
)
def test_the_summary_has_what_there_is(counts: dict[str, Any], text: str) -> None:
    trace = trace_of()
    for name, value in counts.items():
        setattr(trace, name, value)
    assert trace.summary(2.0) == text
    assert " a second" not in trace.summary(0.0)


def test_a_summary_without_a_unit_ends_its_values_without_one() -> None:
    trace = trace_of("", None)
    trace.take(0.0, 3)
    assert ", lowest 3, highest 3, 0 lost" in trace.summary(2.0)


class Word(enum.IntFlag):
    READY = 1


def test_a_sample_is_printed_with_its_precision_its_names_or_its_error() -> None:
    good, bad = trend.Row(0.0, 1.25, trace_of(), 3.5), trend.Row(0.0, 1.25, trace_of(), error="no reply")
    word = trend.Row(0.0, 0.1234567, trace_of(), Word.READY)
    assert trend.plain_line(good) == "1970-01-01T00:00:00.000Z winder/force 3.50"
    assert trend.plain_line(bad) == "1970-01-01T00:00:00.000Z winder/force - no reply"
    assert json.loads(trend.fields(good)) == {
        "point": "winder/force",
        "value": 3.5,
        "seconds": 1.25,
        "time": "1970-01-01T00:00:00.000Z",
    }
    assert json.loads(trend.fields(bad))["error"] == "no reply"
    assert "value" not in json.loads(trend.fields(bad))
    assert json.loads(trend.fields(word))["names"] == ["READY"]
    assert json.loads(trend.fields(word))["seconds"] == 0.123457
    assert trend.cells(good) == ("1970-01-01T00:00:00.000Z", "1.250000", "winder/force", "3.5", "mm", "")
    assert trend.cells(bad) == ("1970-01-01T00:00:00.000Z", "1.250000", "winder/force", "", "mm", "no reply")
    formula = trend.Row(0.0, 0.0, trace_of(), error="=1+1")
    assert trend.cells(formula)[-1] == "'=1+1"


def test_samples_are_in_the_file_at_once_and_printed_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x.csv"
    with trend.Output(False, True, str(path)) as output:
        output.write([trend.Row(0.0, 1.25, trace_of(), 3.5)])
        assert [row["value"] for row in rows(path)] == ["3.5"]
        assert "winder/force 3.50" in capsys.readouterr().out
        file = output._csv
    assert file is not None
    assert file.closed
    with pytest.raises(FileExistsError), trend.Output(False, True, str(path)):
        pass
    with trend.Output(True, False, None) as output:  # there is a plot
        output.write([trend.Row(0.0, 1.25, trace_of(), 3.5)])
    assert capsys.readouterr().out == ""


class Plotter:
    """A plot that keeps its data."""

    def __init__(self) -> None:
        self.shown: list[tuple[str, str, list[tuple[float, float]]]] = []
        self.limits: tuple[float, float] = (0.0, 0.0)
        self.size: tuple[int, int] = (0, 0)

    def clear_figure(self) -> None:
        self.shown.clear()

    def theme(self, name: str) -> None:
        pass

    def plot_size(self, columns: int, rows: int) -> None:
        self.size = columns, rows

    def xlim(self, first: float, last: float) -> None:
        self.limits = first, last

    def plot(self, times: Any, values: Any, *, label: str, marker: str) -> None:
        self.shown.append((label, marker, list(zip(times, values, strict=True))))

    def build(self) -> str:
        return "the plot\n\n"


def plot_of(*traces: Trace, elapsed: float, span: float = 60.0) -> tuple[trend.Plot, Plotter]:
    sampler: Any = SimpleNamespace(elapsed=elapsed, traces=traces)
    plotter = Plotter()
    return trend.Plot(sampler, plotter, span), plotter


def test_the_plot_has_each_point_that_has_samples_in_its_span_with_a_marker_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "90")
    monkeypatch.setenv("LINES", "30")
    traces = [trace_of() for _ in range(6)]
    for number, trace in enumerate(traces[:5]):
        trace.name = f"p{number}"
        for since in (1.0, 25.0, 30.0):
            trace.take(since, number + since)
    plot, plotter = plot_of(*traces, elapsed=30.0, span=10.0)
    plot.lines()
    assert plot.lines()[0] == "the plot"  # drawn anew, without what was drawn before
    assert plotter.limits == (20.0, 30.0)
    assert plotter.size == (90, 28)
    assert [(label, marker) for label, marker, _ in plotter.shown] == [
        *(("p0", "braille"), ("p1", "dot"), ("p2", "x"), ("p3", "o"), ("p4", "braille"))
    ]
    assert plotter.shown[1][2] == [(25.0, 26.0), (30.0, 31.0)]
    plot, plotter = plot_of(*traces, elapsed=30.0)
    plot.lines()
    assert plotter.limits == (0.0, 30.0)
    assert len(plotter.shown[1][2]) == 3


def test_a_small_terminal_gets_the_smallest_plot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "7")
    monkeypatch.setenv("LINES", "3")
    plot, plotter = plot_of(trace_of(), elapsed=0.0)
    lines = plot.lines()
    assert plotter.size == trend.SMALLEST
    assert plotter.limits == (0.0, trend.DRAW_EVERY)
    assert len(lines[-1]) == trend.SMALLEST[0]


def test_the_last_line_has_the_last_values_rates_and_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    empty, trace, bare = trace_of(), trace_of(), trace_of("", None)
    for since in range(10):
        trace.take(since, since + 0.5)
        bare.take(since, 7)
    trace.lost, trace.missed = 2, 3
    plot, _ = plot_of(empty, trace, bare, elapsed=4.0)
    assert plot.lines()[-1] == (
        "4.0 s  winder/force - mm (0.0/s, 0 lost)  winder/force 9.50 mm (2.5/s, 2 lost)  winder/force 7 (2.5/s, 0 lost)"
    )


def test_a_plot_takes_the_terminal_and_gives_it_back(capsys: pytest.CaptureFixture[str]) -> None:
    plot, _ = plot_of(trace_of(), elapsed=1.0)
    with plot:
        assert capsys.readouterr().out == trend.OTHER_SCREEN
        plot.draw()
        drawn = capsys.readouterr().out
        assert drawn.startswith("\x1b[Hthe plot\x1b[K\n")
        assert drawn.endswith("\x1b[K\x1b[J")
    left = capsys.readouterr().out
    assert left.startswith(f"{trend.USUAL_SCREEN}the plot\n")
    assert left.endswith("\n")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plain", "as_json", "terminal", "drawn"),
    [(False, False, True, True), (True, False, True, False), (False, True, True, False), (False, False, False, False)],
)
def test_a_plot_is_drawn_on_a_terminal_unless_lines_are_wanted(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    plain: bool,
    as_json: bool,
    terminal: bool,
    drawn: bool,
) -> None:
    plotter = Plotter()
    monkeypatch.setitem(sys.modules, "plotext", plotter)
    monkeypatch.setattr(trend, "WRITE_EVERY", 0.02)
    monkeypatch.setattr(trend, "DRAW_EVERY", 0.05)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal)

    async def story() -> int:
        bus = memory_bus()
        traces = traces_of(bus, "1/10", "2/10")
        return await trend.trend(bus, traces, 0.05, 0.6, trend.How(as_json, plain, 0.3, None, False))

    assert anyio.run(story) == 0
    out, err = capsys.readouterr()
    assert out.startswith(trend.OTHER_SCREEN) == drawn
    assert (" 1/10 " in out or '"1/10"' in out) == (not drawn or "1/10 0 (" in out)
    assert "2/10" in out
    assert [line.split(":")[1].strip() for line in err.splitlines()] == ["1/10", "2/10"]
    if drawn:
        first, last = plotter.limits
        assert last - first == pytest.approx(0.3)


@in_virtual_time
async def test_a_trend_has_values_if_any_point_has_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trend, "note", lambda *_: None)
    for counts, status in (((3, 0), 0), ((0, 3), 0), ((0, 0), 1)):

        async def run(sampler: Sampler, *_: Any, counts: tuple[int, ...] = counts) -> None:
            for trace, count in zip(sampler.traces, counts, strict=True):
                trace.samples = count

        monkeypatch.setattr(trend, "run", run)
        bus = memory_bus()
        traces = traces_of(bus, "1/10", "2/10")
        assert await trend.trend(bus, traces, 0.1, 3.0, trend.How(False, True, 60.0, None, False)) == status


@in_virtual_time
async def test_a_read_that_is_refused_ends_a_trend_only_before_the_first_sample() -> None:
    async with memory_bus() as bus:
        for samples, ends in ((0, True), (1, False)):
            sampler = Sampler(bus, traces_of(bus, "1/10"), None)
            [trace] = sampler.traces
            trace.samples = samples

            async def refused(*_: Any, **__: Any) -> Any:
                raise Refused("refused", hint="it does not exist")

            trace.node = SimpleNamespace(request=refused)
            with pytest.raises(ExceptionGroup) if ends else contextlib.nullcontext():
                await sampled(sampler, 0.95)
            # after a failure it waits, so that a lost line does not fail thousands of times
            assert trace.lost == len(sampler.rows) == (0 if ends else 10)


@in_virtual_time
async def test_the_end_of_the_bus_ends_a_trend() -> None:
    async with memory_bus() as bus:
        sampler = await sampler_of(bus, "1/10")
        [trace] = sampler.traces
        trace.samples = 1

        async def closed(*_: Any, **__: Any) -> Any:
            raise BusClosed("the bus is closed", hint="")

        trace.node = SimpleNamespace(request=closed)
        with pytest.raises(ExceptionGroup):
            await sampled(sampler, 1.0)


def test_the_last_samples_are_written_at_the_end(
    busmaster: Command, controllers: TcpServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trend, "WRITE_EVERY", 60.0)
    path = tmp_path / "x.csv"
    options = ("--seconds", "0.5", "--csv", str(path))
    ran = busmaster("trend", controllers.path, "--protocol", "hcp2", "5/1", *options)
    assert ran.status == 0
    assert len(ran.lines) == len(rows(path)) > 0


@in_virtual_time
async def test_a_sample_is_read_in_the_background_and_may_be_whole() -> None:
    asked: list[dict[str, Any]] = []
    values = iter((5.5, 5))

    async def request(command: Any, **options: Any) -> float:
        asked.append(options)
        return next(values)

    async with memory_bus() as bus:
        [trace] = traces_of(bus, "1/10")
        trace.node = SimpleNamespace(request=request)
        assert [await trace.read() for _ in range(2)] == [5.5, 5]
    assert asked == [{"priority": Priority.BACKGROUND}] * 2
