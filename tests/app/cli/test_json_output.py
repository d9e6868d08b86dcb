"""docs/reference/json-output.md names every field that the commands print with --json, and no other."""

from __future__ import annotations

import json
import random
import re
import signal
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from socket import create_server
from typing import Any

import click
import pytest

from busmaster.app.cli import trend
from busmaster.app.cli.app import cli
from busmaster.app.cli.trend import Row, Trace
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer, serve_tcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import find, make_device
from tests.app.cli.conftest import ROOT, Command, owner_here, started

PAGE = ROOT / "docs" / "reference" / "json-output.md"
Printed = Callable[[str], list[str]]
FIELD = re.compile(r"\| `([^`]+)` \| ")
NAMED = {"samples", "worst_waits", "role_parts", "program_waits"}
"""Objects whose keys are names: the page has `*` for them."""
FILE = """\
title = "Slitter"
port = "PORT?baudrate=57600"

[nodes.winder]
protocol = "hcp2"
address = 1

[nodes.winder.points]
mode = { item = "12", labels = { 0 = "off" } }

[nodes.drive]
protocol = "microflex"
address = 5

[groups.all]
period = 0.2
points = ["winder/mode,20,21,22", "drive/status_word,50"]
"""
"""Element 50 is none of a MicroFlex: it refuses to read it."""
OTHERS = {
    "idle.toml": 'port = "/dev/ttyS0"\n[nodes.unit]\nprotocol = "modbus"\naddress = 1\n',
    "broken.toml": 'port = "/dev/ttyS0"\n[nodes.unit]\nprotocol = "modbus"\naddress = 1000\n',
    "merged.toml": """\
port = "/dev/ttyS0"
[nodes.unit]
protocol = "modbus"
address = 1
[groups.all]
period = 0.2
points = ["unit/holding:1,holding:2"]
[groups.busy]
period = 0.01
points = ["unit/holding:1"]
""",
}


@pytest.fixture
def port() -> Iterator[str]:
    """A line with both nodes of FILE."""
    devices = [make_device("hcp2", 1), make_device("microflex", 5)]
    line = Line(find("hcp2").profile.line, devices, chance=random.Random(1), paced=False)
    server: TcpServer
    with serve_tcp(line) as server:
        yield server.path


def documented() -> dict[str, set[str]]:
    """The fields of each section of the page."""
    sections = re.split(r"^### ", PAGE.read_text(), flags=re.MULTILINE)[1:]
    return {section.partition("\n")[0]: set(FIELD.findall(section)) for section in sections}


def fields(lines: Iterable[str]) -> set[str]:
    """The fields of the objects on these lines."""
    return {path for line in lines for path in paths(json.loads(line))}


def paths(value: Any, path: str = "") -> Iterator[str]:
    """The paths of the fields of an object, as the page writes them."""
    match value:
        case dict() if path in NAMED:
            for one in value.values():
                yield f"{path}.*"
                yield from paths(one, f"{path}.*")
        case dict():
            for key, inner in value.items():
                yield from paths(inner, f"{path}.{key}" if path else key)
        case list():
            for one in value:
                yield from paths(one, f"{path}[]")
        case _:
            yield path


@pytest.fixture
def file(port: str, tmp_path: Path) -> Path:
    path = tmp_path / "slitter.toml"
    path.write_text(FILE.replace("PORT", port))
    return path


@pytest.fixture
def printed(busmaster: Command, port: str, file: Path, tmp_path: Path) -> Printed:
    """Run a command, and return the lines that it prints."""
    names = {"PORT": port, "FILE": str(file), "FOLDER": str(tmp_path)}

    def run(command: str) -> list[str]:
        ran = busmaster(*(re.sub("|".join(names), lambda name: names[name[0]], word) for word in command.split()))
        assert ran.status in (0, 1), ran.err
        return ran.lines

    return run


HCP2, MICROFLEX = "--protocol hcp2", "--protocol microflex"
COMMANDS = {
    "read": (f"read PORT {HCP2} --node 1 20", f"read PORT {MICROFLEX} --node 5 status_word", "read FILE winder/mode"),
    "poll, run": (f"poll PORT {HCP2} --nodes 1 --items 20 --period 0.1 --seconds 0.2", "run FILE --seconds 0.5"),
    "write": (f"write PORT {HCP2} --node 1 20=5 21=6,7", "write FILE winder/20=5"),
    "do": (f"do 5@PORT disable {MICROFLEX}",),
    "scan": (f"scan PORT {HCP2} --nodes 1",),
    "check": ("check FOLDER/idle.toml", "check FOLDER/broken.toml"),
    "plan": ("plan FILE", "plan FOLDER/merged.toml"),
    "items": ("items hcp2", "items microflex"),
}


@pytest.mark.parametrize("section", COMMANDS)
def test_each_field_is_on_the_page(section: str, printed: Printed, tmp_path: Path) -> None:
    for name, text in OTHERS.items():
        (tmp_path / name).write_text(text)
    lines = [line for command in COMMANDS[section] for line in printed(f"{command} --json")]
    assert fields(lines) == documented()[section]


@pytest.mark.slow
def test_each_field_of_a_finding_is_on_the_page(printed: Printed) -> None:
    assert fields(printed(f"doctor PORT {HCP2} --nodes 1 --json")) == documented()["doctor"]


def test_each_field_of_a_running_line_is_on_the_page(printed: Printed, file: Path) -> None:
    with owner_here(file):
        assert fields(printed("status --json")) == documented()["status"]


def test_each_field_of_a_difference_is_on_the_page(printed: Printed) -> None:
    printed(f"params save PORT 1 -o FOLDER/one.toml --items 20 {HCP2}")
    printed(f"write PORT {HCP2} --node 1 20=7")
    assert fields(printed(f"params diff FOLDER/one.toml 1@PORT {HCP2} --json")) == documented()["params diff"]


def test_each_field_of_a_replay_is_on_the_page(printed: Printed) -> None:
    printed(f"read PORT {HCP2} --node 1 20 --capture FOLDER/line.pcapng")
    assert fields(printed("replay FOLDER/line.pcapng --json")) == documented()["replay"]


def test_each_field_of_a_trend_is_on_the_page(printed: Printed) -> None:
    nothing: Any = None
    lost = Row(0.0, 0.0, Trace("winder/mode", nothing, nothing), None, "no reply")
    lines = [*printed("trend FILE winder/mode drive/status_word --seconds 0.3 --json"), trend.fields(lost)]
    assert fields(lines) == documented()["trend"]


@pytest.mark.slow
def test_each_field_of_a_frame_is_on_the_page(tmp_path: Path) -> None:
    with create_server(("127.0.0.1", 0)) as server:
        port = f"socket://127.0.0.1:{server.getsockname()[1]}?baudrate=57600"
        with started("monitor", port, "--protocol", "hcp2", "--json") as process:
            line, _ = server.accept()
            with line:
                assert process.stdout is not None
                line.sendall(hcp2.Read(1).open(2, hcp2.PROFILE.timings).request)
                assert fields([process.stdout.readline()]) == documented()["monitor"]
                process.send_signal(signal.SIGINT)
                process.communicate()


def test_each_command_with_objects_is_on_the_page() -> None:
    sections = {name for section in documented() for name in section.split(", ")}
    assert sections | {"bench"} == set(with_json(cli))


def with_json(group: click.Group, before: str = "") -> Iterator[str]:
    """The commands that have --json."""
    for name in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), name)
        if isinstance(command, click.Group):
            yield from with_json(command, f"{before}{name} ")
        elif command is not None and any("--json" in parameter.opts for parameter in command.params):
            yield before + name
