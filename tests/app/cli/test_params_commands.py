"""`busmaster params` in this process, on a few parameters: each option, each message and each exit status."""

from __future__ import annotations

import getpass
import json
import os
import platform
import pty
import re
import sqlite3
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractContextManager, closing
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import click
import pytest

from busmaster import Priority
from busmaster.app.cli import params, targets
from busmaster.app.cli.output import Level
from busmaster.app.config import LineFile, load
from busmaster.app.line.parameter_sets import read_set
from busmaster.capture.pcapng import read_packets
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer
from busmaster.errors import NodeDown
from busmaster.ext import Change, Found, Left, Outcome, Parameter, Result
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.registry import find
from tests.app.cli.conftest import Command, owner_here
from tests.patience import PATIENCE

HCP2 = ("--protocol", "hcp2")
NOBODY = "socket://127.0.0.1:1"
SET = """format = 1
[drive]
protocol = "{protocol}"
address = 1
identity = {identity}
[saved]
time = 2026-01-31T12:00:00Z
[parameters]
{parameters}
"""


@pytest.fixture
def file(file: Path) -> Path:
    """The file of the line, with the short window of the document: each command waits for it once."""
    file.write_text(file.read_text().replace("timing = { window = 0.3 }\n", ""))
    return file


def written(path: Path, parameters: str, *, protocol: str = "hcp2", identity: str = "{}") -> Path:
    path.write_text(SET.format(protocol=protocol, identity=identity, parameters=parameters))
    return path


def preset(server: TcpServer, *values: float) -> None:
    """Have elements 10, 11 and so on of controller 1 hold values."""
    server.call(lambda line, now: line.device(1).preset("10", *values))


def held(server: TcpServer, *elements: int) -> list[float]:
    def read(line: Line, now: float) -> list[float]:
        drive = line.device(1)
        assert isinstance(drive, EmulatedMint)
        return [drive.comms[element] for element in elements]

    return server.call(read)


def audit(folder: Path) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(folder / "line.sqlite", timeout=PATIENCE)) as database:
        return database.execute("select interface, by, point, value, outcome from audit order by time").fetchall()


# saving and comparing


def test_only_the_named_items_are_saved(busmaster: Command, controllers: TcpServer, tmp_path: Path) -> None:
    path = tmp_path / "one.toml"
    ran = busmaster("params", "save", controllers.path, "1", "-o", str(path), "--items", "10,12", *HCP2)
    assert (ran.status, ran.out) == (0, ""), ran.err
    assert list(read_set(str(path)).set.entries) == ["10", "12"]
    assert read_set(str(path)).set.by == f"{getpass.getuser()}@{platform.node()}"
    assert f"{path}: 2 parameters of node 1; without 0 that the node does not have" in ran.err
    again = busmaster("params", "save", controllers.path, "1", "-o", str(path), "--items", "10", *HCP2)
    assert again.status == 2
    assert "exists and is not overwritten" in again.err


@pytest.mark.slow
def test_a_node_of_a_file_is_saved_and_compared_in_the_units_of_its_points(
    busmaster: Command, file: Path, three_controllers: TcpServer, tmp_path: Path
) -> None:
    preset(three_controllers, 400, 11, 12)
    path, node = tmp_path / "one.toml", f"winder@{file}"
    ran = busmaster("params", "save", str(file), "winder", "-o", str(path), "--items", "force,11,12")
    assert ran.status == 0, ran.err
    assert "value = 40.0" in path.read_text()
    assert busmaster("params", "diff", str(path), node).status == 0
    preset(three_controllers, 125, 7)
    compared = busmaster("params", "diff", str(path), node)
    assert compared.status == 1
    assert compared.lines == ["ITEM  NAME   ONE  OTHER  UNIT", "10    force   40   12.5  N", "11            11      7"]
    compared = busmaster("params", "diff", node, str(path), "--json")
    assert compared.status == 1
    assert [json.loads(line) for line in compared.lines] == [
        {"item": "10", "name": "force", "unit": "N", "one": 12.5, "other": 40},
        {"item": "11", "name": None, "unit": "", "one": 7, "other": 11},
    ]
    compared = busmaster("params", "diff", str(path), node, "--items", "11,12")
    assert [line.split()[0] for line in compared.lines] == ["ITEM", "11"]
    assert busmaster("params", "diff", str(path), node, "--items", "12").status == 0
    # of a node that is compared with a file, the parameters of the file are read, as LINE.toml describes them
    few = str(written(tmp_path / "few.toml", '"10" = { value = 400 }\n"12" = { value = 12 }'))
    compared = busmaster("params", "diff", node, few)
    assert [line.split() for line in compared.lines[1:]] == [["10", "force", "12.5", "40", "N"]]
    compared = busmaster("params", "diff", node, few, "--items", "11,12")
    assert [line.split() for line in compared.lines[1:]] == [["11", "7", "-"]]


def test_two_nodes_of_a_line_and_two_files_are_compared(
    busmaster: Command, three_controllers: TcpServer, tmp_path: Path
) -> None:
    preset(three_controllers, 1, 2)
    port = three_controllers.path
    ran = busmaster("params", "diff", f"1@{port}", f"2@{port}", "--items", "10,11,12", *HCP2)
    assert (ran.status, [line.split() for line in ran.lines[1:]]) == (1, [["10", "1", "0"], ["11", "2", "0"]])
    assert "is owned by process" not in ran.err
    one = written(tmp_path / "one.toml", '"10" = { value = 1 }\n"11" = { value = 5 }', identity="{ firmware = 1 }")
    other = written(tmp_path / "other.toml", '"10" = { value = 2 }', identity="{ firmware = 2 }")
    files = busmaster("params", "diff", str(one), str(other))
    assert (files.status, [line.split() for line in files.lines[1:]]) == (1, [["10", "1", "2"], ["11", "5", "-"]])
    assert files.err == "busmaster: firmware is 1 and 2\n"
    only = busmaster("params", "diff", str(one), str(other), "--items", "11", "--json")
    assert [json.loads(line) for line in only.lines] == [
        {"item": "11", "name": None, "unit": "", "one": 5, "other": None}
    ]
    zero = written(tmp_path / "zero.toml", '"10" = { value = 0 }\n"11" = { value = 5 }')
    for sides, values in (((zero, one), (0, 1)), ((one, zero), (1, 0))):
        ran = busmaster("params", "diff", *map(str, sides), "--json")
        assert [json.loads(line) for line in ran.lines] == [
            {"item": "10", "name": None, "unit": "", "one": values[0], "other": values[1]}
        ]
    at = written(tmp_path / "b@ck.toml", '"10" = { value = 1 }\n"11" = { value = 5 }')
    assert busmaster("params", "diff", str(one), str(at)).status == 0


def test_differences_are_a_table_with_the_values_flush_right(busmaster: Command, tmp_path: Path) -> None:
    text = '"10" = {{ value = {}, name = "force", unit = "N" }}\n"11" = {{ value = {} }}'
    one = str(written(tmp_path / "one.toml", text.format(1, 2000000)))
    other = str(written(tmp_path / "other.toml", text.format(1250.5, 3)))
    assert busmaster("params", "diff", one, other).lines == [
        "ITEM  NAME       ONE   OTHER  UNIT",
        "10    force        1  1250.5  N",
        "11           2000000       3",
    ]


def test_an_item_is_what_each_of_two_nodes_calls_so(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    spare = '[nodes.spare]\nprotocol = "hcp2"\naddress = 2\npoints.force = { item = "12" }\n'
    file.write_text(file.read_text().replace("[groups.fast]", f"{spare}[groups.fast]"))
    for nodes in (("winder", "spare"), ("spare", "winder")):
        ran = busmaster("params", "diff", *(f"{node}@{file}" for node in nodes), "--items", "force")
        assert (ran.status, {line.split()[0] for line in ran.lines[1:]}) == (1, {"10", "12"}), ran.err


def test_nodes_of_two_ports_are_compared(
    busmaster: Command, controllers: TcpServer, three_controllers: TcpServer
) -> None:
    preset(controllers, 0, 7)
    preset(three_controllers, 0, 8)
    nodes = f"1@{controllers.path}", f"1@{three_controllers.path}"
    ran = busmaster("params", "diff", *nodes, "--items", "11", *HCP2)
    assert (ran.status, [line.split() for line in ran.lines[1:]]) == (1, [["11", "7", "8"]]), ran.err


def test_items_of_two_files_are_named_as_the_files_name_them(busmaster: Command, tmp_path: Path) -> None:
    text = '"10" = {{ value = {}, name = "force" }}\n"11" = {{ value = {}, name = "10" }}'
    one = str(written(tmp_path / "one.toml", text.format(1, 2)))
    other = str(written(tmp_path / "other.toml", text.format(3, 2)))
    for item in ("10", "force"):
        ran = busmaster("params", "diff", one, other, "--items", item)
        assert (ran.status, ran.lines[1].split()[0]) == (1, "10")
    assert busmaster("params", "diff", one, other, "--items", "11").status == 0
    for item in ("10:2", "forze"):
        ran = busmaster("params", "diff", one, other, "--items", f"11,{item}")
        assert (ran.status, ran.out) == (2, "")
        assert f"neither file has a parameter {item!r}; " in ran.err


def test_what_cannot_be_compared_is_status_2(busmaster: Command, tmp_path: Path) -> None:
    one = str(written(tmp_path / "one.toml", '"10" = { value = 1 }'))
    drive = str(written(tmp_path / "drive.toml", '"1.17" = { value = 1 }', protocol="mentor"))
    for other, complaint in (
        (str(tmp_path / "none.toml"), "none.toml: No such file or directory"),
        (str(tmp_path), f"{tmp_path}: Is a directory"),
        (f"1@{NOBODY}", "refused the connection"),
        (drive, f"{one} belongs to a hcp2, {drive} to a mentor; their items differ"),
    ):
        ran = busmaster("params", "diff", one, other, "--items", "10", *HCP2)
        assert (ran.status, ran.out) == (2, "")
        assert complaint in ran.err


def test_an_unknown_command_of_params_names_the_nearest(busmaster: Command) -> None:
    ran = busmaster("params", "sav")
    assert ran.status == 2
    assert "no such command 'sav'; did you mean 'save'?" in ran.err


def test_a_node_that_is_not_one_is_named_with_the_right_form(busmaster: Command, file: Path, tmp_path: Path) -> None:
    one = str(written(tmp_path / "one.toml", '"10" = { value = 1 }'))
    for node, complaint in (
        (f"winder@{NOBODY}", "'winder' is not an address; on a PORT, name the node by its address"),
        (f"wimder@{file}", "has no node 'wimder'; did you mean 'winder'?"),
        ("1@", "'1@' is not a node; write it as NODE@PORT|NODE@LINE.toml"),
    ):
        ran = busmaster("params", "load", one, node, "--yes", *(HCP2 if NOBODY in node else ()))
        assert ran.status == 2
        assert complaint in ran.err


class Walk:
    """A node that replies to some of its parameters."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *found: Found) -> None:
        self.found = found
        self.requested: list[str] = []
        monkeypatch.setattr(params, "walk", self.walk)

    async def walk(self, handle: Any, parameters: tuple[Parameter, ...]) -> AsyncIterator[Found]:
        self.requested += [parameter.item for parameter in parameters]
        for one in self.found:
            if one.why == "the port was lost":
                raise OSError(one.why)
            yield one


def test_parameters_that_could_not_be_read_are_named_each_and_the_status_is_1(
    busmaster: Command, controllers: TcpServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "one.toml"
    ten, eleven, twelve, last = (Parameter(item=str(number)) for number in (10, 11, 12, 13))
    Walk(
        monkeypatch,
        *(Found(ten, 5.0), Found(eleven, why="garbled"), Found(twelve, why="no reply"), Found(last, why="", gap=True)),
    )
    ran = busmaster("params", "save", controllers.path, "1", "-o", str(path), "--items", "10,11,12,13", *HCP2)
    assert ran.status == 1
    assert "without 1 that the node does not have" in ran.err
    assert "11 could not be read: garbled" in ran.err
    assert "12 could not be read: no reply" in ran.err
    assert "13 could not" not in ran.err


def test_an_interrupted_save_reports_how_many_it_has_and_continues_with_the_others(
    busmaster: Command, controllers: TcpServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "one.toml"
    ten, eleven, twelve = (Parameter(item=str(number)) for number in (10, 11, 12))
    save = ("params", "save", controllers.path, "1", "-o", str(path), "--items", "10,11,12", *HCP2)
    Walk(monkeypatch, Found(ten, why="the port was lost"))
    assert "the same command continues" not in busmaster(*save).err  # nothing was read yet
    Walk(monkeypatch, Found(ten, 5.0), Found(eleven, 6.0), Found(twelve, why="the port was lost"))
    assert f"2 of 3 are in {path}.part; the same command continues there" in busmaster(*save).err
    walk = Walk(monkeypatch, Found(twelve, 7.0))
    counted: list[int] = []
    monkeypatch.setattr("busmaster.app.cli.progress.Bar.advance", lambda _, count=1: counted.append(count))
    ran = busmaster(*save)
    assert counted == [2, 1]  # the bar begins behind those that were read before
    assert ran.status == 0
    assert f"{path}.part: 2 of 3 were read before; continuing" in ran.err
    assert walk.requested == ["12"]
    assert [entry.value for entry in read_set(str(path)).set.entries.values()] == [5, 6, 7]


# loading


@pytest.mark.slow
def test_a_set_is_loaded_into_a_node_of_a_file_and_each_write_is_in_the_audit_log(
    busmaster: Command, file: Path, three_controllers: TcpServer, tmp_path: Path
) -> None:
    preset(three_controllers, 125, 7, 12)
    path, undo, node = tmp_path / "one.toml", tmp_path / "undo.toml", f"winder@{file}"
    written(path, '"10" = { value = 400 }\n"11" = { value = 11 }\n"12" = { value = 12 }', identity="{ firmware = 9 }")
    load = ("params", "load", str(path), node, "--undo", str(undo))

    refused = busmaster(*load)
    assert refused.status == 2
    assert "confirmation required, but there is no terminal; nothing was sent" in refused.err

    table = ["ITEM  NAME    NOW  FILE  UNIT", "10    force  12.5    40  N", "11              7    11"]
    dry = busmaster(*load, "--dry-run")
    assert (dry.status, dry.lines) == (0, table), dry.err
    assert "winder: 2 to write, 1 equal, 0 excluded" in dry.err
    assert "but 9 in the file" in dry.err
    assert held(three_controllers, 10, 11) == [125, 7]
    assert not undo.exists()

    loaded = busmaster(*load, "--yes")
    assert (loaded.status, loaded.lines) == (0, [*table, "10 ok", "11 ok"]), loaded.err
    assert "hcp2 cannot report whether it is enabled; make sure that it is not" in loaded.err
    assert f"the old values are in {undo}; to restore them: busmaster params load {undo} {node}" in loaded.err
    assert "winder: 2 of 2 written" in loaded.err
    assert held(three_controllers, 10, 11) == [400, 11]
    assert {item: entry.value for item, entry in read_set(str(undo)).set.entries.items()} == {"10": 125, "11": 7}
    assert audit(tmp_path) == [
        ("command line", "busmaster params load", "winder/force", 40, "written"),
        ("command line", "busmaster params load", "winder/11", 11, "written"),
    ]
    again = busmaster(*load, "--yes")
    assert again.status == 2
    assert f"{undo} exists and is not overwritten" in again.err
    same = busmaster("params", "load", str(path), node, "--yes", "--enabled")
    assert (same.status, same.out) == (0, "")
    assert "make sure that it is not" not in same.err
    assert list(tmp_path.glob("one.undo*")) == []


def test_a_load_names_the_command_that_undoes_it_and_its_writes_are_in_the_audit_log(
    busmaster: Command, file: Path, three_controllers: TcpServer, tmp_path: Path
) -> None:
    path = written(tmp_path / "one.toml", '"10" = { value = 400 }\n"11" = { value = 11, name = "torque" }')
    node, undo = f"winder@{file}", str(tmp_path / "undo.toml")
    ran = busmaster("params", "load", str(path), node, "--yes", "--enabled", "--undo", undo)
    assert ran.status == 0, ran.err
    assert f"the old values are in {undo}; to restore them: busmaster params load {undo} {node}\n" in ran.err
    assert audit(tmp_path) == [
        ("command line", "busmaster params load", "winder/force", 40, "written"),
        ("command line", "busmaster params load", "winder/11", 11, "written"),
    ]


def test_a_comparison_with_a_node_of_a_file_has_the_names_and_units_of_its_points(
    busmaster: Command, file: Path, three_controllers: TcpServer, tmp_path: Path
) -> None:
    preset(three_controllers, 125, 7)
    path = str(written(tmp_path / "one.toml", '"10" = { value = 400 }\n"11" = { value = 8 }'))
    compared = busmaster("params", "diff", f"winder@{file}", path, "--json")
    assert compared.status == 1, compared.err
    assert [json.loads(line) for line in compared.lines] == [
        {"item": "10", "name": "force", "unit": "N", "one": 12.5, "other": 40},
        {"item": "11", "name": None, "unit": "", "one": 7, "other": 8},
    ]
    few = str(written(tmp_path / "few.toml", '"10" = { value = 400 }\n"12" = { value = 0 }'))
    compared = busmaster("params", "diff", f"winder@{file}", few, "--items", "11,12")
    assert [line.split() for line in compared.lines[1:]] == [["11", "7", "-"]]


def test_what_a_limit_excludes_is_named_each_and_the_others_are_written(
    busmaster: Command, file: Path, three_controllers: TcpServer, tmp_path: Path
) -> None:
    path, node = tmp_path / "one.toml", f"winder@{file}"
    written(path, '"10" = { value = 501 }\n"11" = { value = 6, maximum = 5 }\n"12" = { value = 3 }')
    ran = busmaster("params", "load", str(path), node, "--yes")
    assert (ran.status, ran.lines[1:]) == (1, ["12            0     3", "12 ok"]), ran.err
    assert "is not written (0, in the file 50.1): " in ran.err
    assert "above its maximum of 50" in ran.err
    assert "6 is beyond its maximum of 5" in ran.err
    assert "winder: 1 to write, 0 equal, 2 excluded" in ran.err
    assert held(three_controllers, 10, 11, 12) == [0, 0, 3]
    [undo] = tmp_path.glob("one.undo-*.toml")
    assert list(read_set(str(undo)).set.entries) == ["12"]
    assert read_set(str(undo)).set.by == f"{getpass.getuser()}@{platform.node()}"
    dry = busmaster("params", "load", str(path), node, "--dry-run", "--undo", str(tmp_path / "other.toml"))
    assert dry.status == 1


def test_a_load_reports_each_item_that_identifies_another_node(
    busmaster: Command, controllers: TcpServer, tmp_path: Path
) -> None:
    path = written(tmp_path / "one.toml", '"10" = { value = 1 }', identity="{ firmware = 9, serial = 3 }")
    ran = busmaster("params", "load", str(path), f"1@{controllers.path}", "--dry-run", *HCP2)
    assert ran.status == 0, ran.err
    reports = [line for line in ran.err.splitlines() if line.endswith("in the file")]
    assert len(reports) == 1  # the node has no serial number to compare
    assert re.fullmatch(r"busmaster: node 1: firmware is \d+, but 9 in the file", reports[0])


def test_a_set_that_the_node_holds_is_loaded_without_a_question(
    busmaster: Command, three_controllers: TcpServer, tmp_path: Path, requested: Callable[[bytes], None]
) -> None:
    preset(three_controllers, 5)
    path = written(tmp_path / "one.toml", '"10" = { value = 5 }')
    requested(b"n\n")
    ran = busmaster("params", "load", str(path), f"1@{three_controllers.path}", "--enabled", *HCP2)
    assert (ran.status, ran.out, ran.err) == (0, "", "busmaster: node 1: 0 to write, 1 equal, 0 excluded\n")
    assert list(tmp_path.glob("*undo*")) == []


def test_a_set_of_another_kind_of_node_is_not_loaded(
    busmaster: Command, three_controllers: TcpServer, tmp_path: Path
) -> None:
    path = written(tmp_path / "one.toml", '"10" = { value = 1 }', protocol="hcp")
    ran = busmaster("params", "load", str(path), f"1@{three_controllers.path}", "--yes", *HCP2)
    assert ran.status == 2
    assert "node 1 is a hcp2, but the set belongs to a hcp" in ran.err
    assert held(three_controllers, 10) == [0]


def test_without_a_file_for_the_old_values_nothing_is_written(
    busmaster: Command, three_controllers: TcpServer, tmp_path: Path
) -> None:
    path = written(tmp_path / "one.toml", '"10" = { value = 1 }')
    undo = tmp_path / "none" / "undo.toml"
    ran = busmaster("params", "load", str(path), f"1@{three_controllers.path}", "--yes", "--undo", str(undo), *HCP2)
    assert ran.status == 1
    assert f"{undo}.new: No such file or directory" in ran.err
    assert held(three_controllers, 10) == [0]


def test_a_load_that_cannot_reach_its_node_reports_that_nothing_was_written(
    busmaster: Command, controllers: TcpServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def prepare(*_: object) -> None:
        raise NodeDown("node 1 is down", hint="")

    monkeypatch.setattr(params, "prepare", prepare)
    path = written(tmp_path / "one.toml", '"10" = { value = 1 }')
    ran = busmaster("params", "load", str(path), f"1@{controllers.path}", "--yes", *HCP2)
    assert ran.status == 1
    assert "busmaster: nothing was written\n" in ran.err


def test_through_an_owner_a_set_is_saved_and_loaded_and_the_limits_of_both_apply(
    busmaster: Command, file: Path, three_controllers: TcpServer, tmp_path: Path
) -> None:
    path, node = tmp_path / "one.toml", f"winder@{file}"
    written(path, '"10" = { value = 300 }\n"11" = { value = 11 }')
    with owner_here(file):
        file.write_text(file.read_text().replace("maximum = 50", "maximum = 20"))
        ran = busmaster("params", "load", str(path), node, "--yes")
        assert ran.status == 1
        assert "is owned by process" in ran.err
        assert "above its maximum of 20" in ran.err
        assert held(three_controllers, 10, 11) == [0, 11]
        file.write_text(file.read_text().replace("maximum = 20", "maximum = 70"))
        written(path, '"10" = { value = 600 }')
        ran = busmaster("params", "load", str(path), node, "--yes", "--undo", str(tmp_path / "undo.toml"))
        assert ran.status == 1
        assert held(three_controllers, 10) == [0]
    assert [row[0] for row in audit(tmp_path) if row[4] == "written"] == ["service"]


def test_through_an_owner_no_audit_log_is_needed_here(
    busmaster: Command, file: Path, three_controllers: TcpServer, tmp_path: Path
) -> None:
    path = written(tmp_path / "one.toml", '"11" = { value = 11 }')
    with owner_here(file):
        file.write_text(file.read_text().replace("line.sqlite", "none/line.sqlite"))
        ran = busmaster("params", "load", str(path), f"winder@{file}", "--yes")
        assert ran.status == 0, ran.err
    assert [row[0] for row in audit(tmp_path)] == ["service"]


def test_the_bar_of_a_save_and_of_a_comparison_counts_each_parameter(
    busmaster: Command, controllers: TcpServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted: list[int] = []
    monkeypatch.setattr("busmaster.app.cli.progress.Bar.advance", lambda _, count=1: counted.append(count))
    node, path = f"8@{controllers.path}", tmp_path / "one.toml"
    save = ("params", "save", controllers.path, "8", "-o", str(path), "--items", "10,11,12", *HCP2)
    assert busmaster(*save).status == 0
    assert sum(counted) == 3
    counted.clear()
    assert busmaster("params", "diff", str(path), node, *HCP2).status == 0
    assert sum(counted) == 3


# the question


@pytest.fixture
def requested(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[bytes], None]]:
    """A terminal on standard input, and what types a line there."""
    master, slave = pty.openpty()
    with os.fdopen(slave) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)

        def typed(text: bytes) -> None:
            os.write(master, text)

        yield typed
    os.close(master)


@pytest.mark.parametrize("answer", ["y", "yes", "Y", "YES "])
def test_a_load_is_written_after_a_yes(
    busmaster: Command,
    three_controllers: TcpServer,
    tmp_path: Path,
    requested: Callable[[bytes], None],
    answer: str,
) -> None:
    path = written(tmp_path / "one.toml", '"10" = { value = 1 }')
    requested(f"{answer}\n".encode())
    ran = busmaster("params", "load", str(path), f"1@{three_controllers.path}", *HCP2)
    assert ran.status == 0, ran.err
    assert "Write 1 parameter to node 1? [y/N]: " in ran.err
    assert ran.err.count("make sure that it is not") == 1
    assert held(three_controllers, 10) == [1]


@pytest.mark.parametrize("answer", ["n", "", "yet"])
def test_a_load_is_not_written_after_any_other_answer(
    busmaster: Command,
    three_controllers: TcpServer,
    tmp_path: Path,
    requested: Callable[[bytes], None],
    answer: str,
) -> None:
    path = written(tmp_path / "one.toml", '"10" = { value = 1 }')
    requested(f"{answer}\n".encode())
    ran = busmaster("params", "load", str(path), f"1@{three_controllers.path}", *HCP2)
    assert ran.status == 1
    assert "busmaster: nothing was written\n" in ran.err
    assert held(three_controllers, 10) == [0]
    assert list(tmp_path.glob("*undo*")) == []


@pytest.mark.parametrize("enabled", [False, True])
def test_a_drive_that_was_started_during_the_question_is_not_written_unless_that_is_permitted(
    busmaster: Command,
    three_controllers: TcpServer,
    tmp_path: Path,
    requested: Callable[[bytes], None],
    monkeypatch: pytest.MonkeyPatch,
    enabled: bool,
) -> None:
    path = written(tmp_path / "one.toml", '"10" = { value = 1 }')
    states = iter(["", "it runs"])

    async def in_operation(*_: object, **__: object) -> str:
        return next(states)

    monkeypatch.setattr(find("hcp2").handle, "in_operation", in_operation)
    requested(b"y\n")
    node = f"1@{three_controllers.path}"
    ran = busmaster("params", "load", str(path), node, *HCP2, *(["--enabled"] if enabled else []))
    refusal = "node 1 is in operation: it runs; nothing was written; stop the drive first, or use --enabled"
    assert (refusal in ran.err) is not enabled
    assert (ran.status, held(three_controllers, 10)) == ((0, [1]) if enabled else (1, [0]))


@pytest.mark.parametrize(
    ("why", "enabled", "again", "written", "reported"),
    [
        ("", False, False, True, ""),
        (None, False, False, True, "cannot report"),
        (None, True, False, True, ""),
        (None, False, True, True, ""),
        ("it runs", False, False, False, "stop the drive first"),
        ("it runs", False, True, False, "stop the drive first"),
        ("it runs", True, False, True, "is in operation: it runs\n"),
        ("it runs", True, True, True, ""),
    ],
)
def test_a_drive_in_operation_is_written_only_if_that_is_permitted(
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    why: str | None,
    enabled: bool,
    again: bool,
    written: bool,
    reported: str,
) -> None:
    stream = os.fstat(sys.stderr.fileno())
    monkeypatch.setenv("JOURNAL_STREAM", f"{stream.st_dev}:{stream.st_ino}")

    async def in_operation(**_: object) -> str | None:
        return why

    target: Any = SimpleNamespace(
        handle=SimpleNamespace(in_operation=in_operation), kind=SimpleNamespace(name="hcp2"), label="node 1"
    )
    assert anyio.run(lambda: params.may_be_written(target, enabled, again=again)) is written
    err = capfd.readouterr().err
    assert reported in err
    assert bool(err) == bool(reported)
    level = Level.WARNING if written else Level.ERROR
    assert not err or err.startswith(f"<{level:d}>busmaster: ")


# the end of a load


class Plan:
    """A load of three parameters whose writes end so."""

    def __init__(self, *results: Result) -> None:
        self.changes = tuple(Change(Parameter(item=str(number)), 0, 1) for number in (10, 11, 12))
        self._results = results

    async def write(self, *, around: Callable[[Change], AbstractContextManager[None]]) -> AsyncIterator[Outcome]:
        for change, result in zip(self.changes, self._results, strict=False):
            with around(change):
                yield Outcome(change, result, "of a reason")
        if len(self._results) < len(self.changes):
            raise KeyboardInterrupt


def carried_out(plan: Any) -> int:
    target: Any = SimpleNamespace(line=None, label="node 1")
    return anyio.run(params.carry_out, plan, target)


def test_each_parameter_that_was_not_written_is_reported_and_the_status_is_1(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    levels: list[int] = []
    texts: list[str] = []

    def note(text: str, level: int = 6) -> None:
        texts.append(text)
        levels.append(level)

    monkeypatch.setattr(params, "note", note)
    assert carried_out(Plan(Result.WRITTEN, Result.REFUSED, Result.UNCONFIRMED)) == 1
    assert capfd.readouterr().out == "10 ok\n"
    assert texts == [
        "11: refused: of a reason",
        "12: unconfirmed: of a reason",
        "node 1: 1 of 3 written",
    ]
    assert levels == [3, 2, 6]
    assert carried_out(Plan(*[Result.WRITTEN] * 3)) == 0


def test_an_interrupted_load_reports_the_write_that_may_have_arrived_and_those_that_were_not_sent(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(KeyboardInterrupt):
        carried_out(Plan(Result.WRITTEN))
    assert capfd.readouterr().err.splitlines() == [
        "busmaster: 11: unconfirmed: the command was interrupted",
        "busmaster: 12: not written: the command was interrupted",
    ]


def test_excluded_parameters_are_warnings_only_if_they_were_not_to_be_expected(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    levels: list[int] = []
    monkeypatch.setattr(params, "note", lambda text, level=6: levels.append(level))
    left = [Left(Parameter(item="10"), 1, 2, "why", expected) for expected in (True, False)]
    plan: Any = SimpleNamespace(changes=(), left=left, equal=0)
    params.print_plan(plan, SimpleNamespace(kind=find("hcp2"), label="node 1"))  # type: ignore[arg-type]  # a stand-in
    assert levels == [6, 4, 6]


# which lines are opened, and how they are recorded


def test_two_nodes_of_a_file_share_its_line_and_its_recording(
    busmaster: Command, file: Path, three_controllers: TcpServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spare = '[nodes.spare]\nprotocol = "hcp2"\naddress = 2\n'
    file.write_text(file.read_text().replace("[groups.fast]", f"{spare}[groups.fast]"))
    preset(three_controllers, 0, 7)
    loaded: list[str] = []

    def counted(path: str) -> LineFile:
        loaded.append(path)
        return load(path)

    monkeypatch.setattr(targets, "load", counted)
    capture = tmp_path / "x.pcapng"
    ran = busmaster("params", "diff", f"winder@{file}", f"spare@{file}", "--items", "11", "--capture", str(capture))
    assert (ran.status, ran.lines[1].split()) == (1, ["11", "7", "0"]), ran.err
    assert loaded == [str(file)]
    with capture.open("rb") as opened:
        assert {packet.node for packet in read_packets(opened)} == {1, 2}


@pytest.mark.parametrize(
    ("module", "command"),
    [
        ("read", ("read", "FILE", "winder/force")),
        ("write", ("write", "FILE", "winder/11=1")),
        ("trend", ("trend", "FILE", "winder/force")),
        ("targets", ("params", "diff", "winder@FILE", "winder@FILE")),
        ("targets", ("do", "winder@FILE", "stop")),
    ],
)
def test_the_line_of_a_file_is_recorded_as_the_file_describes_it(
    busmaster: Command, file: Path, monkeypatch: pytest.MonkeyPatch, module: str, command: tuple[str, ...]
) -> None:
    text = file.read_text()
    requested: list[tuple[str | None, dict[str, Any]]] = []

    def capturing(capture: str | None, **options: Any) -> None:
        requested.append((capture, options))
        raise click.UsageError("that is enough")

    monkeypatch.setattr(f"busmaster.app.cli.{module}.capturing", capturing)
    for echo in (False, True):
        port = f"?baudrate=57600&echo={str(echo).lower()}"
        file.write_text(text.replace("?baudrate=57600", port))
        ran = busmaster(*(word.replace("FILE", str(file)) for word in command), "--capture", "x.pcapng")
        assert "that is enough" in ran.err
        [(capture, options)] = requested
        requested.clear()
        assert capture == "x.pcapng"
        assert options["echo"] is echo
        assert options["port"].startswith("127.0.0.1:")


def test_the_old_values_are_saved_beside_the_set_with_the_time() -> None:
    assert re.fullmatch(r"/sets/one\.undo-\d{8}T\d{6}\.toml", params.default_undo("/sets/one.toml"))
    assert re.fullmatch(r"one\.undo-\d{8}T\d{6}\.toml", params.default_undo("one"))


def test_a_set_can_be_loaded_into_several_nodes_within_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(params, "datetime", SimpleNamespace(now=lambda zone: datetime(2026, 11, 27, 8, 5, tzinfo=zone)))
    stem = str(tmp_path / "one.undo-20261127T080500")
    for expected in (f"{stem}.toml", f"{stem}-2.toml", f"{stem}-3.toml"):
        undo = params.default_undo(str(tmp_path / "one.toml"))
        assert undo == expected
        Path(undo).touch()


def test_a_port_may_have_the_sign_that_separates_it_from_the_node() -> None:
    assert targets.split("5@/dev/line@2") == ("5", "/dev/line@2")
    assert targets.split("@/dev/line") == ("", "/dev/line")


def test_a_change_is_written_in_the_background(monkeypatch: pytest.MonkeyPatch) -> None:
    requested: list[tuple[Any, ...]] = []

    def prepare_write(handle: Any, item: str, values: Any, **options: Any) -> list[str]:
        requested.append((handle, item, values, options))
        return ["the send"]

    monkeypatch.setattr("busmaster.app.cli.params.ext.prepare_write", prepare_write)
    target: Any = SimpleNamespace(line=None, owned=False, handle="the handle")
    wanted: Any = SimpleNamespace(check_range=lambda item: None)
    send: Any = params.prepare_change(target, wanted, Change(Parameter(item="10"), 0, 1), "10")
    assert send == "the send"
    assert requested == [("the handle", "10", [1], {"priority": Priority.BACKGROUND})]
