"""`busmaster discover` on real ports: it asks first, finds what is there, and writes a file that runs."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from busmaster.app.cli.discover import what_to_try
from busmaster.app.config import load
from busmaster.contract.profile import LineSettings
from busmaster.emulator.line import Line
from busmaster.emulator.serve import PtyServer, serve_pty, serve_tcp
from busmaster.registry import find, make_device
from busmaster.transport.rfc2217 import Rfc2217Port
from tests.app.cli.conftest import Command, ended_once

HCP2 = ("--protocol", "hcp2", "--nodes", "1-3")


@pytest.fixture
def unknown() -> Iterator[PtyServer]:
    """A line at a rate that is not the protocol's usual one."""
    devices = [make_device("hcp2", node) for node in (1, 3)]
    with serve_pty(Line(LineSettings(9600), devices, chance=random.Random(1), paced=False)) as server:
        yield server


@pytest.mark.slow
def test_what_it_finds_is_a_file_that_runs(busmaster: Command, unknown: PtyServer, tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    done = busmaster("discover", unknown.path, *HCP2, "--yes", "-o", str(path))
    assert (done.status, done.out) == (0, ""), done.err
    assert "found Host Comms Protocol 2 at 9600 8N1, nodes 1, 3" in done.err
    file = load(path)
    assert file.port.settings == LineSettings(9600)
    assert {name: node.address for name, node in file.nodes.items()} == {"node1": 1, "node3": 3}
    run = ended_once(
        lambda lines: json.loads(lines[-1])["samples"]["node1/1"]["value"] == 0, "run", str(path), "--json"
    )
    assert run.status == 130, run.err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "nodes"), [("microflex", tuple(range(1, 11))), ("ct-ansi", (12, 23)), ("modbus", (5, 17, 18))]
)
def test_every_node_of_the_protocol_is_found(
    busmaster: Command, tmp_path: Path, name: str, nodes: tuple[int, ...]
) -> None:
    path, settings = tmp_path / "line.toml", find(name).profile.line
    line = Line(settings, [make_device(name, node) for node in nodes], chance=random.Random(1), paced=False)
    with serve_pty(line) as server:
        port = f"{server.path}?baudrate={settings.baudrate}&bytesize={settings.bytesize}&parity={settings.parity}"
        done = busmaster("discover", port, "--protocol", name, "--yes", "-o", str(path))
    assert done.status == 0, done.err
    found = {node.address: node.protocol for node in load(path).nodes.values()}
    assert found == dict.fromkeys(nodes, name)
    assert "the other addresses are tried too" in done.err
    assert "not tried" not in done.err


def test_behind_rfc_2217_the_settings_of_the_line_are_tried_as_on_a_serial_port() -> None:
    port, tried = what_to_try("rfc2217://server:4001?dtr=0", ["hcp2"], None)
    assert port == Rfc2217Port("server", 4001, baudrate=9600, dtr=False)
    assert len({step.settings for step in tried}) == 5
    _, tried = what_to_try("rfc2217://server:4001?baudrate=9600&parity=N", ["hcp2"], None)
    assert [step.settings for step in tried] == [LineSettings(9600)]


@pytest.mark.slow
def test_without_a_file_it_is_printed(busmaster: Command, unknown: PtyServer) -> None:
    done = busmaster("discover", f"{unknown.path}?baudrate=9600", *HCP2, "--yes")
    assert done.status == 0
    assert done.out.startswith(f"# What answered on {unknown.path}: Host Comms Protocol 2 at 9600 8N1, nodes 1, 3.\n")
    assert "then 3 reads, at 9600 8N1, in Host" in done.err


def test_the_plan_is_told_and_nothing_is_sent_unless_somebody_says_yes(busmaster: Command, unknown: PtyServer) -> None:
    done = busmaster("discover", unknown.path, *HCP2)
    assert done.status == 2
    assert "listen for 3 s; then 15 reads, at 5 settings of the line, in Host Comms Protocol 2" in done.err
    assert "s if no node replies" in done.err
    assert (
        "confirmation required, but there is no terminal; nothing was sent; use --yes to skip the question" in done.err
    )
    assert unknown.line.host is None


def test_a_file_that_is_there_is_not_overwritten(busmaster: Command, unknown: PtyServer, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("mine")
    done = busmaster("discover", unknown.path, *HCP2, "--yes", "-o", str(path))
    assert done.status == 2
    assert "exists and is not overwritten" in done.err
    assert path.read_text() == "mine"


@pytest.mark.slow
def test_where_nobody_answers_the_status_is_1(busmaster: Command) -> None:
    with serve_tcp(Line(LineSettings(9600), [], paced=False)) as server:
        done = busmaster("discover", server.path, "--protocol", "dc104", "--yes")
    assert (done.status, done.out) == (1, "")
    assert "then 1 read, at the server's own rate, in DC104-SER" in done.err
    assert "no node replied" in done.err
    assert "not tried" not in done.err, "it has no addresses"


@pytest.mark.slow
def test_what_was_not_asked_is_printed(busmaster: Command) -> None:
    with serve_tcp(Line(LineSettings(9600), [], paced=False)) as server:
        done = busmaster("discover", server.path, "--protocol", "msc", "--yes")
    assert done.status == 1
    assert "not tried: msc 9-15" in done.err


@pytest.mark.slow
def test_a_device_server_is_searched_at_the_rate_that_it_has(busmaster: Command) -> None:
    with serve_tcp(Line(LineSettings(9600), [make_device("mentor", 2)], paced=False)) as server:
        done = busmaster("discover", server.path, "--protocol", "mentor", "--nodes", "2", "--yes")
    assert done.status == 0
    assert f"host = {server.host!r}".replace("'", '"') in done.out
    assert "baudrate" not in done.out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("unix:/tmp/x.sock",), "discover needs the port itself"),
        (("/dev/null?baud=1",), "no such port option 'baud'"),
        (("/dev/null", "--protocol", "msc", "--nodes", "99"), "nothing is left to try"),
    ],
)
def test_wrong_usage_is_status_2(busmaster: Command, arguments: tuple[str, ...], told: str) -> None:
    done = busmaster("discover", *arguments, "--yes")
    assert done.status == 2
    assert told in done.err


def test_a_port_that_is_not_there_is_an_error_of_the_line(busmaster: Command) -> None:
    done = busmaster("discover", "/dev/no-such-port", "--protocol", "dc104", "--yes")
    assert done.status == 1
    assert "does not exist" in done.err
