"""Nodes that are as late as their document allows, beyond the reply window: every value comes, and is late."""

from __future__ import annotations

import asyncio
import random

import pytest

from busmaster import Bus, Hcp2Controller, MemoryPort, NoReply, Quality
from busmaster.arbiter.health import Health
from busmaster.bus.samples import Sample
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import make_device
from busmaster.testing.virtual_time import run_in_virtual_time

READS = 20


def line(delay: float, latency: float = 0.0) -> Line:
    devices = [make_device("hcp2", 1, delay=Delay(delay))]
    return Line(hcp2.PROFILE.line, devices, paced=True, chance=random.Random(1), latency=latency)


@pytest.mark.parametrize("delay", [0.105, 0.120, 0.149])
def test_r2_every_value_of_a_node_that_its_document_allows_to_be_so_late_is_delivered_late(delay: float) -> None:
    async def main() -> None:
        async with Bus(MemoryPort(line(delay))) as bus:
            node = bus.node(hcp2.PROFILE, 1)
            drive = Hcp2Controller(bus, 1)
            for value in range(READS):
                await drive.write(1, value)
                assert await drive.read(1) == value
            group = bus.poll_group("states", period=0.5, points=[drive.point("1")])
            samples: list[Sample[object]] = []
            async for snapshot in group:
                samples += snapshot.samples.values()
                if len(samples) == READS:
                    break
            assert [(sample.value, sample.quality) for sample in samples] == [(READS - 1, Quality.LATE)] * READS
            counts = node.statistics()
            assert counts.ok == counts.late == counts.overdue == counts.attempts >= 3 * READS
            assert (counts.failed, counts.retries, node._record.health) == (0, 0, Health.UP)

    run_in_virtual_time(main())


def test_r2_what_begins_after_the_max_reply_delay_is_no_reply() -> None:
    async def main() -> None:
        async with Bus(MemoryPort(line(0.152))) as bus:
            with pytest.raises(NoReply, match="no reply within 150 ms"):
                await Hcp2Controller(bus, 1).read(1, retries=0)

    run_in_virtual_time(main())


@pytest.mark.parametrize("latency", [0.016, 0.2])
@pytest.mark.parametrize(("delay", "late"), [(0.045, False), (0.052, True), (0.105, True), (0.149, True)])
def test_bytes_that_the_adapter_holds_back_are_as_late_as_they_were_on_the_wire(
    delay: float, late: bool, latency: float
) -> None:
    async def main() -> None:
        async with Bus(MemoryPort(line(delay, latency))) as bus:
            node = bus.node(hcp2.PROFILE, 1)
            drive = Hcp2Controller(bus, 1)
            for value in range(3):
                await drive.write(1, value)
                assert await drive.read(1) == value
            counts = node.statistics()
            assert counts.ok == counts.attempts >= 6
            assert (counts.late, counts.failed, counts.retries) == (counts.ok * late, 0, 0)

    run_in_virtual_time(main())


@pytest.mark.parametrize("latency", [0.016, 0.2])
def test_a_reply_that_begins_after_the_max_reply_delay_is_none_for_an_adapter_that_holds_bytes_back(
    latency: float,
) -> None:
    async def main() -> None:
        async with Bus(MemoryPort(line(0.152, latency))) as bus:
            began = bus.now()
            with pytest.raises(NoReply):
                await Hcp2Controller(bus, 1).read(1, retries=0)
            assert bus.now() - began >= 0.15 + latency

    run_in_virtual_time(main())


def test_a_caller_in_a_hurry_gives_up_within_the_time_that_it_names() -> None:
    async def main() -> None:
        async with Bus(MemoryPort(line(0.120))) as bus:
            node = bus.node(hcp2.PROFILE, 1)
            drive = Hcp2Controller(bus, 1)
            await drive.read(1)
            began = bus.now()
            with pytest.raises(NoReply):
                await drive.read(1, finish_within=0.110)
            assert bus.now() - began == pytest.approx(0.110, abs=0.001)
            assert await drive.read(1) == 0
            assert node.statistics().no_reply == 0, "its reply came"

    run_in_virtual_time(main())


def test_leaving_a_bus_waits_for_a_window_and_no_longer() -> None:
    async def main() -> None:
        async with Bus(MemoryPort(line(5.0))) as bus:
            node = bus.node(hcp2.PROFILE, 1)
            reading = node.request(hcp2.Read(1), retries=0)
            task = asyncio.ensure_future(reading)
            await asyncio.sleep(0.2)  # the line is up, and the request on the wire
            began = bus.now()
        assert bus.now() - began < 0.110
        with pytest.raises(NoReply):
            await task

    run_in_virtual_time(main())
