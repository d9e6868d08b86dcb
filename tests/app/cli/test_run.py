"""run, plan and emulate with a LINE.toml."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import sqlite3
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import takewhile
from pathlib import Path

import pytest

from busmaster.app.cli.plan import time_text
from busmaster.app.cli.run import output_text
from busmaster.app.outputs.base import OutputStatistics
from busmaster.capture.pcapng import read_packets
from busmaster.emulator.line import Line
from busmaster.emulator.serve import PtyServer, TcpServer, serve_pty
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import make_device
from tests.app.cli.conftest import ROOT, Command, ended_once, started
from tests.patience import PATIENCE

EXAMPLES = ROOT / "examples"
TEXT = """timing = "learned"
title = "Slitter"
port = "PORT"
[nodes.winder]
protocol = "hcp2"
address = 1
points.force = { item = "10", unit = "N", factor = 0.1 }
[nodes.drive2-3]
protocol = "hcp2"
address = "2-3"
[groups.fast]
period = 0.02
points = ["winder/force", "drive2-3/1"]
[groups.slow]
period = 0.1
points = ["winder/axis0.idle"]
"""
SQLITE = '[outputs.sqlite]\npath = "FOLDER/x.db"\n'


@pytest.fixture
def line(tmp_path: Path, controllers: TcpServer) -> Path:
    """On the controllers that are served, with a database."""
    path = tmp_path / "line.toml"
    path.write_text((TEXT + SQLITE).replace("PORT", controllers.path).replace("FOLDER", str(tmp_path)))
    return path


def has_items(*items: str) -> Callable[[list[str]], bool]:
    """Whether the plain lines have a value of each."""
    return lambda lines: {line.split()[1] for line in lines} >= set(items)


@pytest.mark.slow
def test_run_prints_a_line_a_value_and_a_summary_of_groups_nodes_and_outputs(line: Path, tmp_path: Path) -> None:
    items = ("winder/force", "drive2/1", "drive3/1", "winder/axis0.idle")
    ran = ended_once(has_items(*items), "run", str(line), "--plain")
    assert ran.status == 130
    values = {words[1]: words[2] for words in map(str.split, ran.lines)}
    assert values.keys() == set(items)
    assert values["winder/axis0.idle"] == "1"
    unsafe, *summary = ran.err.splitlines()
    assert "no safe state" in unsafe
    assert [text.split()[1] for text in summary] == ["fast:", "slow:", "winder:", "drive2:", "drive3:", "sqlite:"]
    assert summary[-1].endswith(" written, 0 dropped")
    with closing(sqlite3.connect(tmp_path / "x.db")) as database:
        [found] = database.execute("select count(distinct node || '/' || item) from history").fetchone()
    assert found == 4


def test_what_an_output_was_spared_is_told_apart_from_what_it_lost() -> None:
    counts = OutputStatistics("csv", "written", 3, 1, 0, "", suppressed=5)
    assert output_text(counts) == "csv: 3 written, 1 dropped, 5 suppressed"


def test_run_says_that_a_file_without_groups_polls_nothing(busmaster: Command, line: Path) -> None:
    line.write_text(line.read_text().partition("[groups")[0])
    ran = busmaster("run", str(line), "--seconds", "0.1", "--plain")
    assert (ran.status, ran.out) == (0, "")
    assert "nothing is polled, because the file has no poll group; add [groups.NAME]" in ran.err


def test_run_as_json_is_a_line_a_cycle_under_the_files_names(line: Path) -> None:
    ran = ended_once(lambda lines: sum('"fast"' in cycle for cycle in lines) == 3, "run", str(line), "--json")
    cycles = [cycle for cycle in map(json.loads, ran.lines) if cycle["group"] == "fast"]
    assert [cycle["cycle"] for cycle in cycles] == list(range(1, len(cycles) + 1))
    assert cycles[0]["samples"].keys() == {"winder/force", "drive2/1", "drive3/1"}
    assert cycles[0]["samples"]["drive2/1"].keys() == {"value", "quality", "error", "late"}


PLUG_IT_IN = "plug it in or start its emulator, or see `python -m serial.tools.list_ports`"
SPARED = "busmaster: if 1% of all frames are lost, the schedule needs "
UNLEARNED = TEXT.replace('timing = "learned"', "")
FEW = UNLEARNED.replace("period = 0.02", "period = 60").replace("period = 0.1", "period = 60")


@pytest.mark.slow
@pytest.mark.parametrize(("text", "times"), [(TEXT, 0), (UNLEARNED, 1), (FEW, 0)], ids=["learned", "not", "for little"])
def test_run_says_once_what_learned_reply_times_would_spare(
    line: Path, controllers: TcpServer, text: str, times: int
) -> None:
    line.write_text(text.replace("PORT", controllers.path))
    ran = ended_once(lambda lines: len(lines) > 12 if times else bool(lines), "run", str(line), "--plain")
    assert ran.err.count(SPARED) == times


@pytest.mark.slow
def test_run_takes_another_port_and_records_the_line(line: Path, controllers: TcpServer) -> None:
    line.write_text(line.read_text().replace(controllers.path, "socket://127.0.0.1:1"))
    capture = line.parent / "x.pcapng"
    options = ("--plain", "--port", controllers.path, "--capture", str(capture))
    assert ended_once(lambda lines: len(lines) > 3, "run", str(line), *options).status == 130
    with open(capture, "rb") as file:
        assert sum(1 for _ in read_packets(file)) > 4


def test_run_on_a_port_that_is_not_there_says_why_once_and_waits(line: Path) -> None:
    with started("run", str(line), "--port", "socket://127.0.0.1:1") as process:
        assert process.stderr is not None
        said = "".join(takewhile(lambda text: "cannot connect" not in text, process.stderr))
        process.terminate()
        _, rest = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0
    assert "cannot connect" not in said + rest


@pytest.mark.slow
def test_an_output_that_is_down_is_said_and_the_line_runs_on(line: Path, tmp_path: Path) -> None:
    (tmp_path / "x.db").mkdir()
    with started("run", str(line), "--plain") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        said = [process.stderr.readline() for _ in range(2)]
        assert process.stdout.readline()
        process.terminate()
        said += process.stderr.readlines()
    assert process.returncode == 0
    assert said[1] == f"busmaster: sqlite is down: {tmp_path}/x.db: Is a directory\n"
    assert said[-1].startswith("busmaster: sqlite: 0 written, ")
    assert said[-1].endswith(f"dropped, down: {tmp_path}/x.db: Is a directory\n")


@pytest.mark.parametrize("command", ["run", "plan", "emulate"])
def test_a_file_that_is_wrong_is_one_line_that_names_line_and_key_and_status_2(
    busmaster: Command, tmp_path: Path, command: str
) -> None:
    path = tmp_path / "line.toml"
    path.write_text(TEXT.replace("PORT", "socket://127.0.0.1:1").replace("winder/force", "winder/forse"))
    outcome = busmaster(command, str(path))
    assert (outcome.status, outcome.out) == (2, "")
    assert outcome.err == f"busmaster: {path}:13: groups.fast.points[1]: no such item 'forse'; did you mean 'force'?\n"
    missing = busmaster(command, str(tmp_path / "none.toml"))
    assert (missing.status, missing.out) == (2, "")
    assert "does not exist" in missing.err


@pytest.mark.parametrize("command", ["plan", "emulate"])
@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        (
            "period = 0.02",
            "period = 0",
            "12: groups.fast.period: poll group 'fast': a period is 0.001 to 86400 s, not 0",
        ),
        (
            "[groups.slow]",
            "[emulator.nodes.winder]\naxes = 9\n[groups.slow]",
            "14: emulator.nodes.winder: a controller",
        ),
    ],
)
def test_plan_finds_wrong_what_emulate_does_at_the_same_place(
    busmaster: Command, tmp_path: Path, command: str, before: str, after: str, complaint: str
) -> None:
    path = tmp_path / "line.toml"
    path.write_text(TEXT.replace("PORT", "socket://127.0.0.1:1").replace(before, after))
    outcome = busmaster(command, str(path))
    assert (outcome.status, outcome.out) == (2, "")
    assert outcome.err.startswith(f"busmaster: {path}:{complaint}")


def test_plan_says_that_a_schedule_fits(busmaster: Command, line: Path) -> None:
    text = (
        line.read_text()
        .replace("period = 0.02", "period = 0.5")
        .replace("[groups.slow]", "[groups.slow]\nphase = 0.05")
    )
    line.write_text(text)
    outcome = busmaster("plan", str(line))
    assert (outcome.status, outcome.err) == (0, "")
    assert outcome.lines[0].startswith("Slitter: 127.0.0.1:")
    assert [row.split()[0] for row in outcome.lines[1:4]] == ["GROUP", "fast", "slow"]
    assert outcome.lines[4].startswith("it fits: the schedule needs ")
    healthy, dead = re.findall(r"([\d.]+) ms", outcome.lines[5])
    assert float(healthy) < float(dead) < 200  # a maximum reply delay of HCP2, not a bound that no line comes near
    assert outcome.lines[6].startswith("worst case (R9), if every exchange takes its longest possible time: urgent ")
    assert outcome.lines[-2].startswith("reply times are assumed (half of late_after) for ")
    assert outcome.lines[-1].startswith("if 1% of all frames are lost, the schedule needs ")
    assert ' with timing = "learned" (a window of 39.5 ms)' in outcome.lines[-1]


@pytest.mark.parametrize(
    ("nodes", "named"), [(8, "d1, d2, d3, d4, d5, d6, d7, d8"), (11, "d1, d2, d3, d4, d5, d6, d7, d8 and 3 more")]
)
def test_plan_names_some_nodes_without_a_reply_time_and_counts_the_others(
    nodes: int, named: str, busmaster: Command, tmp_path: Path
) -> None:
    path = tmp_path / "line.toml"
    path.write_text(
        f'port = "/dev/ttyUSB0"\n[nodes.d1-{nodes}]\nprotocol = "hcp2"\naddress = "1-{nodes}"\n'
        '[groups.g]\nperiod = 5\npoints = ["d1/1"]\n'
    )
    outcome = busmaster("plan", str(path))
    assert outcome.lines[-2].startswith(f"reply times are assumed (half of late_after) for {named}; ")


def test_plan_says_what_would_fit_where_it_does_not_and_ends_with_1(busmaster: Command, line: Path) -> None:
    outcome = busmaster("plan", str(line))
    assert (outcome.status, outcome.err) == (1, "")
    assert "it does not fit:" in outcome.lines
    assert any("group 'fast' will miss" in text for text in outcome.lines)
    plan = json.loads(busmaster("plan", str(line), "--json").out)
    assert plan["fits"] is False
    assert [group["group"] for group in plan["groups"]] == ["fast", "slow"]
    assert plan["groups"][0]["values"] == 3
    assert plan["typical_wait"] < plan["dead_wait"] < plan["worst_waits"]["urgent"]
    assert plan["worst_waits"].keys() == {"urgent", "command", "poll", "background"}
    assert plan["utilisation"] < plan["losses"]["learned_utilisation"] < plan["losses"]["utilisation"]


@contextmanager
def emulated(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`busmaster emulate` as a process, and where it says that it listens."""
    with started("emulate", *arguments) as process:
        assert process.stdout is not None
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


@pytest.mark.slow
def test_emulate_serves_a_file_where_run_looks_for_it(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    link = tmp_path / "tty"
    path.write_text(TEXT.replace("PORT", str(link)))
    with emulated(str(path)) as (process, where):
        assert where == str(link)
        ran = ended_once(lambda lines: len(lines) > 3, "run", str(path), "--json")
        assert ran.status == 130
        assert all(sample["error"] is None for text in ran.lines for sample in json.loads(text)["samples"].values())
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 130
    assert not os.path.lexists(link)


@pytest.mark.slow
def test_emulate_puts_no_link_under_dev_and_goes_where_it_is_told(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    for port in ("/dev/ttyUSB99", "usb:A500ABC"):
        path.write_text(TEXT.replace("PORT", port))
        with emulated(str(path), "--fault", "dead=1", "--paced") as (_, where):
            assert where.startswith("/dev/pts/")
    with emulated(str(path), "--tcp", "127.0.0.1:0") as (_, where):
        assert where.startswith("socket://127.0.0.1:")


def test_what_the_file_says_is_not_said_again(busmaster: Command, line: Path) -> None:
    outcome = busmaster("emulate", str(line), "--protocol", "hcp2")
    assert (outcome.status, outcome.out) == (2, "")
    assert "the file defines protocol, nodes and baud rate; leave out the options for these" in outcome.err
    assert "--protocol P" in busmaster("emulate").err


def test_ctrl_c_ends_a_run_with_its_summary_and_everything_written(line: Path, tmp_path: Path) -> None:
    with started("run", str(line), "--json") as process:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["cycle"] == 1
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "Traceback" not in err
    assert err.splitlines()[-1].endswith(" written, 0 dropped")


@pytest.mark.slow
def test_r13_a_lost_port_and_why_it_does_not_come_back_are_told_on_standard_error(tmp_path: Path) -> None:
    path, link = tmp_path / "line.toml", tmp_path / "tty"
    path.write_text(TEXT.replace("PORT", str(link)))

    def served() -> PtyServer:
        devices = [make_device("hcp2", address) for address in (1, 2, 3)]
        return serve_pty(Line(hcp2.PROFILE.line, devices, chance=random.Random(1), paced=False), link)

    server = served()
    with started("run", str(path), "--plain") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        of_the_line = (line for line in process.stderr if "the line is " in line or "cannot connect" in line)
        server.close()
        told = [next(of_the_line) for _ in range(2)]
        with served():
            told.append(next(of_the_line))
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=PATIENCE)
    assert told == [
        f"busmaster: the line is down: {link} was lost: it hung up\n",
        f"busmaster: cannot connect: {link} does not exist; {PLUG_IT_IN}\n",
        "busmaster: the line is up\n",
    ]
    assert process.returncode == 130
    assert "cannot connect" not in err


@pytest.mark.slow
def test_the_example_runs_on_its_own_emulation(tmp_path: Path) -> None:
    """As a newcomer types it; the database is where it was started."""
    example = str(EXAMPLES / "line.toml")
    with emulated(example, "--tcp", "127.0.0.1:0") as (_, where):
        nodes = {"winder", "unwinder", *(f"drive{number}" for number in range(4, 8))}

        def seen(lines: list[str]) -> bool:
            found = {line.split()[1].partition("/")[0] for line in lines}
            assert found <= nodes
            return found == nodes

        ran = ended_once(seen, "run", example, "--port", f"{where}?baudrate=57600", cwd=tmp_path)
    assert ran.status == 130
    assert "axes: " in ran.err
    assert (tmp_path / "line.sqlite").exists()


def test_plan_prints_what_programs_can_take_of_a_line_whose_file_has_roles(busmaster: Command, line: Path) -> None:
    assert "programs of a role" not in busmaster("plan", str(line)).out
    line.write_text(line.read_text() + '\n[service.users.root]\nrole = "read"\n')
    text = next(text for text in busmaster("plan", str(line)).lines if "programs of a role" in text)
    assert "read 3%, write 50%; a safe write" in text
    fields = json.loads(busmaster("plan", str(line), "--json").out)
    assert fields["role_parts"] == {"read": 1 / 32, "write": 0.5}
    urgent = fields["worst_waits"]["urgent"]  # of the owner: the exchange on the wire
    # R9: each other program may go before it twice, and three further exchanges before each of those and itself (R15).
    assert fields["program_waits"] == {
        str(clients): pytest.approx(urgent * (1 + 4 * 2 * clients)) for clients in (1, 8, 64)
    }
    [text] = [text for text in busmaster("plan", str(line)).lines if "urgent write of a program" in text]
    assert f"{time_text(urgent * 9)} with 1, " in text
    assert text.endswith(f"{time_text(urgent * 513)} with 64")
