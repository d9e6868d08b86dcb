"""From the handle to an emulated line and back, over a real pty and a real TCP port."""

from __future__ import annotations

import asyncio
import itertools
import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from busmaster import (
    Bus,
    BusClosed,
    GarbledReply,
    Hcp2Controller,
    LineDown,
    LineState,
    MicroFlexDrive,
    NoReply,
    SerialPort,
    TcpPort,
)
from busmaster.contract.profile import LineSettings
from busmaster.emulator.line import Line
from busmaster.emulator.serve import LineServer, serve_pty, serve_tcp
from busmaster.registry import make_device
from busmaster.transport.endpoints import Endpoint
from tests.patience import PATIENCE
from tests.transport.test_alarm import open_timers


def line() -> Line:
    devices = [make_device("hcp2", address) for address in (1, 2, 5)]
    return Line(LineSettings(57600), [*devices, make_device("microflex", 7)], paced=False, chance=random.Random(1))


@pytest.fixture(params=["pty", "tcp"])
def served(request: pytest.FixtureRequest) -> Iterator[tuple[LineServer, Endpoint]]:
    if request.param == "pty":
        with serve_pty(line()) as server:
            yield server, SerialPort(server.path, baudrate=57600)
    else:
        with serve_tcp(line()) as server:
            host, port = server.path.removeprefix("socket://").rsplit(":", 1)
            yield server, TcpPort(host, int(port), baudrate=57600)


@pytest.mark.asyncio
async def test_what_is_written_is_read_back(served: tuple[LineServer, Endpoint]) -> None:
    async with Bus(served[1]) as bus:
        axis = Hcp2Controller(bus, 5)
        await axis.write(1, 123.456, verify=True)
        assert await axis.read(1) == 123.456


@pytest.mark.asyncio
async def test_a_drive_is_enabled_moved_and_disabled(served: tuple[LineServer, Endpoint]) -> None:
    async with Bus(served[1]) as bus:
        drive = MicroFlexDrive(bus, 7)
        await drive.enable()
        await drive.set_speed_reference(25.0)
        assert await drive.speed_reference.read() == 25.0
        await drive.disable()


@pytest.mark.asyncio
async def test_a_hundred_callers_each_get_their_own_value(served: tuple[LineServer, Endpoint]) -> None:
    async with Bus(served[1]) as bus:
        nodes = [Hcp2Controller(bus, address) for address in (1, 2, 5)]
        for node in nodes:
            await node.write(1, *(node.node.address * 100 + i for i in range(5)))
        wanted = [(node, 1 + i % 5) for i in range(33) for node in nodes]
        values = await asyncio.gather(*(node.read(element) for node, element in wanted))
        assert values == [node.node.address * 100 + element - 1 for node, element in wanted]


@pytest.mark.asyncio
async def test_a_node_that_is_not_there_fails_alone(served: tuple[LineServer, Endpoint]) -> None:
    async with Bus(served[1]) as bus:
        absent, present = Hcp2Controller(bus, 77), Hcp2Controller(bus, 1)
        missing, value = await asyncio.gather(absent.read(1), present.read(1), return_exceptions=True)
        assert isinstance(missing, NoReply)
        assert value == 0


@pytest.mark.asyncio
async def test_r6_a_caller_that_gives_up_does_not_disturb_the_next(served: tuple[LineServer, Endpoint]) -> None:
    async with Bus(served[1]) as bus:
        axis = Hcp2Controller(bus, 5)
        await axis.write(1, 11, 22)
        for _ in range(20):
            gone = asyncio.ensure_future(axis.read(1))
            await asyncio.sleep(0)
            gone.cancel()
            assert await axis.read(2) == 22
            assert gone.cancelled()


@pytest.mark.asyncio
async def test_a_poll_group_delivers_snapshots_on_its_grid(served: tuple[LineServer, Endpoint]) -> None:
    async with Bus(served[1]) as bus:
        axis = Hcp2Controller(bus, 5)
        await axis.write(1, 1, 2, 3)
        points = [axis.element(e) for e in (1, 2, 3)]
        group = bus.poll_group("three", period=0.02, points=points)
        snapshots = []
        async for snapshot in group:
            snapshots.append(snapshot)
            if len(snapshots) == 4:
                break
        assert [[sample.value for sample in s.values()] for s in snapshots] == [[1, 2, 3]] * 4
        steps = [(b.due - a.due) / 0.02 for a, b in itertools.pairwise(snapshots)]
        assert steps == pytest.approx([round(step) for step in steps])


@pytest.mark.asyncio
async def test_r8_leaving_the_bus_tells_whoever_waits(served: tuple[LineServer, Endpoint]) -> None:
    async with Bus(served[1]) as bus:
        waiting = [asyncio.ensure_future(Hcp2Controller(bus, 77).read(1)) for _ in range(10)]
        await asyncio.sleep(0.01)
    outcomes = await asyncio.gather(*waiting, return_exceptions=True)
    assert {type(outcome) for outcome in outcomes[1:]} == {BusClosed}
    assert isinstance(outcomes[0], BusClosed | NoReply)
    with pytest.raises(BusClosed):
        await Hcp2Controller(bus, 1).read(1)


@pytest.mark.asyncio
async def test_r13_a_vanished_port_fails_callers_at_once_and_polling_resumes_by_itself(tmp_path: Path) -> None:
    link = tmp_path / "line"
    server = serve_pty(line(), link)
    try:
        async with Bus(SerialPort(str(link), baudrate=57600)) as bus:
            axis = Hcp2Controller(bus, 1)
            group = bus.poll_group("position", period=0.05, points=[axis.axis(0).position])
            stream = group.subscribe()
            assert (await anext(stream))[axis.axis(0).position].error is None
            server.close()
            async with asyncio.timeout(PATIENCE):
                while (await anext(stream))[axis.axis(0).position].error is None:
                    pass
            with pytest.raises(LineDown):
                await axis.read(1)
            server = serve_pty(line(), link)
            async with asyncio.timeout(PATIENCE):
                while (await anext(stream))[axis.axis(0).position].error is not None:
                    pass
            assert bus.state is not LineState.OFFLINE
    finally:
        server.close()


@pytest.mark.asyncio
async def test_a_port_that_does_not_exist_is_named_and_leaves_nothing_open(tmp_path: Path) -> None:
    before = open_timers()
    with pytest.raises(LineDown, match="nowhere"):
        async with Bus(SerialPort(str(tmp_path / "nowhere"), baudrate=57600)):
            pass
    assert open_timers() <= before


@pytest.mark.asyncio
async def test_a_flipped_bit_in_every_frame_is_an_error_and_never_a_value(served: tuple[LineServer, Endpoint]) -> None:
    server, endpoint = served
    async with Bus(endpoint) as bus:
        axis = Hcp2Controller(bus, 5)
        assert await axis.read(1) == 0
        server.line.faults.flip = 1.0
        with pytest.raises((GarbledReply, NoReply)):
            await axis.read(1)
