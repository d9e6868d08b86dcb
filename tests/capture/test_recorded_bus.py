"""A bus with a recorder as its tap: what it did is in the file, and reads back the same."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path

import anyio
import pytest

from busmaster.bus.bus import Bus
from busmaster.capture.pcapng import Outcome, Packet, read_packets
from busmaster.capture.recorder import Recorder
from busmaster.capture.replay import replay_packets
from busmaster.contract.frames import Direction
from busmaster.contract.profile import LineSettings
from busmaster.emulator.line import Echo, Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import NoReply, Refused
from busmaster.protocols.hcp.handle import HcpController
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.hcp2.microflex_handle import MicroFlexDrive
from busmaster.registry import find, make_device
from busmaster.testing.virtual_time import run_in_virtual_time
from tests.stories import in_use


async def record(path: Path, echo: bool) -> list[Packet]:
    devices = [make_device("hcp", 1), make_device("hcp2", 2), make_device("microflex", 7)]
    line = Line(LineSettings(57600), devices, echo=Echo() if echo else None)
    with Recorder(path, echo=echo) as tap:
        async with Bus(MemoryPort(line), tap=tap) as bus:
            in_use(bus)
            old, new, drive = HcpController(bus, 1), Hcp2Controller(bus, 2), MicroFlexDrive(bus, 7)
            await old.write(10, 1.5, -2)
            assert await old.read(11) == -2
            await drive.status_word.read()
            with pytest.raises(Refused):
                await new.write(100, 3)
            with pytest.raises(NoReply):
                await Hcp2Controller(bus, 9).read(1)
            await new.axis(0).position.read()
            axes = bus.poll_group("axes", period=0.05, points=[new.axis(0).position, new.axis(1).position])
            await anext(aiter(axes))
    with path.open("rb") as file:
        return list(read_packets(file))


@pytest.mark.asyncio
@pytest.mark.parametrize("echo", [False, True])
async def test_every_exchange_of_a_bus_is_recorded_with_its_outcome(tmp_path: Path, echo: bool) -> None:
    packets = await record(tmp_path / "line.pcapng", echo)
    assert [packet.micros for packet in packets] == sorted(packet.micros for packet in packets)
    exchanges = list(replay_packets(packets))
    assert not [f"{one.command}: {one.recorded}, {one.now}" for one in exchanges if one.changed or not one.judged]
    assert [(one.node, one.command, one.recorded.outcome) for one in exchanges][:4] == [
        (1, "write elements 10-11 = 1.5,-2", Outcome.OK),
        (1, "read element 11", Outcome.OK),
        (7, "read element 109", Outcome.OK),
        (2, "write element 100 = 3", Outcome.REFUSED),
    ]
    silent = [packet.comment for packet in packets if packet.outcome is Outcome.NO_REPLY]
    assert silent[-1].startswith("read element 1: no reply within 150 ms")
    assert "read element 11: -2.0" in [packet.comment for packet in packets]
    assert exchanges[-1].command in ("read element 100", "read element 115")


@pytest.mark.slow
@pytest.mark.asyncio
@pytest.mark.parametrize("echo", [False, True])
@pytest.mark.parametrize(
    ("protocol", "address", "items"),
    [
        ("msc", 3, ("2008", "2008:32", "flag:5", "flags", "status")),
        ("mentor", 14, ("1.17", "1.18", "15.60:wide")),
        ("dc104", 0, ("2", "170")),
    ],
)
async def test_each_protocol_reads_back_as_it_was_recorded(
    tmp_path: Path, protocol: str, address: int, items: tuple[str, ...], echo: bool
) -> None:
    path = tmp_path / "line.pcapng"
    handle = find(protocol).handle
    line = Line(
        replace(handle.profile.line, baudrate=115200), [make_device(protocol, address)], echo=Echo() if echo else None
    )
    with Recorder(path, echo=echo) as tap:
        async with Bus(MemoryPort(line), tap=tap) as bus:
            device = handle(bus, address)
            for item in items:
                point = device.point(item)
                value = await point.read()
                if point.writable:
                    await point.write(value)
    with path.open("rb") as file:
        exchanges = list(replay_packets(read_packets(file)))
    assert not [f"{one.command}: {one.recorded}, {one.now}" for one in exchanges if one.changed]
    assert {one.recorded.outcome for one in exchanges} == {Outcome.OK}
    assert len(exchanges) > len(items)


def test_polls_retries_refusals_cancellations_and_probes_each_have_their_verdict_in_order(tmp_path: Path) -> None:
    devices = [make_device("hcp2", 1), make_device("hcp2", 2)]
    line = Line(LineSettings(57600), devices, chance=random.Random(1))

    async def talk(tap: Recorder) -> None:
        async with Bus(MemoryPort(line), tap=tap) as bus:
            one, two = Hcp2Controller(bus, 1), Hcp2Controller(bus, 2)
            await one.read(1)
            axes = bus.poll_group("axes", period=5.0, points=[two.axis(0).position])
            await anext(aiter(axes))
            devices[1].faults.lost = 1.0
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(two.read, 2)
                await anyio.sleep(0.05)
                devices[1].faults.lost = 0.0
            with pytest.raises(Refused):
                await two.write(100, 3)
            with anyio.move_on_after(0.0001):
                await one.read(3)
            await bus.node(one.profile, 1).probe()

    path = tmp_path / "line.pcapng"
    with Recorder(path) as tap:
        run_in_virtual_time(talk(tap))
    with path.open("rb") as file:
        packets = list(read_packets(file))
    asked = {(packet.transaction, packet.attempt): packet for packet in packets if packet.direction is Direction.HOST}
    verdicts = [packet for packet in packets if packet.outcome is not Outcome.NONE]
    assert [
        (asked[packet.transaction, packet.attempt].comment, packet.node, packet.outcome, packet.comment, packet.notes)
        for packet in verdicts
    ] == [
        ("", 1, Outcome.OK, "read element 1: 0.0", ()),
        ("poll axes", 2, Outcome.OK, "read element 100: 0.0", ()),
        ("", 2, Outcome.NO_REPLY, "read element 2: no reply within 150 ms", ()),
        ("check", 2, Outcome.OK, "read element 100: 0.0", ()),
        ("attempt 2", 2, Outcome.OK, "read element 2: 0.0", ()),
        ("", 2, Outcome.REFUSED, "write element 100 = 3: refused", ()),
        ("attempt 2", 2, Outcome.REFUSED, "write element 100 = 3: refused", ()),
        ("", 1, Outcome.OK, "read element 3: 0.0", ("cancelled",)),
        ("probe", 1, Outcome.OK, "read element 1: 0.0", ()),
    ]
    assert [packet.transaction for packet in verdicts] == [1, 2, 3, 4, 3, 5, 5, 6, 7]


def test_a_drive_of_another_protocol_that_speaks_alike_is_named_as_what_it_is(tmp_path: Path) -> None:
    devices = [make_device("mentor", 11), make_device("ct-ansi", 12)]
    line = Line(find("mentor").profile.line, devices)

    async def talk(tap: Recorder) -> None:
        async with Bus(MemoryPort(line), tap=tap) as bus:
            for protocol, address in (("mentor", 11), ("ct-ansi", 12), ("mentor", 11)):
                await find(protocol).handle(bus, address).point("1.17").read()

    path = tmp_path / "line.pcapng"
    with Recorder(path) as tap:
        run_in_virtual_time(talk(tap))
    with path.open("rb") as file:
        packets = list(read_packets(file))
    assert [packet.protocol for packet in packets] == ["mentor"] * 2 + ["ct-ansi"] * 2 + ["mentor"] * 2
    assert [(one.node, one.changed) for one in replay_packets(packets)] == [(11, False), (12, False), (11, False)]
