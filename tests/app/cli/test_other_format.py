"""A node whose replies are longer than the protocol allows, but right in their check: no command blames the wiring."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

from busmaster.emulator.device import Device
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer, serve_tcp
from busmaster.registry import find, make_device
from busmaster.wire.checks import xor
from tests.app.cli.conftest import Command, ended_once

HCP2 = ("--protocol", "hcp2")
WHAT = "29 bytes came, right in their check but of another format: 24 characters of data where 20 are the most"
HINT = "this is not the wiring: check the protocol"


class Verbose(Device):
    """Answers every read of HCP2 element 1 with 24 characters."""

    request = b"\x07" + b"02" + b"\x02" + b"01" + b"\x05"

    def __init__(self) -> None:
        super().__init__(2)
        self.attentive = True
        self.heard = b""

    def hear_byte(self, byte: int, now: float) -> None:
        self.heard = self.heard[-len(self.request) :] + bytes([byte])
        if self.heard[:-1] == self.request:
            body = b"01" + b"1234.5678".ljust(24, b"0") + b"\x03"
            self.reply(b"\x02" + body + bytes([xor(body)]), now, 0.002)


@pytest.fixture
def verbose() -> Iterator[TcpServer]:
    line = Line(find("hcp2").profile.line, [Verbose(), make_device("hcp2", 3)], paced=False)
    with serve_tcp(line) as server:
        yield server


def test_a_read_says_that_the_format_differs(busmaster: Command, verbose: TcpServer) -> None:
    done = busmaster("read", verbose.path, *HCP2, "--node", "2", "1")
    assert (done.status, done.out) == (1, "")
    assert done.err.startswith(f"busmaster: node 2: {WHAT}, 3 attempts (read element 1); {HINT}")
    assert done.err.count("\n") == 1


@pytest.mark.slow
def test_a_scan_and_a_poll_say_so_too(busmaster: Command, verbose: TcpServer) -> None:
    found = busmaster("scan", verbose.path, *HCP2, "--nodes", "2-3")
    assert found.lines[0].startswith(f"2 read element 1: {WHAT}; {HINT}")
    options = ("--nodes", "2-3", "--items", "1", "--period", "1", "--json")
    polled = ended_once(lambda lines: len(lines) == 1, "poll", verbose.path, *HCP2, *options)
    error = json.loads(polled.lines[0])["samples"]["2/1"]["error"]
    assert error == WHAT


@pytest.mark.slow
def test_the_doctor_says_so_too(busmaster: Command, verbose: TcpServer) -> None:
    found = busmaster("doctor", verbose.path, *HCP2, "--nodes", "2-3", "--json")
    (node,) = [finding for finding in map(json.loads, found.lines) if finding["topic"] == "node 2"]
    assert WHAT in node["what"]
    assert node["advice"].startswith(HINT)
