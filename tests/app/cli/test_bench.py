"""`busmaster bench`, as a person types it: emulated, on a real port, compared, and ended before its time."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer, serve_tcp
from busmaster.registry import find, make_device
from busmaster.testing.bench import BenchReport
from tests.app.cli.conftest import ENVIRONMENT, ROOT, Command, started
from tests.patience import PATIENCE

HCP2 = ("--protocol", "hcp2")
VIRTUAL = ("bench", *HCP2, "--virtual", "--seconds", "2")


class WatchedLine(Line):
    """Keeps what the host sends; `busy` is set after so many requests."""

    wanted = 50

    def send(self, data: bytes, now: float) -> None:
        super().send(data, now)
        self.sent.append(data)
        if len(self.sent) >= self.wanted:
            self.busy.set()

    sent: list[bytes]
    busy: threading.Event


@pytest.fixture
def served() -> Iterator[TcpServer]:
    """Controllers 1 to 3 on a TCP port."""
    line = WatchedLine(find("hcp2").profile.line, [make_device("hcp2", n) for n in (1, 2, 3)], chance=random.Random(1))
    line.sent, line.busy = [], threading.Event()
    with serve_tcp(line) as server:
        yield server


def watched(server: TcpServer) -> WatchedLine:
    assert isinstance(server.line, WatchedLine)
    return server.line


# emulated


def test_an_emulated_line_in_virtual_time_gives_the_same_json_each_time(busmaster: Command) -> None:
    mixed = (
        "--nodes",
        "1-4",
        "--reply-delay",
        "1-9",
        "--priorities",
        "command=4,urgent=1",
        "--period",
        "0.2",
        "--json",
    )
    first, second = busmaster(*VIRTUAL, *mixed), busmaster(*VIRTUAL, *mixed)
    assert (first.status, first.err) == (0, "")
    assert first.out == second.out
    assert busmaster(*VIRTUAL, *mixed, "--seed", "2").out != first.out
    fields = json.loads(first.out)
    assert fields["share"] == pytest.approx(1, abs=0.2)
    assert list(fields["nodes"]) == ["1", "2", "3", "4"]
    assert list(fields["priorities"]) == ["urgent", "command"]


@pytest.mark.slow
def test_a_line_on_a_pseudo_terminal_is_measured_and_printed(busmaster: Command) -> None:
    done = busmaster("bench", *HCP2, "--nodes", "1-2", "--seconds", "0.3", "--priorities", "command=1,urgent=1")
    assert (done.status, done.err) == (
        0,
        "busmaster: measuring for 0.3 s; Ctrl-C ends it and prints the result so far\n",
    )
    assert done.lines[0] == "hcp2, 2 nodes, 57600 baud 8N1, replies after 2 ms, emulated on a pseudo-terminal"
    assert done.lines[1].startswith("2 callers, each without pauses (command 1, urgent 1); no poll group")
    rows = [line.split()[:2] for line in done.lines[3:7]]
    assert [row[0] for row in rows] == ["node", "node", "urgent", "command"]
    assert done.lines[2].split()[2:] == ["COUNT", "MEAN", "p50", "p90", "p99", "p99.9", "max"]
    assert any(line.startswith("to ") and "#" in line for line in done.lines)
    assert "% of the wire's limit of" in done.lines[-2]
    assert done.lines[-1] == "missed cycles: 0; errors: none"


def test_errors_and_missed_cycles_are_printed_and_no_value_is_a_failure(busmaster: Command) -> None:
    dead = busmaster(*VIRTUAL, "--fault", "dead=1")
    assert dead.status == 1
    assert "no value was received" in dead.err
    assert dead.lines[-1].startswith("missed cycles: 0; errors: NoReply ")
    slow = busmaster(*VIRTUAL, "--reply-delay", "50", "--callers", "0", "--period", "0.025", "--budget", "missed=0")
    assert slow.status == 1
    assert slow.lines[-1].startswith("missed cycles: ")
    assert int(slow.lines[-1].split()[2].rstrip(";")) > 20
    assert "budget exceeded: " in slow.err


# budgets


def test_a_budget_that_is_kept_is_status_0_and_one_that_is_not_status_1(busmaster: Command) -> None:
    kept = busmaster(*VIRTUAL, "--budget", "p99=20ms", "--budget", "1.max=20", "--budget", "errors=0")
    assert (kept.status, kept.err) == (0, "")
    broken = busmaster(*VIRTUAL, "--budget", "p99=20", "--budget", "p50=1")
    assert broken.status == 1
    assert broken.err.startswith("busmaster: budget exceeded: p50: 4.431 ms, budget 1 ms\n")
    assert broken.err.count("\n") == 1
    assert "total" in broken.out


# a real port


def test_a_port_is_only_read_from(busmaster: Command, served: TcpServer) -> None:
    profile = find("hcp2").profile
    done = busmaster("bench", served.path, *HCP2, "--nodes", "1-3", "--seconds", "0.3", "--period", "0.1", "--json")
    assert done.status == 0
    report = BenchReport.from_json(done.out)
    assert report.line["port"].endswith(str(served.port))
    assert report.values > 0
    assert report.errors == {}
    reads = {
        read.open(address, profile.timings).request
        for address in (1, 2, 3)
        for read in (profile.probe, *profile.sync_reads)
    }
    assert set(watched(served).sent) <= reads


def test_the_items_to_read_can_be_chosen(busmaster: Command, served: TcpServer) -> None:
    at = ("bench", served.path, *HCP2, "--nodes", "2", "--seconds", "0.2")
    assert busmaster(*at, "--items", "7,axis0.position", "--json").status == 0
    wrong = busmaster(*at, "--items", "axis0.positron")
    assert wrong.status == 2
    assert "axis0.positron" in wrong.err


@pytest.mark.parametrize("port", ["/dev/ttyNOWHERE", "socket://127.0.0.1:1"])
def test_a_port_that_is_not_there_is_one_clear_line_and_status_1(busmaster: Command, port: str) -> None:
    done = busmaster("bench", port, *HCP2, "--nodes", "1", "--seconds", "1")
    assert (done.status, done.out) == (1, "")
    assert port.removeprefix("socket://") in done.err.splitlines()[-1]


@pytest.mark.slow
def test_ctrl_c_prints_what_was_measured_so_far(served: TcpServer) -> None:
    with started("bench", served.path, *HCP2, "--nodes", "1-3", "--seconds", "3000", "--json") as process:
        assert watched(served).busy.wait(PATIENCE)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    report = BenchReport.from_json(out)
    assert 0 < report.total.count <= len(watched(served).sent)
    assert report.workload["seconds"] == 3000 > report.elapsed


MEASURES = """
import sys
from busmaster.app.cli import bench, main

class Run(bench.Run):
    def result(self):
        print("measures", flush=True)
        return super().result()

bench.Run = Run
sys.exit(main())
"""


def test_ctrl_c_ends_virtual_time_too() -> None:
    command = [sys.executable, "-c", MEASURES, "bench", *HCP2, "--virtual", "--seconds", "3600", "--nodes", "1-14"]
    with subprocess.Popen(command, cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "measures\n"
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE)
    assert process.returncode == 130


# comparing


@pytest.fixture
def reports(busmaster: Command, tmp_path: Path) -> tuple[str, str]:
    """One of one caller, and one of two, whose reads wait twice as long."""
    paths = []
    for callers in ("1", "2"):
        path = tmp_path / f"{callers}.json"
        path.write_text(busmaster(*VIRTUAL, "--callers", callers, "--json").out)
        paths.append(str(path))
    return paths[0], paths[1]


def test_two_reports_are_compared(busmaster: Command, reports: tuple[str, str]) -> None:
    done = busmaster("bench", "--compare", *reports)
    assert (done.status, done.err) == (0, "")
    assert done.lines[2] == "the workloads differ: callers"
    assert done.lines[3].split() == ["B", "/", "A", "p50", "p90", "p99", "p99.9", "max"]
    assert done.lines[4].split()[:2] == ["total", "2.00"]
    fields = json.loads(busmaster("bench", "--compare", *reports, "--json").out)
    assert fields["ratios"]["total"]["p50"] == pytest.approx(2, rel=0.01)
    assert fields["same_workload"] is False


def test_a_budget_of_a_comparison_is_for_the_second_report(busmaster: Command, reports: tuple[str, str]) -> None:
    assert busmaster("bench", "--compare", *reports, "--budget", "p50=2.1x", "--budget", "max=20").status == 0
    worse = busmaster("bench", "--compare", *reports, "--budget", "p50=1.5x")
    assert worse.status == 1
    assert "budget exceeded: p50: 8.861 ms, budget 6.646 ms (1.5 times 4.431 ms)" in worse.err
    assert busmaster("bench", "--compare", *reversed(reports), "--budget", "p50=1.5x").status == 0


def test_a_file_that_is_no_report_cannot_be_compared(
    busmaster: Command, reports: tuple[str, str], tmp_path: Path
) -> None:
    other = tmp_path / "other.json"
    other.write_text("{}")
    wrong = busmaster("bench", "--compare", reports[0], str(other))
    assert (wrong.status, wrong.out) == (2, "")
    assert "other.json: it is not a report of `busmaster bench --json`" in wrong.err
    missing = busmaster("bench", "--compare", reports[0], str(tmp_path / "none.json"))
    assert missing.status == 1
    assert "none.json" in missing.err


# bad arguments


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((), "--protocol"),
        (("--protocol", "hcp3"), "no such protocol"),
        ((*HCP2, "--nodes", "999"), "no protocol has a node 999"),
        ((*HCP2, "--seconds", "0"), "a time must be above 0"),
        ((*HCP2, "--seconds", "1e6"), "3600 s at most"),
        ((*HCP2, "--callers", "-1"), "--callers"),
        ((*HCP2, "--callers", "1001"), "--callers"),
        ((*HCP2, "--every", "0"), "a time must be above 0"),
        ((*HCP2, "--period", "-1"), "a time must be above 0"),
        ((*HCP2, "--priorities", "hurry"), "no such priority 'hurry'"),
        ((*HCP2, "--priorities", "urgent=x"), "a share is a whole number"),
        ((*HCP2, "--priorities", "urgent=0"), "one of them is above 0"),
        ((*HCP2, "--items", "nothing"), "nothing"),
        ((*HCP2, "--fault", "rain=1"), "no such fault"),
        ((*HCP2, "--reply-delay", "x"), "a reply delay"),
        ((*HCP2, "--budget", "p98=1"), "a budget is written like"),
        ((*HCP2, "--budget", "urgent.p99=1"), "nothing measured has the name 'urgent'"),
        ((*HCP2, "--budget", "cycle.p99=1"), "nothing measured has the name 'cycle'"),
        ((*HCP2, "--budget", "7.p99=1"), "nothing measured has the name '7'"),
        ((*HCP2, "--budget", "p99=2x"), "needs --compare"),
        ((*HCP2, "--echo"), "--echo needs a PORT"),
        ((*HCP2, "--address-step", "2"), "is only for msc"),
        (("/dev/x", *HCP2), "hcp2 needs a node"),
        (("/dev/x", *HCP2, "--nodes", "1", "--virtual"), "--virtual needs an emulated line"),
        (("/dev/x", *HCP2, "--nodes", "1", "--fault", "lost=1"), "--fault needs an emulated line"),
        (("/dev/x", *HCP2, "--nodes", "1", "--reply-delay", "2"), "--reply-delay needs an emulated line"),
        (("unix:/x", *HCP2, "--nodes", "1"), "is a line of another program"),
        (("--compare", "a.json", "b.json", *HCP2), "--compare does not measure; leave out"),
        (("--compare", "a.json"), "compare"),
    ],
)
def test_bad_arguments_are_wrong_usage_and_nothing_is_opened(
    busmaster: Command, arguments: tuple[str, ...], complaint: str
) -> None:
    done = busmaster("bench", *arguments)
    assert (done.status, done.out) == (2, "")
    assert complaint in done.err
    assert "measuring" not in done.err


@pytest.mark.slow
def test_a_plot_is_drawn_after_what_is_printed(busmaster: Command, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    path = tmp_path / "latency.png"
    done = busmaster(*VIRTUAL, "--plot", str(path))
    assert (done.status, done.err) == (0, "")
    assert path.read_bytes().startswith(b"\x89PNG")
    refused = busmaster(*VIRTUAL, "--plot", "latency.xyz")
    assert (refused.status, refused.out) == (2, "")
