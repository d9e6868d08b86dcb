"""What a listener makes of another master's telegrams: one of them may tell several points, written or read."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from busmaster.app.cli.overheard import HeardGroup, Overheard
from busmaster.app.config import emulated_line
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.arbiter.tap import Attempt
from busmaster.capture.decode import Decoder
from busmaster.emulator.memory import MemoryPort
from busmaster.protocols.ct_ansi.handle import CtAnsiDrive
from busmaster.protocols.dc104.handle import Dc104Drive
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.mentor.handle import MentorDrive
from busmaster.protocols.modbus.handle import ModbusUnit
from busmaster.protocols.msc.handle import MscController
from busmaster.registry import find
from busmaster.testing.virtual_time import run_in_virtual_time

FILE = """
port = "/dev/ttyUSB0"
[nodes.drive]
protocol = "{kind}"
{options}
points = {{ a = {{ item = "{a}", factor = 0.5 }}, b = {{ item = "{b}" }} }}
[groups.all]
period = 3600
points = ["drive/a", "drive/b"]
"""
Master = Callable[[Any], AsyncIterator[None]]
"""Yields when the listener is to begin."""


class Heard:
    """A tap that tells a listener nothing but bytes: not who spoke, nor what was meant."""

    def __init__(self, kind: str, overheard: Overheard) -> None:
        self._decoder = Decoder(find(kind).protocol.dialect())
        self._overheard = overheard

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        for frame in self._decoder.feed(data, now):
            self._overheard.heard(frame)

    received = transmitted

    def attempted(self, attempt: Attempt, /) -> None:
        pass


def heard(kind: str, options: str, a: str, b: str, master: Master) -> dict[str, Any]:
    """What is heard of points a, which is half of what the line carries, and b."""
    file = read(Source("line.toml", FILE.format(kind=kind, options=options, a=a, b=b)))
    listener = ConfiguredLine(file, outputs=False)
    points = listener.members("all")
    overheard = Overheard(find(kind).protocol, points, lambda: 0.0)
    overheard.groups.append(HeardGroup("all", 3600, points, 0.0))

    async def story() -> None:
        random.seed(1)
        line = ConfiguredLine(file, port=MemoryPort(emulated_line(file)), outputs=False, tap=Heard(kind, overheard))
        async with line.bus:
            async for _ in master(line.nodes["drive"]):
                overheard.groups[0].turn(0.0, 0.0)  # what was said so far does not count

    run_in_virtual_time(story())
    snapshot = overheard.groups[0].turn(0.0, 0.0)
    return {point.item: sample.value for point, sample in snapshot.samples.items()} if snapshot else {}


async def comms_list(drive: Hcp2Controller) -> AsyncIterator[None]:
    yield
    await drive.write(10, 20.0, 3.0)


async def comms_reads(drive: Hcp2Controller) -> AsyncIterator[None]:
    await drive.write(10, 20.0, 3.0)
    yield
    await drive.read(10)


async def modbus_block(drive: ModbusUnit) -> AsyncIterator[None]:
    yield
    await drive.write("holding:99", 1, 20, 3, 4)


async def modbus_block_read(drive: ModbusUnit) -> AsyncIterator[None]:
    await drive.write("holding:99", 1, 20, 3, 4)
    yield
    await drive.read("holding:90:30")


async def modbus_half(drive: ModbusUnit) -> AsyncIterator[None]:
    yield
    await drive.read("holding:100:2")


async def modbus_coils(drive: ModbusUnit) -> AsyncIterator[None]:
    yield
    await drive.write("coil:4", 1, 0, 1)


async def msc_block(drive: MscController) -> AsyncIterator[None]:
    yield
    await drive.write_block(1992, [0, 0, 20, 3] + [0] * 28)


async def msc_block_read(drive: MscController) -> AsyncIterator[None]:
    await drive.write(2000, 20)
    await drive.write(2004, 3)
    yield
    await drive.read(1996, 32)


async def msc_flags(drive: MscController) -> AsyncIterator[None]:
    yield
    await drive.set_flag(200)
    await drive.clear_flag(201)


async def msc_all_flags(drive: MscController) -> AsyncIterator[None]:
    await drive.set_flag(200)
    yield
    await drive.flags()


async def mentor_writes(drive: MentorDrive) -> AsyncIterator[None]:
    yield
    await drive.write("1.17", 20)
    await drive.write("1.18", 3)


async def mentor_run(drive: MentorDrive) -> AsyncIterator[None]:
    await drive.write("1.17", 20)
    await drive.write("1.18", 3)
    yield
    await drive.read("1.17", 2)


async def mentor_backwards(drive: MentorDrive) -> AsyncIterator[None]:
    await drive.write("1.17", 20)
    await drive.write("1.18", 3)
    yield
    await drive.read("1.18", 2, step=-1)


async def mentor_to_all(drive: MentorDrive) -> AsyncIterator[None]:
    """Nobody says that he has it."""
    yield
    await drive.write_all("1.17", 20)


async def ct_ansi_writes(drive: CtAnsiDrive) -> AsyncIterator[None]:
    yield
    await drive.write("1.21", 20)
    await drive.write("1.22", 3)


async def dc104_writes(drive: Dc104Drive) -> AsyncIterator[None]:
    yield
    await drive.write(12, 20)
    await drive.write(13, 3)


async def dc104_read(drive: Dc104Drive) -> AsyncIterator[None]:
    await drive.write(12, 20)
    yield
    await drive.read(12)


BOTH = {"a": 10, "b": 3}
STORIES: list[tuple[str, str, str, str, Master, dict[str, Any]]] = [
    ("hcp2", "address = 5", "10", "11", comms_list, BOTH),
    ("hcp2", "address = 5", "10", "11", comms_reads, {"a": 10}),
    ("hcp", "address = 5", "10", "11", comms_list, BOTH),
    ("modbus", "address = 17", "holding:100", "holding:101", modbus_block, BOTH),
    ("modbus", "address = 17", "holding:100", "holding:101", modbus_block_read, BOTH),
    ("modbus", "address = 17", "holding:100", "holding:101:2", modbus_half, {"a": 0}),
    ("modbus", "address = 17", "coil:5", "coil:6", modbus_coils, {"a": False, "b": True}),
    ("msc", "address = 3\naddress_step = 4", "2000", "2004", msc_block, BOTH),
    ("msc", "address = 3\naddress_step = 4", "2000", "2004", msc_block_read, BOTH),
    ("msc", "address = 3", "1996", "2000", msc_block_read, {"a": 0}),
    ("msc", "address = 3", "flag:200", "flag:201", msc_flags, {"a": True, "b": False}),
    ("msc", "address = 3", "flag:200", "flag:201", msc_all_flags, {"a": True, "b": False}),
    ("mentor", "address = 14", "1.17", "1.18", mentor_writes, BOTH),
    ("mentor", "address = 14", "1.17", "1.18", mentor_run, BOTH),
    ("mentor", "address = 14", "1.17", "1.18", mentor_backwards, BOTH),
    ("mentor", "address = 14", "1.17", "1.18", mentor_to_all, {}),
    ("ct-ansi", "address = 14", "1.21", "1.22", ct_ansi_writes, BOTH),
    ("dc104", "", "12", "13", dc104_writes, BOTH),
    ("dc104", "", "12", "13", dc104_read, {"a": 10}),
]


@pytest.mark.parametrize(
    ("kind", "options", "a", "b", "master", "values"),
    STORIES,
    ids=[f"{story[0]} {getattr(story[4], '__name__', '')} {story[1][-8:]}" for story in STORIES],
)
def test_one_telegram_tells_all_its_points(
    kind: str, options: str, a: str, b: str, master: Master, values: dict[str, Any]
) -> None:
    assert heard(kind, options, a, b, master) == values
