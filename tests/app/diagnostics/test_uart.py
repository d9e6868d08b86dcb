"""What a UART found wrong: as the doctor hears it, and in words."""

from __future__ import annotations

import asyncio
import random
import termios

import pytest

from busmaster.app.diagnostics import uart
from busmaster.app.diagnostics.adapters import Finding
from busmaster.app.diagnostics.examination import OPENING, Patient, examine
from busmaster.app.diagnostics.probing import opened
from busmaster.arbiter.counters import DriverErrors, Mark
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import make_device
from busmaster.testing import run_in_virtual_time
from busmaster.transport.kernel import OpenPort
from busmaster.transport.serial_port import SerialPort
from tests.transport.fakes import plugged

NOTHING = DriverErrors(0, 0, 0, 0, 0)


def examined() -> list[str]:
    """Everything that is said of the UART of a line with one node."""
    findings: list[Finding] = []
    line = Line(hcp2.PROFILE.line, [make_device("hcp2", 1)], chance=random.Random(1))
    run_in_virtual_time(examine(Patient(MemoryPort(line), "hcp2", addresses=(1,), named=True), findings.append))
    return [f"{finding.what}; {finding.advice}" for finding in findings if finding.topic == "uart"]


def test_of_a_port_that_cannot_tell_nothing_is_said() -> None:
    assert examined() == []


def test_of_a_driver_that_counted_nothing_it_is_said_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(OpenPort, "errors", lambda _: NOTHING)
    assert examined() == ["no byte was damaged or lost; "]


def test_errors_from_the_opening_of_the_port_are_not_faults_of_the_line(monkeypatch: pytest.MonkeyPatch) -> None:
    resets: list[float] = []
    monkeypatch.setattr(OpenPort, "reset", lambda _: resets.append(asyncio.get_running_loop().time()))
    monkeypatch.setattr(OpenPort, "errors", lambda _: NOTHING if resets else DriverErrors(3, 0, 0, 0, 0))
    assert examined() == ["no byte was damaged or lost; "]
    [at] = resets
    assert at >= OPENING


def test_each_kind_of_error_says_what_to_look_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(OpenPort, "errors", lambda _: DriverErrors(7, 1, 2, 1, 3))
    framing, parity, breaks, overruns, lost = examined()
    assert framing.startswith("7 framing errors; wrong baud rate, or no termination")
    assert parity.startswith("1 parity error; wrong parity or number of data bits")
    assert breaks.startswith("2 breaks; swapped wires A and B")
    assert overruns.startswith("1 byte lost in the UART; ")
    assert lost.startswith("3 bytes lost in the driver; ")


def test_where_the_driver_counts_nothing_the_marks_are_told() -> None:
    for driver in (None, NOTHING):
        counts = uart.damage(2, 1, driver)
        assert uart.damage_text(counts) == "2 parity or framing errors, 1 break"
    assert uart.damage_text(uart.damage(2, 1, DriverErrors(2, 0, 1, 0, 0))) == "2 framing errors, 1 break"
    assert uart.damage_text(uart.damage(0, 0, None)) == ""


@pytest.mark.asyncio
async def test_the_doctor_hears_damaged_bytes_and_counts_them() -> None:
    with plugged() as pty_master:
        async with opened(SerialPort(pty_master.path, baudrate=57600)) as wire:
            assert wire.transport is not None
            descriptor = wire.transport.get_extra_info("serial").fileno()
            settings = termios.tcgetattr(descriptor)
            settings[0] = 0  # what is written at the other end comes as the escape that it is
            termios.tcsetattr(descriptor, termios.TCSANOW, settings)
            pty_master.write(b"a\xff\x00b\xff\x00\x00c")
            assert await wire.hear_all(2.0) == b"ab\x00c"
            assert wire.marked == {Mark.DAMAGED: 1, Mark.BREAK: 1}
