"""Controllers that answer after the reply window: their values are delivered, and the commands say what to try."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.serve import PtyServer, TcpServer, serve_pty, serve_tcp
from busmaster.registry import find, make_device
from tests.app.cli.conftest import Command

LATE = Delay(0.13)
TOO_LATE = Delay(0.2)
DELAYS = {1: 0.102, 2: 0.105, 3: 0.108}
"""Seconds after which controllers answer whose document allows 150 ms; the window is 100 ms. A busy machine adds some:
tests/bus/test_late_replies.py has the last millisecond, in virtual time."""


@pytest.fixture
def slow() -> Iterator[TcpServer]:
    """Two HCP controllers whose replies begin after 130 ms, 30 ms beyond the window, and after 200 ms."""
    devices = [make_device("hcp", 2, delay=LATE), make_device("hcp", 4, delay=TOO_LATE)]
    line = Line(find("hcp").profile.line, devices, chance=random.Random(1), paced=False)
    with serve_tcp(line) as server:
        yield server


@pytest.fixture
def allowed() -> Iterator[PtyServer]:
    """Three controllers that are as late as their document allows."""
    devices = [make_device("hcp2", address, delay=Delay(delay)) for address, delay in DELAYS.items()]
    with serve_pty(Line(find("hcp2").profile.line, devices, chance=random.Random(1))) as server:
        yield server


def test_a_late_value_is_read_and_what_to_try_is_said(busmaster: Command, slow: TcpServer) -> None:
    done = busmaster("read", slow.path, "--protocol", "hcp", "--node", "2", "1", "--retries", "0")
    assert (done.status, done.out) == (0, "1 0\n")
    assert "node 2: late reply, 1" in done.err
    assert "; try --timeout 2" in done.err


def test_a_read_of_a_node_beyond_its_max_reply_delay_says_that_it_is_late_and_what_to_try(
    busmaster: Command, slow: TcpServer
) -> None:
    done = busmaster("read", slow.path, "--protocol", "hcp", "--node", "4", "1", "--retries", "0")
    assert done.status == 1
    assert "node 4: no reply within 150 ms" in done.err
    assert "late reply, " in done.err
    assert "; try --timeout 3" in done.err
    assert "check the node's address" not in done.err


def test_of_a_node_that_is_not_there_nothing_is_said_of_max_reply_delay(busmaster: Command, slow: TcpServer) -> None:
    done = busmaster("read", slow.path, "--protocol", "hcp", "--node", "3", "1", "--retries", "0")
    assert done.status == 1
    assert "late" not in done.err
    assert "check the node's address" in done.err


def test_a_write_that_is_confirmed_late_says_what_to_try(busmaster: Command, slow: TcpServer) -> None:
    done = busmaster("write", slow.path, "--protocol", "hcp", "--node", "2", "1=5")
    assert (done.status, done.out) == (0, "1 ok\n")
    assert "node 2: late reply, 1" in done.err
    assert "; try --timeout 2" in done.err


@pytest.mark.slow
def test_a_scan_finds_who_is_late_and_names_who_is_too_late(busmaster: Command, slow: TcpServer) -> None:
    done = busmaster("scan", slow.path, "--protocol", "hcp", "--nodes", "1-4")
    assert done.status == 0
    assert done.out.startswith("2 read element 1: 0\n")
    assert "node 2: late reply, 1" in done.err
    assert "node 4: late reply, " in done.err


@pytest.mark.slow
def test_r2_poll_prints_every_value_of_nodes_that_are_as_late_as_their_document_allows(
    busmaster: Command, allowed: PtyServer
) -> None:
    done = busmaster(
        *("poll", allowed.path, "--protocol", "hcp2", "--nodes", "1-3"),
        *("--items", "1", "--period", "0.6", "--seconds", "2.2", "--json"),
    )
    assert done.status == 0
    cycles = [json.loads(line) for line in done.lines]
    assert len(cycles) >= 2
    values = [value for cycle in cycles for value in cycle["samples"].values()]
    assert len(values) == 3 * len(cycles)
    assert all(value["value"] == 0 and value["late"] for value in values), values
    for node in DELAYS:
        assert f"node {node}: late reply, 1" in done.err
    assert "; try --timeout 200" in done.err
    assert "is down" not in done.err


@pytest.mark.slow
def test_r2_run_delivers_every_value_of_such_nodes_and_says_what_to_write(
    busmaster: Command, allowed: PtyServer, tmp_path: Path
) -> None:
    file = tmp_path / "late.toml"
    file.write_text(
        f'port = "{allowed.path}"\n'
        + "".join(
            f'[nodes.drive{node}]\nprotocol = "hcp2"\naddress = {node}\n[nodes.drive{node}.points.state]\nitem = "1"\n'
            for node in DELAYS
        )
        + '[groups.states]\nperiod = 0.6\npoints = ["drive1/state", "drive2/state", "drive3/state"]\n'
    )
    done = busmaster("run", str(file), "--seconds", "2.2", "--json")
    assert done.status == 0
    values = [value for line in done.lines for value in json.loads(line)["samples"].values()]
    assert len(values) >= 6
    assert all(value["value"] == 0 and value["late"] for value in values), values
    for node in DELAYS:
        assert f"drive{node}: late reply, 1" in done.err
    assert "set timing = { window = 0.2 } in its section" in done.err


@pytest.mark.slow
def test_a_scan_in_hcp2_tries_hcp_too(busmaster: Command) -> None:
    line = Line(find("hcp").profile.line, [make_device("hcp", 2), make_device("hcp2", 3)], paced=False)
    with serve_tcp(line) as server:
        done = busmaster("scan", server.path, "--protocol", "hcp2", "--nodes", "1-4", "--timeout", "1000")
    assert done.out == "3 read element 1: 0\n"
    assert "node 2 replies in Host Comms Protocol; use --protocol hcp\n" in done.err
    assert "node 3: late reply" not in done.err
