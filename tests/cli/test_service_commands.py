"""A line that one process runs and others use: run, serve, read, write, status, and a program with `connect`."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from busmaster import Hcp2Controller, connect
from busmaster.emulator.serve import TcpServer
from busmaster.service.folder import find_owner
from tests.cli.conftest import ENVIRONMENT, ROOT, Command, serve, started
from tests.patience import PATIENCE

TEXT = """
title = "Slitter"
port = "PORT?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 1
points.force = { item = "10", unit = "N", factor = 0.1, maximum = 50 }
[groups.fast]
period = 0.02
points = ["winder/force"]
[outputs.sqlite]
path = "FOLDER/line.sqlite"
"""
HCP2 = ("--protocol", "hcp2")


@pytest.fixture
def controllers() -> Iterator[TcpServer]:
    """Mint controllers 1 to 3, for one test alone: its process is the only one that is to connect."""
    with serve("hcp2", 1, 2, 3) as server:
        yield server


@pytest.fixture
def file(tmp_path: Path, controllers: TcpServer) -> Path:
    path = tmp_path / "slitter.toml"
    path.write_text(TEXT.replace("PORT", controllers.path).replace("FOLDER", str(tmp_path)))
    return path


@contextmanager
def owner(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A process that serves a line, and its address; ended as a service is."""
    with started(*arguments) as process:
        assert process.stderr is not None
        try:
            said = ""
            while not (found := re.search(r"is served at (unix:\S+)", said)):
                said = process.stderr.readline()
                assert said, "it ended"
            yield process, found[1]
        finally:
            process.terminate()
            process.communicate(timeout=PATIENCE)


def audit(folder: Path) -> list[tuple[Any, ...]]:
    """Door, point, value and outcome of each write that is on record."""
    with closing(sqlite3.connect(folder / "line.sqlite", timeout=10)) as database:
        return database.execute("select door, point, value, outcome from audit order by time").fetchall()


def test_three_programs_use_one_line_at_once(busmaster: Command, file: Path, controllers: TcpServer) -> None:
    with owner("serve", str(file)) as (process, address):
        ran = busmaster("write", controllers.path, *HCP2, "--node", "2", "1=123.456", "--verify")
        assert (ran.status, ran.out) == (0, "1 ok\n")
        port = controllers.path.removeprefix("socket://")
        assert ran.err == (f"busmaster: {port} is owned by process {process.pid}: asking through {address}\n")
        ran = busmaster("read", address, *HCP2, "--node", "2", "1")
        assert (ran.status, ran.out) == (0, "1 123.456\n")

        async def program() -> None:
            async with connect("slitter") as remote:
                controller = Hcp2Controller(remote, 1)
                await controller.point("10").write(30)
                async for snapshot in await remote.group("fast"):
                    [sample] = snapshot.samples.values()
                    if sample.value == 3.0:
                        break

        asyncio.run(asyncio.wait_for(program(), PATIENCE))
        ran = busmaster("write", controllers.path, *HCP2, "--node", "1", "10=501")
        assert ran.status == 2
        assert "50" in ran.err
        process.terminate()
        assert process.wait(PATIENCE) == 0
    assert audit(file.parent) == [
        ("service", "2/write element 1 = 123.456", "'write element 1 = 123.456'", "written"),
        ("service", "winder/force", 3.0, "written"),
        ("service", "winder/force", 50.1, "refused"),
    ]


def test_options_that_differ_from_the_owners_are_wrong_usage(
    busmaster: Command, file: Path, controllers: TcpServer
) -> None:
    with owner("serve", str(file)):
        for options, complaint in (
            (("--baud", "9600"), "not 9600 baud"),
            (("--echo",), "not with an echo"),
            (("--capture", "x.pcapng"), "not by --capture"),
        ):
            ran = busmaster("read", controllers.path, *HCP2, *options, "--node", "2", "1")
            assert (ran.status, ran.out) == (2, "")
            assert complaint in ran.err
        ran = busmaster("read", f"{controllers.path}?baudrate=9600", *HCP2, "--node", "2", "1")
        assert ran.status == 2
        ran = busmaster("read", controllers.path, *HCP2, "--baud", "57600", "--node", "2", "1")
        assert ran.status == 0


def test_run_serves_its_line_and_status_lists_it(busmaster: Command, file: Path, controllers: TcpServer) -> None:
    port = controllers.path.removeprefix("socket://")
    assert busmaster("status").err == "busmaster: no line of this user is served: start busmaster run LINE.toml\n"
    with started("run", "--plain", str(file)) as process:
        assert process.stdout is not None
        process.stdout.readline()  # it polls, and so is served
        ran = busmaster("status", "--json")
        said = json.loads(ran.out)
        assert (said["name"], said["port"], said["process"]) == ("slitter", port, process.pid)
        assert (said["programs"], said["up"], said["nodes"], said["error"]) == (0, 1, 1, None)
        assert busmaster("status").lines[1].split()[:4] == ["slitter", port, str(process.pid), "0"]
        process.terminate()
        process.communicate(timeout=PATIENCE)
    assert busmaster("status").out == ""


def test_a_line_whose_file_says_so_is_served_to_nobody(busmaster: Command, file: Path) -> None:
    file.write_text(file.read_text() + "[service]\nenabled = false\n")
    with started("run", "--plain", str(file)) as process:
        assert process.stdout is not None
        process.stdout.readline()
        assert busmaster("status").out == ""
        process.terminate()
        process.communicate(timeout=PATIENCE)


@pytest.mark.parametrize("arguments", [("run",), ("serve",), ("write", "winder/force=5")])
def test_a_second_master_on_a_line_that_is_owned_is_refused(file: Path, arguments: tuple[str, ...]) -> None:
    command, *rest = arguments
    with owner("serve", str(file)) as (process, address):
        ran = subprocess.run(
            [sys.executable, "-m", "busmaster", command, str(file), *rest],
            check=False,
            cwd=ROOT,
            env=ENVIRONMENT,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
        )
    assert ran.returncode == 1
    assert f"is owned by process {process.pid}; end that first" in ran.stderr
    assert "two masters on one line garble each other" in ran.stderr
    assert (f"or write by node and item through {address}" in ran.stderr) == (command == "write")
    assert audit(file.parent) == []


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
    assert f"is served already by process {process.pid}" in ran.stderr


def test_an_owner_that_was_killed_leaves_nothing_in_the_way(file: Path, controllers: TcpServer) -> None:
    with owner("serve", str(file)) as (process, first):
        process.send_signal(signal.SIGKILL)
        process.wait(PATIENCE)
        assert os.path.exists(first.removeprefix("unix:"))
        assert find_owner(controllers.path) is None
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


def test_the_audit_is_true_of_a_program_that_was_killed_as_it_wrote(
    busmaster: Command, file: Path, controllers: TcpServer
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
        ('group = "no-such-group"', "there is no group 'no-such-group' on this machine"),
        ('mode = "rw"', "a mode is octal"),
        ("port = 5020", "port"),
    ):
        file.write_text(f"{text}[service]\n{said}\n")
        ran = busmaster("plan", str(file))
        assert ran.status == 2
        assert complaint in ran.err
        assert "slitter.toml" in ran.err
