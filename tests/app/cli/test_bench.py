"""`busmaster bench`, as a person types it: emulated, on a real port, compared, and ended before its time."""

from __future__ import annotations

import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from busmaster import LEARNED, Bus, Priority
from busmaster.app.cli import bench
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.output import Level
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer, serve_tcp
from busmaster.errors import LineDown
from busmaster.registry import find, make_device
from busmaster.testing.bench import BenchReport, EmulatedLine, Workload
from busmaster.testing.latency_report import Times
from tests.app.cli.conftest import ENVIRONMENT, ROOT, Command, owner_here, started
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


# what the options define


def run_of(*arguments: str) -> bench.Run:
    """The measurement that a command line defines."""
    with bench.command.make_context("bench", [*HCP2, *arguments]) as context:
        return bench.Run(context.params)


@pytest.mark.parametrize(
    ("arguments", "workload"),
    [
        ((), {}),
        (("--seconds", "2.5"), {"seconds": 2.5}),
        (("--callers", "0"), {"callers": 0}),
        (("--callers", "3"), {"callers": 3}),
        (("--every", "0.5"), {"every": 0.5}),
        (("--period", "0.25"), {"period": 0.25}),
        (("--items", "7,outputs"), {"items": ("7", "outputs")}),
        (("--seed", "9"), {"seed": 9}),
        (
            ("--priorities", "command=2,urgent=1"),
            {"priorities": {Priority.COMMAND: 2, Priority.URGENT: 1}},
        ),
    ],
)
def test_each_option_of_the_load_defines_it(arguments: tuple[str, ...], workload: dict[str, Any]) -> None:
    assert run_of(*arguments).workload == Workload(**workload)


def test_each_option_of_a_port_reaches_the_bus_and_its_nodes() -> None:
    options = ("--baud", "9600", "--echo", "--timeout", "250", "--retries", "0")
    run = run_of("/dev/ttyS0", "--nodes", "2,5", *options)
    assert (run.addresses, run.connection.retries) == ((2, 5), 0)
    assert (run.connection.baud, run.connection.echo, run.connection.timeout) == (9600, True, 0.25)
    assert run_of("--timeout", "learned").connection.timeout is LEARNED
    with bench.command.make_context("bench", ["--protocol", "msc", "--address-step", "4"]) as context:
        assert bench.Run(context.params).connection.options == {"address_step": 4}


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ((), EmulatedLine("hcp2")),
        (("--nodes", "3,1"), EmulatedLine("hcp2", (3, 1))),
        (("--baud", "9600"), EmulatedLine("hcp2", baudrate=9600)),
        (("--reply-delay", "5"), EmulatedLine("hcp2", delay=(0.005, 0.005))),
        (("--reply-delay", "5-9"), EmulatedLine("hcp2", delay=(0.005, 0.009))),
        (("--fault", "lost=0.1", "--fault", "slow=2"), EmulatedLine("hcp2", faults=("lost=0.1", "slow=2"))),
        (("--seed", "9"), EmulatedLine("hcp2", seed=9)),
    ],
)
def test_each_option_of_the_emulated_line_defines_it(
    monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], line: EmulatedLine
) -> None:
    made: list[EmulatedLine] = []

    def emulated(line: EmulatedLine, *_: object, **__: object) -> ExitStack:
        made.append(line)
        return ExitStack()

    monkeypatch.setattr(bench, "emulated", emulated)
    with ExitStack() as lines:
        run_of(*arguments)._measurement(lines)
    assert made == [line]


@pytest.mark.parametrize("virtual", [False, True])
def test_an_emulated_line_has_the_load_the_clock_and_the_handles_of_the_options(
    monkeypatch: pytest.MonkeyPatch, virtual: bool
) -> None:
    given: list[tuple[Workload, dict[str, Any]]] = []

    def emulated(line: EmulatedLine, workload: Workload, **options: Any) -> ExitStack:
        given.append((workload, options))
        return ExitStack()

    monkeypatch.setattr(bench, "emulated", emulated)
    run = run_of("--callers", "3", "--retries", "0", "--timeout", "250", *["--virtual"] * virtual)
    with ExitStack() as lines:
        run._measurement(lines)
    assert given == [(run.workload, {"virtual": virtual, "handle": run.connection.open_handle})]


def test_the_seed_is_that_of_a_bus_on_a_port_too(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[Any] = []

    def bus(*arguments: Any, **options: Any) -> Bus:
        seeds.append(options["seed"])
        return Bus(*arguments, **options)

    monkeypatch.setattr(bench, "Bus", bus)
    for seed in ((), ("--seed", "9")):
        with ExitStack() as lines:
            run_of("/dev/ttyS0", "--nodes", "1", *seed)._measurement(lines)
    assert seeds == [1, 9]


# budgets


def test_each_budget_that_is_exceeded_is_a_line(busmaster: Command) -> None:
    ran = busmaster(*VIRTUAL, "--budget", "p50=1", "--budget", "max=1", "--budget", "p99=20")
    assert (ran.status, len(ran.err.splitlines())) == (1, 2)
    assert "busmaster: measuring" not in ran.err
    wrong = busmaster(*VIRTUAL, "--budget", "p99=20", "--budget", "p99=2x")
    assert wrong.status == 2
    cycles = ("--period", "0.5", "--priorities", "urgent=1", "--budget", "cycle.p99=90", "--budget", "urgent.max=20")
    assert busmaster(*VIRTUAL, *cycles).status == 0


def test_no_value_is_a_failure_though_no_budget_is_exceeded(busmaster: Command) -> None:
    ran = busmaster(*VIRTUAL, "--fault", "dead=1", "--budget", "missed=0")
    assert ran.status == 1
    assert ran.err == "busmaster: no value was received; check the port, the protocol and the nodes\n"


def test_budgets_that_are_exceeded_and_no_value_are_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    notes: list[tuple[str, Level]] = []
    monkeypatch.setattr(bench, "note", lambda text, level=Level.INFO: notes.append((text, level)))
    assert bench.print_excess([]) == 0
    assert run_of("--budget", "missed=5")._status(dataclasses.replace(REPORT, values=0)) == 1
    assert [(text.partition(":")[0], level) for text, level in notes] == [
        ("budget exceeded", Level.ERROR),
        ("no value was received; check the port, the protocol and the nodes", Level.ERROR),
    ]


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
    assert done.err == "busmaster: measuring for 0.3 s; Ctrl-C ends it and prints the result so far\n"
    assert report.line["protocol"] == "hcp2"
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


def test_a_port_that_another_program_owns_is_not_measured(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    with owner_here(file):
        done = busmaster("bench", three_controllers.path, *HCP2, "--nodes", "1", "--seconds", "1")
    assert (done.status, done.out) == (1, "")
    assert f"is owned by process {os.getpid()}; stop that process first" in done.err


@pytest.mark.parametrize("error", [KeyboardInterrupt(), LineDown("port lost", hint="plug it in")])
def test_a_measurement_that_does_not_end_by_itself_prints_the_result_so_far(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def ended(*arguments: Any, **options: Any) -> None:
        until_ended(*arguments, **options)
        raise error

    monkeypatch.setattr(bench, "until_ended", ended)
    done = busmaster(*VIRTUAL, "--json", "--budget", "p50=1")
    assert BenchReport.from_json(done.out).values > 0
    interrupted = isinstance(error, KeyboardInterrupt)
    assert (done.status, done.err) == ((130, "") if interrupted else (1, "busmaster: port lost; plug it in\n"))


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


TIMES = Times(4, 0.0025, {"p50": 0.001, "p90": 0.002, "p99": 0.003, "p99.9": 0.004, "max": 0.005})
HALF = Times(2, 0.00125, {"p50": 0.0005, "p90": 0.001, "p99": 0.0015, "p99.9": 0.002, "max": 0.0025})
REPORT = BenchReport(
    line={
        "protocol": "hcp2",
        "baudrate": 57600,
        "framing": "8N1",
        "virtual": True,
        "reply_delay": [0.001, 0.009],
        "faults": ["lost=0.1", "slow=2"],
    },
    workload={**Workload(callers=1, every=0.5, period=0.25, seed=7).fields(), "nodes": [3]},
    elapsed=2.0,
    values=30,
    limit=60.0,
    share=0.25,
    total=TIMES,
    nodes={"3": HALF},
    priorities={"command": TIMES},
    calls={},
    cycles=Times(),
    missed=6,
    errors={"NoReply": 3, "LineDown": 2},
    histogram=((0.001, 1), (0.002, 100), (0.004, 0)),
)
OTHER = dataclasses.replace(
    REPORT,
    line={"protocol": "hcp2", "baudrate": 9600, "framing": "8N1", "port": "COM1"},
    workload={**Workload(callers=0).fields(), "nodes": [3, 4]},
    elapsed=1.0,
    share=0.5,
    total=HALF,
    nodes={"3": TIMES, "4": TIMES},
    missed=9,
    errors={"NoReply": 8},
)


def test_the_page_has_each_figure_in_its_unit() -> None:
    assert list(bench.page(REPORT)) == [
        "hcp2, 1 node, 57600 baud 8N1, replies after 1 to 9 ms, faults lost=0.1 slow=2, emulated in virtual time",
        "1 caller, each once in 0.5 s (command 1); a poll group every 0.25 s; seed 7",
        "LATENCY, ms  COUNT  MEAN   p50   p90   p99  p99.9   max",
        "node 3           2  1.25  0.50  1.00  1.50   2.00  2.50",
        "total            4  2.50  1.00  2.00  3.00   4.00  5.00",
        "poll cycles      0     -     -     -     -      -     -",
        f"to      1.00 ms  {'#':40}  1",
        f"to      2.00 ms  {'#' * 40}  100",
        f"to      4.00 ms  {'':40}  0",
        "30 values in 2.00 s: 15.0 a second, 25.0% of the wire's limit of 60.0",
        "missed cycles: 6; errors: NoReply 3, LineDown 2",
    ]


def test_the_page_names_port_callers_and_priorities_of_another_load() -> None:
    assert bench.head(OTHER) == "hcp2, 2 nodes, 9600 baud 8N1, on COM1"
    assert bench.work(OTHER) == "0 callers, each without pauses (command 1); no poll group; seed 1"
    default = dataclasses.replace(OTHER, workload={**Workload().fields(), "nodes": [3, 4]})
    assert bench.work(default).startswith("2 callers, ")
    assert [name for name, _ in bench.distributions(OTHER)] == ["node 3", "node 4", "total"]
    two = dataclasses.replace(OTHER, priorities={"urgent": HALF, "command": TIMES})
    assert [name for name, _ in bench.distributions(two)] == ["node 3", "node 4", "urgent", "command", "total"]
    line = {**REPORT.line, "reply_delay": [0.002, 0.002], "faults": [], "virtual": False}
    assert bench.head(dataclasses.replace(REPORT, line=line)).endswith(
        ", replies after 2 ms, emulated on a pseudo-terminal"
    )


def test_a_comparison_has_each_figure_of_both_reports(busmaster: Command, tmp_path: Path) -> None:
    for name, report in (("a", REPORT), ("b", OTHER)):
        (tmp_path / name).write_text(report.to_json())
    paths = str(tmp_path / "a"), str(tmp_path / "b")
    done = busmaster("bench", "--compare", *paths)
    assert (done.status, done.err) == (0, "")
    assert done.lines[:3] == [
        f"A: {bench.head(REPORT)}",
        f"B: {bench.head(OTHER)}",
        "the workloads differ: callers, every, period, seed, nodes",
    ]
    ratios = {tuple(line.split("  ")[0].split()): line.split()[-1] for line in done.lines[4:-4]}
    assert ratios == {("total",): "0.50", ("node", "3"): "2.00", ("command",): "1.00"}
    assert done.lines[-4:] == [
        "values a second: A 15.0, B 30.0",
        "share of the wire's limit: A 25.0%, B 50.0%",
        "missed cycles: A 6, B 9",
        "errors: A 5, B 8",
    ]
    fields = json.loads(busmaster("bench", "--compare", *paths, "--json", "--budget", "missed=20").out)
    assert {name: figures["max"] for name, figures in fields.pop("ratios").items()} == {
        "total": 0.5,
        "3": 2.0,
        "command": 1.0,
    }
    assert fields == {
        "rate": [15.0, 30.0],
        "share": [0.25, 0.5],
        "missed": [6, 9],
        "errors": [5, 8],
        "same_workload": False,
    }
    wrong = busmaster("bench", "--compare", *paths, "--budget", "max=1000", "--budget", "9.p99=1")
    assert (wrong.status, wrong.out) == (2, ""), "nothing is printed but the error"
    same = json.loads(busmaster("bench", "--compare", paths[0], paths[0], "--json").out)
    assert same["same_workload"] is True


def test_a_figure_that_cannot_be_compared_is_a_dash() -> None:
    [total] = [line for line in bench.comparison(REPORT, OTHER, {"": {"p90": 2.0}}) if line.startswith("total")]
    assert total.split() == ["total", "-", "2.00", "-", "-", "-"]


def test_a_comparison_that_exceeds_a_budget_is_a_failure_in_json_too(
    busmaster: Command, reports: tuple[str, str]
) -> None:
    done = busmaster("bench", "--compare", *reports, "--json", "--budget", "p50=1.5x", "--budget", "max=1.5x")
    assert (done.status, len(done.err.splitlines())) == (1, 2)
    assert json.loads(done.out)


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
        ((*HCP2, "--budget", "p99=20", "--budget", "7.p99=1"), "nothing measured has the name '7'"),
        ((*HCP2, "--address-step", "2"), "is only for msc"),
        (("/dev/x", *HCP2), "hcp2 needs a node"),
        (("/dev/x", *HCP2, "--nodes", "1", "--virtual"), "--virtual needs an emulated line"),
        (("/dev/x", *HCP2, "--nodes", "1", "--fault", "lost=1"), "--fault needs an emulated line"),
        (("/dev/x", *HCP2, "--nodes", "1", "--reply-delay", "2"), "--reply-delay needs an emulated line"),
        (("unix:/x", *HCP2, "--nodes", "1"), "is a line of another program"),
        (("--compare", "a.json", "b.json", *HCP2), "--compare does not measure; leave out protocol"),
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
@pytest.mark.parametrize("form", [(), ("--json",)])
def test_a_plot_is_drawn_whatever_the_form_of_the_report(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, form: tuple[str, ...]
) -> None:
    drawn: list[tuple[int, str]] = []
    monkeypatch.setattr(bench, "check_plot", lambda path: None)
    monkeypatch.setattr(bench, "plot", lambda report, path: drawn.append((report.values, path)))
    done = busmaster(*VIRTUAL, "--plot", "latency.png", *form)
    assert (done.status, done.err) == (0, "")
    [(values, path)] = drawn
    assert str(values) in done.out
    assert path == "latency.png"


@pytest.mark.slow
def test_a_plot_is_drawn_after_what_is_printed(busmaster: Command, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    path = tmp_path / "latency.png"
    done = busmaster(*VIRTUAL, "--plot", str(path))
    assert (done.status, done.err) == (0, "")
    assert path.read_bytes().startswith(b"\x89PNG")
    refused = busmaster(*VIRTUAL, "--plot", "latency.xyz")
    assert (refused.status, refused.out) == (2, "")
