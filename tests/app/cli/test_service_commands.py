"""A line that one process runs and others use: run, serve, read, write, status, and a program with `connect`."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from busmaster import Hcp2Controller, connect
from busmaster.app.service.folder import find_owner
from busmaster.emulator.serve import TcpServer
from tests.app.cli.conftest import ENVIRONMENT, ROOT, Command, ended_once, owner, serve, started
from tests.patience import PATIENCE

HCP2 = ("--protocol", "hcp2")


def audit(folder: Path) -> list[tuple[Any, ...]]:
    """Interface, point, value and outcome of each write that is on record."""
    with closing(sqlite3.connect(folder / "line.sqlite", timeout=10)) as database:
        return database.execute("select interface, point, value, outcome from audit order by time").fetchall()


@pytest.mark.slow
def test_three_programs_use_one_line_at_once(busmaster: Command, file: Path, three_controllers: TcpServer) -> None:
    with owner("serve", str(file)) as (process, address):
        ran = busmaster("write", three_controllers.path, *HCP2, "--node", "2", "1=123.456", "--verify")
        assert (ran.status, ran.out) == (0, "1 ok\n")
        port = three_controllers.path.removeprefix("socket://")
        assert ran.err == (f"busmaster: {port} is owned by process {process.pid}; using it through {address}\n")
        ran = busmaster("read", address, *HCP2, "--node", "2", "1")
        assert (ran.status, ran.out, ran.err) == (0, "1 123.456\n", "")
        ran = busmaster("read", three_controllers.path.replace("127.0.0.1", "localhost"), *HCP2, "--node", "2", "1")
        assert (ran.status, ran.out) == (0, "1 123.456\n")
        assert "is owned by process" in ran.err

        async def program() -> None:
            async with connect("slitter") as remote:
                controller = Hcp2Controller(remote, 1)
                await controller.point("10").write(30)
                async for snapshot in remote.group("fast"):
                    [(point, sample)] = snapshot.items()
                    assert point.key == "winder/force"  # as the owner's file calls it
                    if sample.value == 3.0:
                        break

        asyncio.run(asyncio.wait_for(program(), PATIENCE))
        ran = busmaster("write", three_controllers.path, *HCP2, "--node", "1", "10=501")
        assert ran.status == 2
        assert "50" in ran.err
        process.terminate()
        assert process.wait(PATIENCE) == 0
    assert audit(file.parent) == [
        ("service", "2/raw command", "'write element 1 = 123.456'", "written"),
        ("service", "winder/force", 3.0, "written"),
        ("service", "winder/force", 50.1, "refused"),
    ]


@pytest.mark.slow
def test_the_owner_of_a_line_that_is_read_only_takes_no_writes_of_programs(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    with owner("serve", str(file), "--read-only") as (_, address):
        ran = busmaster("write", address, *HCP2, "--node", "2", "1=123.456")
        assert ran.status != 0
        assert "read-only" in ran.err
        ran = busmaster("read", address, *HCP2, "--node", "2", "1")
        assert (ran.status, ran.out) == (0, "1 0\n")


@pytest.mark.slow
def test_run_too_takes_no_writes_of_programs_if_it_is_read_only(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    with started("run", str(file), "--plain", "--read-only") as process:
        end = time.monotonic() + PATIENCE
        while (found := find_owner(three_controllers.path)) is None:
            assert time.monotonic() < end
            time.sleep(0.05)
        ran = busmaster("write", found.address, *HCP2, "--node", "2", "1=123.456")
        assert ran.status != 0
        assert "read-only" in ran.err
        process.terminate()
        assert process.wait(PATIENCE) == 0


@pytest.mark.slow
def test_points_of_a_file_are_read_by_name_and_in_their_unit_with_and_without_an_owner(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    ran = busmaster("write", str(file), "winder/force=3")
    assert ran.status == 0
    ran = busmaster("read", str(file), "winder/force", "winder/10")
    assert (ran.status, ran.lines) == (0, ["winder/force 3", "winder/10 30"])
    with owner("serve", str(file)) as (process, _):
        ran = busmaster("read", str(file), "winder/force", "--json")
        assert ran.status == 0
        assert f"is owned by process {process.pid}" in ran.err
        read = json.loads(ran.out)
        assert (read["point"], read["value"]) == ("winder/force", 3.0)
        ran = busmaster("read", str(file), "winder/force", "nowhere/1")
        assert (ran.status, ran.out) == (2, ""), "all are checked before the first is read"
        assert "no such point 'nowhere/1'" in ran.err


@pytest.mark.slow
def test_options_that_differ_from_the_owners_are_wrong_usage(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    with owner("serve", str(file)):
        for options, complaint in (
            (("--baud", "9600"), "not 9600 baud"),
            (("--echo",), "not with an echo"),
            (("--capture", "x.pcapng"), "leave out --capture, and record it there"),
        ):
            ran = busmaster("read", three_controllers.path, *HCP2, *options, "--node", "2", "1")
            assert (ran.status, ran.out) == (2, "")
            assert complaint in ran.err
        ran = busmaster("read", f"{three_controllers.path}?baudrate=9600", *HCP2, "--node", "2", "1")
        assert ran.status == 2
        ran = busmaster("read", three_controllers.path, *HCP2, "--baud", "57600", "--node", "2", "1")
        assert ran.status == 0


def test_run_serves_its_line_and_status_lists_it(busmaster: Command, file: Path, three_controllers: TcpServer) -> None:
    port = three_controllers.path.removeprefix("socket://")
    assert (
        busmaster("status").err == "busmaster: no running line of this user; start one with: busmaster run LINE.toml\n"
    )
    with started("run", "--plain", str(file)) as process:
        assert process.stdout is not None
        process.stdout.readline()  # it polls, and so is served
        ran = busmaster("status", "--json")
        said = json.loads(ran.out)
        assert (said["name"], said["port"], said["process"]) == ("slitter", port, process.pid)
        assert (said["programs"], said["nodes"], said["error"]) == (0, 1, None)
        while not json.loads(busmaster("status", "--json").out)["up"]:
            pass
        assert busmaster("status").lines[1].split()[:4] == ["slitter", port, str(process.pid), "0"]
        three_controllers.close()
        while (said := json.loads(busmaster("status", "--json").out))["state"] != "offline":
            pass
        assert (said["up"], said["nodes"]) == (0, 1)
        assert busmaster("status").lines[1].split()[4:] == ["offline", "0/1"]
        process.terminate()
        process.communicate(timeout=PATIENCE)
    assert busmaster("status").out == ""


@pytest.mark.slow
def test_a_line_whose_file_says_so_is_served_to_nobody(busmaster: Command, file: Path) -> None:
    file.write_text(file.read_text() + "[service]\nenabled = false\n")
    with started("run", "--plain", str(file)) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert busmaster("status").out == ""
        process.terminate()
        process.communicate(timeout=PATIENCE)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "serve"])
def test_a_second_master_on_a_line_that_is_owned_is_refused(file: Path, command: str) -> None:
    with owner("serve", str(file)) as (process, _):
        ran = subprocess.run(
            [sys.executable, "-m", "busmaster", command, str(file)],
            check=False,
            cwd=ROOT,
            env=ENVIRONMENT,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
        )
    assert ran.returncode == 1
    assert (
        f"is owned by process {process.pid}; stop that process first: two masters on one line garble each other"
        in ran.stderr
    )


@pytest.mark.slow
def test_a_second_process_for_the_same_name_says_whose_it_is_and_runs_all_the_same(file: Path) -> None:
    with owner("serve", str(file)) as (process, _), serve("hcp2", 1) as other:
        ran = subprocess.run(
            [sys.executable, "-m", "busmaster", "serve", str(file), "--port", other.path, "--seconds", "0.1"],
            check=True,
            cwd=ROOT,
            env=ENVIRONMENT,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
        )
    assert "no other program can use this line: " in ran.stderr
    assert f"is already served by process {process.pid}" in ran.stderr


@pytest.mark.slow
@pytest.mark.parametrize("missing", ["msgspec", "websockets"])
def test_where_the_extra_is_not_installed_a_line_runs_and_says_what_it_takes_to_share_it(
    file: Path, tmp_path: Path, missing: str
) -> None:
    (tmp_path / f"{missing}.py").write_text("raise ImportError")
    ran = subprocess.run(
        [sys.executable, "-m", "busmaster", "run", str(file), "--plain", "--seconds", "0.1"],
        check=True,
        cwd=ROOT,
        env={**ENVIRONMENT, "PYTHONPATH": f"{tmp_path}:{ROOT}"},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert ran.stderr.count("no other program can use this line: ") == 1
    assert "pip install 'busmaster[service]'" in ran.stderr


@pytest.mark.slow
def test_an_owner_that_was_killed_leaves_nothing_in_the_way(file: Path, three_controllers: TcpServer) -> None:
    with owner("serve", str(file)) as (process, first):
        process.send_signal(signal.SIGKILL)
        process.wait(PATIENCE)
        assert os.path.exists(first.removeprefix("unix:"))
        assert find_owner(three_controllers.path) is None
    with owner("serve", str(file)) as (_, again):
        assert again == first


PROGRAM = """
import asyncio
from busmaster import Hcp2Controller, connect

async def main():
    async with connect("ADDRESS") as remote:
        controller = Hcp2Controller(remote, 2)
        for number in range(1, 1_000_000):
            await controller.write(1, number)
            print(number, flush=True)

asyncio.run(main())
"""


@pytest.mark.slow
def test_the_audit_is_true_of_a_program_that_was_killed_as_it_wrote(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    with owner("serve", str(file)) as (process, address):
        code = PROGRAM.replace("ADDRESS", address)
        with subprocess.Popen(
            [sys.executable, "-c", code], env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
        ) as killed:
            assert killed.stdout is not None
            while int(killed.stdout.readline()) < 20:
                pass
            killed.kill()
        left = float(busmaster("read", address, *HCP2, "--node", "2", "1").out.split()[1])
        process.terminate()
        assert process.wait(PATIENCE) == 0
    rows = audit(file.parent)
    written = [row for row in rows if row[3] == "written"]
    may_be = [row for row in rows if row[3] != "not started"][len(written) - 1 :]
    assert len(written) >= 20
    assert all(row[3] == "written" for row in rows[: len(written)])  # but the last one
    assert f"'write element 1 = {left:g}'" in [row[2] for row in may_be]


def test_the_section_of_the_service_is_checked_with_its_line(busmaster: Command, file: Path) -> None:
    text = file.read_text()
    for said, complaint in (
        ('group = "no-such-group"', "the group 'no-such-group' does not exist on this machine"),
        ('mode = "rw"', "a mode must be octal"),
        ("port = 5020", "port"),
        ("share = 0.01", "must be 0.1 to 10, not 0.01"),
    ):
        file.write_text(f"{text}[service]\n{said}\n")
        ran = busmaster("plan", str(file))
        assert ran.status == 2
        assert complaint in ran.err
        assert "slitter.toml" in ran.err


# every command with a PORT


@pytest.mark.slow
def test_scan_and_poll_go_through_the_owner(busmaster: Command, file: Path, three_controllers: TcpServer) -> None:
    with owner("serve", str(file)) as (process, address):
        port = three_controllers.path.removeprefix("socket://")
        said = f"busmaster: {port} is owned by process {process.pid}; using it through {address}\n"
        ran = busmaster("scan", three_controllers.path, *HCP2, "--nodes", "2-4", "--timeout", "1000")
        assert (ran.status, [line.split()[0] for line in ran.lines]) == (0, ["2", "3"])
        assert ran.err.startswith(said)
        options = ("--nodes", "2,3", "--items", "1", "--period", "0.02")
        ran = ended_once(lambda lines: len(lines) >= 5, "poll", three_controllers.path, *HCP2, *options)
        assert ran.status == 130
        assert {line.split()[1] for line in ran.lines} == {"2/1", "3/1"}
        assert ran.err.startswith(said)
        assert re.search(r"poll: \d+ cycles, \d+ missed, period", ran.err)
        ran = ended_once(lambda lines: len(lines) >= 1, "poll", address, *HCP2, *options, "--json")
        cycle = json.loads(ran.lines[0])
        assert (cycle["group"], cycle["samples"]["2/1"]["value"]) == ("poll", 0)
        ran = busmaster("poll", address, *HCP2, *options, "--seconds", "0.05", "--json")
        # A busy machine may bring no value in that time, or one so late that it is counted and no longer told.
        assert ran.status == 0 or (ran.status == 1 and '"value": 0' not in ran.out)


@pytest.mark.slow
def test_a_poll_whose_owner_ends_says_so(file: Path, three_controllers: TcpServer) -> None:
    with (
        owner("serve", str(file)) as (process, address),
        started("poll", address, *HCP2, "--nodes", "2", "--items", "1", "--period", "0.02") as polling,
    ):
        assert polling.stdout is not None
        polling.stdout.readline()
        process.terminate()
        _, err = polling.communicate(timeout=PATIENCE)
        assert polling.returncode == 1
        assert "the program that owns the line has ended" in err


@pytest.mark.slow
def test_nothing_is_written_through_an_owner_unless_all_may_be(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    with owner("serve", str(file)) as (process, address):
        for refused in ("10=501", "300=1", "1=nothing"):
            ran = busmaster("write", address, *HCP2, "--node", "1", "1=5", refused, "2=6")
            assert (ran.status, ran.out) == (2, "")
        assert busmaster("read", address, *HCP2, "--node", "1", "1", "2").lines == ["1 0", "2 0"]
        ran = busmaster("write", address, *HCP2, "--node", "1", "1=5", "10=500", "2=6")
        assert ran.lines == ["1 ok", "10 ok", "2 ok"]
        process.terminate()
        process.wait(PATIENCE)
    assert [row[1:] for row in audit(file.parent)] == [
        ("winder/force", 50.1, "refused"),
        ("1/raw command", "'write element 1 = 5'", "written"),
        ("winder/force", 50.0, "written"),
        ("1/raw command", "'write element 2 = 6'", "written"),
    ]


def test_commands_that_need_a_port_of_their_own_say_so_of_a_line_that_is_served(busmaster: Command, file: Path) -> None:
    for command in (
        ("monitor", "unix:/run/line.sock", *HCP2),
        ("doctor", "tcp://127.0.0.1:7420", *HCP2),
        ("doctor", "unix:/run/line.sock"),
        ("run", str(file), "--port", "unix:/run/line.sock"),
    ):
        ran = busmaster(*command)
        assert (ran.status, ran.out) == (2, "")
        assert "is the address of a running line, for read, write, poll and scan" in ran.err
        assert ran.err.count("\n") == 1


# by TCP


@pytest.mark.slow
def test_commands_come_by_tcp_with_the_token_of_the_environment(
    busmaster: Command, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens = tmp_path / "slitter.tokens"
    tokens.write_text("hmi a-token-of-the-hmi-0001\nlogger a-token-of-the-logger-2\n")
    tokens.chmod(0o600)
    file.write_text(f"""{file.read_text()}
[service]
listen = "127.0.0.1:0"
token_file = "{tokens}"
tokens.hmi = {{ role = "write", allow_writes = ["winder/*"] }}
""")
    with owner("serve", str(file)) as (process, _):
        [line] = (line for line in (json.loads(text) for text in busmaster("status", "--json").lines))
        address = line["tcp"]
        assert address.startswith("tcp://127.0.0.1:")
        assert "requires a token" in busmaster("read", address, *HCP2, "--node", "2", "1").err
        monkeypatch.setenv("BUSMASTER_TOKEN", "a-token-of-the-logger-2")
        assert busmaster("read", address, *HCP2, "--node", "2", "1").out == "1 0\n"
        ran = busmaster("write", address, *HCP2, "--node", "1", "1=5")
        assert (ran.status, ran.out) == (2, "")
        assert "token logger may read this line, but not write" in ran.err
        monkeypatch.setenv("BUSMASTER_TOKEN", "a-token-of-the-hmi-0001")
        assert busmaster("write", address, *HCP2, "--node", "1", "1=5").out == "1 ok\n"
        ran = busmaster("write", address, *HCP2, "--node", "2", "1=5")
        assert (ran.status, ran.out) == (2, "")
        assert "token hmi may not write this; see allow_writes" in ran.err
        ran = busmaster("read", address, *HCP2, "--baud", "9600", "--node", "2", "1")
        assert (ran.status, ran.out) == (2, "")
        assert "not 9600 baud" in ran.err
        tokens.write_text("hmi another-token-0003\n")
        process.send_signal(signal.SIGHUP)
        assert process.stderr is not None
        while "was reloaded" not in process.stderr.readline():
            pass
        assert "does not accept this token" in busmaster("read", address, *HCP2, "--node", "2", "1").err


def test_tokens_that_others_may_read_keep_a_line_from_starting(busmaster: Command, file: Path, tmp_path: Path) -> None:
    tokens = tmp_path / "slitter.tokens"
    tokens.write_text("hmi a-token-of-the-hmi-0001\n")
    tokens.chmod(0o644)
    file.write_text(f'{file.read_text()}\n[service]\nlisten = "127.0.0.1:0"\ntoken_file = "{tokens}"\n')
    ran = busmaster("serve", str(file))
    assert ran.status == 2
    assert f"service.token_file: other users can read or change {tokens}; run chmod 600 {tokens}" in ran.err
    assert busmaster("plan", str(file)).status != 2  # no affair of those who only read the file


# the safe state

SAFE = '[safe]\nwithin = 2.0\nrepeatable = ["winder/force"]\nwrites = { "winder/force" = 1.5 }\n'


@pytest.mark.slow
def test_safe_has_the_owner_send_the_safe_state_and_the_line_goes_on(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    file.write_text(file.read_text() + SAFE)
    with owner("serve", str(file)) as (process, address):
        assert busmaster("write", address, *HCP2, "--node", "1", "10=300").status == 0
        ran = busmaster("safe", str(file))
        assert (ran.status, ran.out) == (0, "winder/force ok\n")
        port = three_controllers.path.removeprefix("socket://")
        assert ran.err == f"busmaster: {port} is owned by process {process.pid}; using it through {address}\n"
        assert busmaster("read", address, *HCP2, "--node", "1", "10").out == "10 15\n"
        assert busmaster("write", address, *HCP2, "--node", "1", "10=30").status == 0
        other = file.with_name("other.toml")
        other.write_text(file.read_text().replace('"winder/force" = 1.5', '"winder/force" = 2'))
        ran = busmaster("safe", str(other))
        assert (ran.status, ran.out) == (2, "")
        assert "has the safe state winder/force = 1.5, not winder/force = 2" in ran.err
        assert busmaster("read", address, *HCP2, "--node", "1", "10").out == "10 30\n"
        process.terminate()
        process.wait(PATIENCE)
    assert [row for row in audit(file.parent) if row[0] == "safe"] == [("safe", "winder/force", 1.5, "written")] * 2


@pytest.mark.slow
def test_options_of_a_node_that_differ_from_the_owners_are_named_with_its_own(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    with owner("serve", str(file)) as (_, address):
        for options, complaint in (
            (("--timeout", "7"), "other timings (a reply window of 7 ms, not 300 ms)"),
            (("--retries", "9"), "other retries (9, not 2)"),
        ):
            ran = busmaster("read", address, *HCP2, *options, "--node", "1", "1")
            assert (ran.status, ran.out) == (2, "")
            assert complaint in ran.err


# lines of the system


@pytest.mark.slow
def test_status_lists_the_lines_of_the_system_too_and_which_of_them_are_not_for_this_user(
    busmaster: Command, file: Path, tmp_path: Path, three_controllers: TcpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "slitter"  # no deeper: a socket's path is short
    folder.mkdir()
    monkeypatch.setattr("busmaster.app.service.folder.SYSTEM", tmp_path)
    monkeypatch.setitem(ENVIRONMENT, "RUNTIME_DIRECTORY", str(folder))  # as systemd says it
    with owner("serve", str(file)) as (process, address):
        assert address == f"unix:{folder}/slitter.sock"
        ran = busmaster("status", "--json")
        said = json.loads(ran.out)
        assert (said["address"], said["process"], said["error"]) == (address, process.pid, None)
        assert busmaster("read", three_controllers.path, *HCP2, "--node", "2", "1").out == "1 0\n"
        # Root may connect whatever the mode, so that the socket itself cannot show this.
        monkeypatch.setattr(socket.socket, "connect", refuse(socket.socket.connect))
        ran = busmaster("status")
        assert ran.status == 0
        port = three_controllers.path.removeprefix("socket://")
        assert ran.lines[1].split()[:3] == ["slitter", port, str(process.pid)]
        assert ran.lines[1].endswith("not for this user")


def refuse(connect: Callable[[socket.socket, Any], None]) -> Callable[[socket.socket, Any], None]:
    """What the kernel answers whoever is not in the group of a socket."""

    def refused(self: socket.socket, address: Any) -> None:
        if self.family == socket.AF_UNIX:
            raise PermissionError(13, "Permission denied")
        connect(self, address)

    return refused


@pytest.mark.slow
def test_points_of_a_file_are_written_through_its_lines_owner(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    with owner("serve", str(file)) as (process, address):
        ran = busmaster("write", str(file), "winder/force=30", "winder/2=7", "--verify")
        assert (ran.status, ran.out) == (0, "winder/force ok\nwinder/2 ok\n")
        assert f"is owned by process {process.pid}; using it through {address}" in ran.err
        ran = busmaster("write", str(file), "winder/2=8", "winder/force=51")
        assert (ran.status, ran.out) == (2, "")
        assert busmaster("read", address, *HCP2, "--node", "1", "10", "2").lines == ["10 300", "2 7"]
        process.terminate()
        process.wait(PATIENCE)
    assert [(row[0], row[1], row[2], row[3]) for row in audit(file.parent)][:1] == [
        ("service", "winder/force", 30.0, "written")
    ]


@pytest.mark.slow
def test_a_second_owner_is_refused_however_it_spells_the_serial_server(busmaster: Command, file: Path) -> None:
    text = file.read_text()
    other = file.parent / "other.toml"
    other.write_text(text.replace("127.0.0.1", "[::ffff:127.0.0.1]").replace("line.sqlite", "other.sqlite"))
    with owner("serve", str(file)) as (process, _):
        ran = busmaster("run", str(other))
    assert ran.status == 1
    assert f"is owned by process {process.pid}" in ran.err
