"""A controller that answers, but after the window: the commands say so, and what to try."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest

from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer, serve_tcp
from busmaster.registry import find, make_device
from tests.cli.conftest import Command

LATE = Delay(0.13)


@pytest.fixture
def slow() -> Iterator[TcpServer]:
    """An HCP controller whose replies begin after 130 ms, 30 ms beyond the window."""
    line = Line(find("hcp").profile.line, [make_device("hcp", 2, delay=LATE)], chance=random.Random(1), paced=False)
    with serve_tcp(line) as server:
        yield server


def test_a_read_of_a_late_node_says_that_it_is_late_and_what_to_try(busmaster: Command, slow: TcpServer) -> None:
    done = busmaster("read", slow.path, "--protocol", "hcp", "--node", "2", "1", "--retries", "0")
    assert done.status == 1
    assert "node 2: no reply within 100 ms" in done.err
    assert "it answers late, after 1" in done.err
    assert ": try --timeout " in done.err
    assert "check the node's address" not in done.err


def test_of_a_node_that_is_not_there_nothing_is_said_of_lateness(busmaster: Command, slow: TcpServer) -> None:
    done = busmaster("read", slow.path, "--protocol", "hcp", "--node", "3", "1", "--retries", "0")
    assert done.status == 1
    assert "late" not in done.err
    assert "check the node's address" in done.err


def test_a_scan_names_who_is_late(busmaster: Command, slow: TcpServer) -> None:
    done = busmaster("scan", slow.path, "--protocol", "hcp", "--nodes", "1-3")
    assert (done.status, done.out) == (0, "")
    assert "node 2: it answers late, after 1" in done.err


def test_a_scan_in_hcp2_tries_hcp_too(busmaster: Command) -> None:
    line = Line(find("hcp").profile.line, [make_device("hcp", 2), make_device("hcp2", 3)], paced=False)
    with serve_tcp(line) as server:
        done = busmaster("scan", server.path, "--protocol", "hcp2", "--nodes", "1-4", "--timeout", "1000")
    assert done.out == "3 read element 1: 0\n"
    assert "node 2 answers in Host Comms Protocol: use --protocol hcp\n" in done.err
    assert "node 3 answers" not in done.err
