"""`busmaster trend`: samples as lines, as CSV and as a plot, and the summary that ends it."""

from __future__ import annotations

import csv
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
from typing import Any

import anyio
import pytest

from busmaster import Bus, Hcp2Controller, MemoryPort, MscController
from busmaster.app.cli import trend
from busmaster.app.cli.trend import Sampler, Trace, thinned
from busmaster.app.outputs.cells import csv_lines
from busmaster.emulator.device import Device
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer
from busmaster.errors import InvalidCommand
from busmaster.protocols._comms.mint import EmulatedMint
from tests.app.cli.conftest import ENVIRONMENT, ROOT, Command, ended_once, owner, serve
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
