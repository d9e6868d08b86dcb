"""What `busmaster params load` refuses: a drive in operation, and on an owned line what its owner does not permit."""

from __future__ import annotations

import random
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from busmaster.app.line.parameter_sets import read_set
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer, serve_tcp
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2.microflex_device import ENABLE
from busmaster.protocols.msc.device import EmulatedMsc
from busmaster.protocols.msc.status import ProgramStatus
from busmaster.registry import find, make_device
from tests.app.cli.conftest import Command, owner
from tests.patience import PATIENCE

WINDOW = ("--timeout", "300")
"""For a busy machine: the emulated drives answer from a thread of the test's own process."""


# a drive in operation


def enable(drive: Any) -> None:
    drive.command(ENABLE, 0.0)


def run_program(drive: Any) -> None:
    drive.preset("status", ProgramStatus.PROGRAM_RUNNING)


def reference(drive: Any) -> float:
    return float(drive.speed_reference)


def data(drive: Any) -> float:
    return float(drive.value(2008))


Start = Callable[[Any], None]
Held = Callable[[Any], float]
CASES: Mapping[str, tuple[str, Start, Held, str]] = {
    "microflex": ("speed_reference", enable, reference, "ENABLED is set in its status word"),
    "msc": ("2008", run_program, data, "PROGRAM_RUNNING is set in its status word"),
}


@pytest.mark.slow
@pytest.mark.parametrize("protocol", CASES)
def test_a_drive_in_operation_is_refused_unless_that_is_permitted(
    busmaster: Command, tmp_path: Path, protocol: str
) -> None:
    item, start, held, why = CASES[protocol]
    drive: Any = make_device(protocol, 1)
    if protocol == "msc":
        drive.preset("status", 0)
    file, undo = tmp_path / "one.toml", tmp_path / "undo.toml"
    options = ("--protocol", protocol, *WINDOW)
    with served(protocol, drive) as server:
        saved = busmaster("params", "save", server.path, "1", "-o", str(file), "--items", item, *options)
        assert saved.status == 0, saved.err
        server.call(lambda line, now: set_value(drive, item, 25))
        server.call(lambda line, now: start(drive))
        load = ("params", "load", str(file), f"1@{server.path}", "--yes", "--undo", str(undo), *options)

        refused = busmaster(*load)
        assert (refused.status, refused.out) == (1, "")
        assert f"is in operation: {why}; nothing was written; stop the drive first, or use --enabled" in refused.err
        assert server.call(lambda line, now: held(drive)) == 25
        assert not undo.exists()

        dry = busmaster(*load, "--dry-run")  # it only reads
        assert dry.status == 0, dry.err
        assert server.call(lambda line, now: held(drive)) == 25

        permitted = busmaster(*load, "--enabled")
        assert permitted.status == 0, permitted.err
        assert f"{item} ok" in permitted.lines
        assert f"is in operation: {why}\n" in permitted.err
        assert server.call(lambda line, now: held(drive)) == 0
        assert read_set(str(undo)).set.entries[item].value == 25


def set_value(drive: Any, item: str, value: float) -> None:
    if isinstance(drive, EmulatedMsc):
        drive.preset(item, value)
    else:
        drive.speed_reference = value


@contextmanager
def served(protocol: str, drive: Any) -> Iterator[TcpServer]:
    with serve_tcp(Line(find(protocol).profile.line, [drive], chance=random.Random(1), paced=False)) as server:
        yield server


# a line that another program owns


def audit(folder: Path) -> list[tuple[Any, ...]]:
    """Interface, point, value and outcome of each write that is on record."""
    with closing(sqlite3.connect(folder / "line.sqlite", timeout=PATIENCE)) as database:
        return database.execute("select interface, point, value, outcome from audit order by time").fetchall()


def held_by(server: TcpServer, *elements: int) -> list[float]:
    def held(line: Line, now: float) -> list[float]:
        drive = line.device(1)
        assert isinstance(drive, EmulatedMint)
        return [drive.comms[element] for element in elements]

    return server.call(held)


@pytest.mark.slow
def test_a_set_is_saved_compared_and_loaded_through_the_owner_of_the_line(
    busmaster: Command, file: Path, three_controllers: TcpServer, tmp_path: Path
) -> None:
    saved_to, undo, node = tmp_path / "one.toml", tmp_path / "undo.toml", f"winder@{file}"
    three_controllers.call(lambda line, now: line.device(1).preset("10", 400, 11, 12))
    with owner("serve", str(file)):
        saved = busmaster("params", "save", str(file), "winder", "-o", str(saved_to), "--items", "force,11,12")
        assert saved.status == 0, saved.err
        assert "is owned by process" in saved.err
        entries = read_set(str(saved_to)).set.entries
        assert {item: entry.value for item, entry in entries.items()} == {"10": 400, "11": 11, "12": 12}

        three_controllers.call(lambda line, now: line.device(1).preset("10", 125, 7))
        compared = busmaster("params", "diff", str(saved_to), node)
        assert compared.status == 1, compared.err
        assert [line.split()[0] for line in compared.lines] == ["ITEM", "10", "11"]

        loaded = busmaster("params", "load", str(saved_to), node, "--yes", "--undo", str(undo))
        assert loaded.status == 0, loaded.err
        assert loaded.lines[-2:] == ["10 ok", "11 ok"]
        assert held_by(three_controllers, 10, 11, 12) == [400, 11, 12]

        undone = busmaster("params", "load", str(undo), node, "--yes")
        assert undone.status == 0, undone.err
        assert held_by(three_controllers, 10, 11) == [125, 7]

        text = saved_to.read_text()
        assert "value = 40.0" in text
        saved_to.write_text(text.replace("value = 40.0", "value = 50.1").replace(", maximum = 50", ""))
        refused = busmaster("params", "load", str(saved_to), node, "--yes")
        assert refused.status == 1
        assert "maximum of 50" in refused.err
        assert "11 ok" in refused.lines
        assert "10 ok" not in refused.lines
        assert held_by(three_controllers, 10, 11) == [125, 11]
    assert audit(tmp_path) == [
        ("service", "winder/force", 40, "written"),
        ("service", "1/raw command", "'write element 11 = 11'", "written"),  # its file has no such point
        ("service", "winder/force", 12.5, "written"),
        ("service", "1/raw command", "'write element 11 = 7'", "written"),
        ("service", "1/raw command", "'write element 11 = 11'", "written"),
    ]
