"""Rfc2217Port through ser2net, a program of its own, with an emulated line behind it: stopped and killed meanwhile."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import pytest

from busmaster import Bus, BusError, Hcp2Controller, LineDown
from busmaster.app.diagnostics.adapters import Finding
from busmaster.app.diagnostics.examination import Patient, examine
from busmaster.emulator.line import Line
from busmaster.emulator.serve import serve_pty
from busmaster.emulator.traceable import TraceableMemory, traceable_value
from busmaster.registry import make_device
from busmaster.transport.rfc2217 import Rfc2217Port
from tests.patience import PATIENCE
from tests.ports import free_port

SER2NET = shutil.which("ser2net", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
pytestmark = pytest.mark.skipif(SER2NET is None, reason="ser2net is not installed")
NODES = (1, 2, 3, 4)
ELEMENTS = 100


class Ser2net:
    """The program, its port, and the process while it runs."""

    def __init__(self, folder: Path, device: str, accepter: str = "telnet(rfc2217),tcp") -> None:
        self.port = free_port()
        self._config = folder / "ser2net.yaml"
        self._config.write_text(
            f"connection: &line\n  accepter: {accepter},127.0.0.1,{self.port}\n"
            f"  connector: serialdev,{device},9600n81,local\n  options:\n    chardelay: false\n    max-connections: 1\n"
        )
        self.start()

    def start(self) -> None:
        """Start it. The client comes back to it by itself."""
        assert SER2NET is not None
        command = [SER2NET, "-n", "-u", "-c", str(self._config)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def kill(self) -> None:
        """End it as a crash or a loss of power would."""
        self.process.kill()
        self.process.wait(PATIENCE)

    async def stand_still(self, seconds: float) -> None:
        """Stop it for so long."""
        self.process.send_signal(signal.SIGSTOP)
        try:
            await asyncio.sleep(seconds)
        finally:
            self.process.send_signal(signal.SIGCONT)


@contextmanager
def ser2net(folder: Path, accepter: str = "telnet(rfc2217),tcp") -> Iterator[Ser2net]:
    """Run it before a line of traceable nodes."""
    devices = [make_device("hcp2", node, traceable=TraceableMemory(node)) for node in NODES]
    with serve_pty(Line(Hcp2Controller.profile.line, devices, paced=False)) as line:
        server = Ser2net(folder, line.path, accepter)
        try:
            yield server
        finally:
            server.kill()


async def connected(port: Rfc2217Port) -> Bus:
    """Return an open bus, as soon as the server listens."""
    async with asyncio.timeout(PATIENCE):
        while True:
            bus = Bus(port)
            try:
                return await bus.__aenter__()
            except BusError:
                await asyncio.sleep(0.02)


async def exchanges(server: Ser2net, count: int, disturb: dict[int, str]) -> tuple[int, int, list[float]]:
    """Read `count` values, of one node after another; at some counts the server is stopped or killed.

    Returns how many were wrong, how many reads failed, and how long each good one took.
    """
    wrong = failed = 0
    took: list[float] = []
    bus = await connected(Rfc2217Port("127.0.0.1", server.port, baudrate=57600))
    disturbing: set[asyncio.Task[None]] = set()
    try:
        nodes = {node: Hcp2Controller(bus, node) for node in NODES}
        while len(took) < count:
            match disturb.pop(len(took), ""):
                case "stop":
                    disturbing.add(asyncio.ensure_future(server.stand_still(0.3)))
                case "kill":
                    server.kill()
                    server.start()
            node, element = NODES[len(took) % len(NODES)], 1 + len(took) % ELEMENTS
            began = time.perf_counter()
            try:
                value = await nodes[node].read(element)
            except BusError:
                failed += 1
                await asyncio.sleep(0.001)
                continue
            took.append(time.perf_counter() - began)
            wrong += value != traceable_value(node, element, 0)
        await asyncio.gather(*disturbing)
    finally:
        await bus.__aexit__(None, None, None)
    return wrong, failed, took


@pytest.mark.slow
@pytest.mark.asyncio
async def test_no_value_is_wrong_while_the_server_is_stopped_and_killed(tmp_path: Path) -> None:
    with ser2net(tmp_path) as server:
        wrong, failed, took = await exchanges(server, 150, {50: "stop", 100: "kill"})
    assert wrong == 0
    assert failed > 0
    assert len(took) == 150


@pytest.mark.exhaustive
@pytest.mark.asyncio
async def test_ten_thousand_values_are_right_while_the_server_is_stopped_and_killed(tmp_path: Path) -> None:
    disturb = {count: "kill" if count % 1000 else "stop" for count in range(500, 10_000, 500)}
    with ser2net(tmp_path) as server:
        wrong, failed, took = await exchanges(server, 10_000, disturb)
    sys.stderr.write(f"{failed} failed reads, median {median(took) * 1e3:.3f} ms\n")
    assert wrong == 0
    assert failed > 0


@pytest.mark.slow
@pytest.mark.asyncio
async def test_doctor_says_what_the_server_reports(tmp_path: Path) -> None:
    told: list[Finding] = []
    with ser2net(tmp_path) as server:
        patient = Patient(Rfc2217Port("127.0.0.1", server.port, baudrate=57600), "hcp2", addresses=(1,))
        async with asyncio.timeout(PATIENCE):
            while not any(finding.topic == "open" for finding in told):  # until the server listens
                told.clear()
                await examine(patient, told.append)
    by_topic = {finding.topic: finding.what for finding in told}
    assert by_topic["open"] == "it opens at 57600 8N1"
    assert by_topic["line errors"] == "the server reports line errors"
    assert by_topic["modem lines"] == "the server reports CTS off, DSR off, RI off, CD off"


@pytest.mark.slow
@pytest.mark.asyncio
async def test_doctor_tries_other_rates_at_the_server(tmp_path: Path) -> None:
    told: list[Finding] = []
    with ser2net(tmp_path) as server:
        patient = Patient(Rfc2217Port("127.0.0.1", server.port, baudrate=19200), "hcp2", addresses=(1,))
        async with asyncio.timeout(PATIENCE):
            while not any(finding.topic == "open" for finding in told):  # until the server listens
                told.clear()
                await examine(patient, told.append)
    assert told[-1].what == "node 1: node 1 replies at 57600 8N1"


@pytest.mark.asyncio
async def test_a_server_without_rfc_2217_says_no(tmp_path: Path) -> None:
    said = "refused the connection"
    with ser2net(tmp_path, "telnet,tcp") as server:
        async with asyncio.timeout(PATIENCE):
            while "refused the connection" in said:  # until the server listens
                with pytest.raises(LineDown) as caught:
                    await Rfc2217Port("127.0.0.1", server.port, baudrate=57600).open(asyncio.Protocol)
                said = str(caught.value)
                await asyncio.sleep(0.02)
    assert "refuses RFC 2217 (telnet option 44)" in said
