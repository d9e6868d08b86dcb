"""The pytest fixtures that busmaster ships, used as an application's tests would use them."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable, Coroutine
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from busmaster import Bus, BusError, Hcp2Controller, LineDown, MentorDrive, NoReply
from busmaster.emulator.device import Delay
from busmaster.emulator.faults import Faults
from busmaster.emulator.memory import MemoryPort
from busmaster.testing.emulated_process import EmulatedLine, from_json, in_own_process
from busmaster.testing.fixtures import LineFactory, emulated_line, virtual_time

__all__ = ["emulated_line", "virtual_time"]


def test_an_application_is_tested_in_virtual_time(
    virtual_time: Callable[[Coroutine[Any, Any, float]], float], emulated_line: LineFactory
) -> None:
    async def application() -> float:
        async with Bus(MemoryPort(emulated_line("hcp2", [5]))) as bus:
            axis = Hcp2Controller(bus, 5)
            await axis.write(1, 123.456)
            await asyncio.sleep(3600)
            return await axis.read(1)

    assert virtual_time(application()) == 123.456


def test_a_device_may_have_faults(
    virtual_time: Callable[[Coroutine[Any, Any, None]], None], emulated_line: LineFactory
) -> None:
    async def application() -> None:
        async with Bus(MemoryPort(emulated_line("hcp2", [5], faults=["dead=1"]))) as bus:
            with pytest.raises(NoReply):
                await Hcp2Controller(bus, 5).read(1)

    virtual_time(application())


def test_each_of_several_devices_has_its_own_faults_and_delay(emulated_line: LineFactory) -> None:
    line = emulated_line("hcp2", iter([5, 6]), delay=Delay(0.5), faults=iter(["lost=0.25", "late=1"]))
    assert [device.address for device in line.devices] == [5, 6]
    for device in line.devices:
        assert (device.delay, device.faults.lost, device.faults.late) == (Delay(0.5), 0.25, 1.0)
    line.devices[0].faults.lost = 0.0
    assert line.devices[1].faults.lost == 0.25
    [plain] = emulated_line("dc104", [0]).devices
    assert (plain.delay, plain.faults) == (Delay(), Faults())


def test_a_line_of_a_seed_has_the_same_faults_each_time(
    virtual_time: Callable[[Coroutine[Any, Any, Any]], Any], emulated_line: LineFactory
) -> None:
    async def failures(seed: int) -> list[int]:
        found = []
        async with Bus(MemoryPort(emulated_line("hcp2", [5], faults=["lost=0.5"], seed=seed))) as bus:
            axis = Hcp2Controller(bus, 5)
            for number in range(20):
                try:
                    await axis.read(1, retries=0)
                except BusError:
                    found.append(number)
                    await asyncio.sleep(10)
        return found

    one, again, other = (virtual_time(failures(seed)) for seed in (1, 1, 2))
    assert one == again != other


def test_options_of_a_line_are_passed_on(emulated_line: LineFactory) -> None:
    assert emulated_line("hcp2", [5], paced=False).paced is False
    assert emulated_line("hcp2", [5]).paced is True
    assert emulated_line("mentor", [11]).settings == MentorDrive.profile.line


# the process that serves a line


def test_a_line_is_handed_to_its_process_unchanged() -> None:
    line = EmulatedLine("hcp2", (1, 2), 9600, (0.001, 0.003), ("lost=0.1",), 7)
    assert from_json(json.dumps(asdict(line))) == line
    assert (line.settings().baudrate, line.settings().framing) == (9600, "8N1")
    assert EmulatedLine("hcp2").settings() == Hcp2Controller.profile.line
    made = line.line()
    assert [(device.address, device.delay, device.faults.lost) for device in made.devices] == [
        (1, Delay(0.001, 0.003), 0.1),
        (2, Delay(0.001, 0.003), 0.1),
    ]
    assert made.settings.baudrate == 9600
    [later] = EmulatedLine("msc", (3,), delay=(0.004, 0.004)).line().devices
    assert later.packet_delay == Delay(0.004, 0.004)  # type: ignore[attr-defined]  # of an MSC


def test_a_process_that_does_not_start_is_reported_and_one_that_serves_is_ended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program, ended = tmp_path / "python", tmp_path / "ended"
    program.write_text(f"#!/bin/sh\necho /dev/pts/99\ncat\ntouch {ended}\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    with suppress(ZeroDivisionError), in_own_process(EmulatedLine("hcp2")) as path:
        assert (path, ended.exists()) == ("/dev/pts/99", False)
        raise ZeroDivisionError
    assert ended.exists()
    program.write_text("#!/bin/sh\n")
    with (
        pytest.raises(LineDown, match="the emulated line did not start") as failed,
        in_own_process(EmulatedLine("hcp2")),
    ):
        pass
    assert failed.value.hint == "its own message is above, on standard error"
