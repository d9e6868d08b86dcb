"""What a lost line and a write make of nodes and values: the definition that every consumer uses."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace

import pytest

from busmaster import Bus, Hcp2Controller, MemoryPort
from busmaster.arbiter.events import PortFailed
from busmaster.arbiter.health import Health
from busmaster.bus.condition import PRESENT, LossLog
from busmaster.bus.handle import Handle
from busmaster.bus.polling import PollGroup
from busmaster.bus.samples import Quality
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryTransport
from busmaster.errors import LineDown, WriteUnconfirmed
from busmaster.registry import make_device
from busmaster.testing.virtual_time import run_in_virtual_time
from busmaster.transport.identity import Identity

SLOW = 1000.0
"""Seconds of a period in which no second poll comes."""


async def read_once(bus: Bus) -> PollGroup:
    """A group of element 10, of the same by another scale, and of element 11, that was polled once."""
    controller = Hcp2Controller(bus, 5)
    point = controller.point("10")
    twin = replace(point, item="twin", decode=lambda raw: raw * 10)
    group = bus.poll_group("axes", period=SLOW, points=[point, twin, controller.point("11")])
    async for _ in group:
        break
    return group


def qualities(bus: Bus, group: PollGroup) -> list[Quality]:
    assert group.latest is not None
    return [bus.as_of_now(point, sample).quality for point, sample in group.latest.samples.items()]


def is_lost(bus: Bus) -> bool:
    return bus.condition.is_lost


def line() -> Line:
    return Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)])


def test_a_write_makes_all_that_read_the_same_stale_until_it_is_read_again() -> None:
    async def write() -> None:
        async with Bus(MemoryPort(line())) as bus:
            group = await read_once(bus)
            assert qualities(bus, group) == [Quality.GOOD] * 3
            await group.points[0].write(7.0)
            assert qualities(bus, group) == [Quality.STALE, Quality.STALE, Quality.GOOD]
            assert bus.latest(group.points[0]) is None
            stream = group.subscribe()
            group.demand()
            await anext(stream)
            assert qualities(bus, group) == [Quality.GOOD] * 3

    run_in_virtual_time(write())


def test_a_write_of_several_items_makes_their_values_stale_and_no_others() -> None:
    async def write() -> None:
        async with Bus(MemoryPort(line())) as bus:
            group = await read_once(bus)
            await Handle.write(Hcp2Controller(bus, 5), "9", 7.0, 8.0)
            assert qualities(bus, group) == [Quality.STALE, Quality.STALE, Quality.GOOD]

    run_in_virtual_time(write())


def test_a_write_that_is_not_confirmed_makes_values_stale_too() -> None:
    async def write() -> None:
        on_wire = line()
        async with Bus(MemoryPort(on_wire)) as bus:
            group = await read_once(bus)
            on_wire.devices[0].faults = Faults(lost=1.0)
            with pytest.raises(WriteUnconfirmed):
                await group.points[0].write(7.0)
            assert qualities(bus, group) == [Quality.STALE, Quality.STALE, Quality.GOOD]

    run_in_virtual_time(write())


@pytest.mark.asyncio
async def test_while_the_line_is_lost_no_node_is_up_and_no_value_is_good() -> None:
    async with Bus(MemoryPort(line())) as bus:
        group = await read_once(bus)
        [node] = bus.nodes
        assert (node.health, bus.condition) == (Health.UP, PRESENT)
        before = bus.now()
        transport = bus._pump._transport
        assert isinstance(transport, MemoryTransport)
        transport.lose(OSError("unplugged"))
        while not is_lost(bus):  # noqa: ASYNC110  nobody tells it
            await asyncio.sleep(0)
        assert (node.health, bus.condition.is_lost) == (Health.OFFLINE, True)
        assert "unplugged" in bus.condition.reason
        assert before <= bus.condition.since <= bus.now()
        assert qualities(bus, group) == [Quality.BAD] * 3
        assert group.latest is not None
        sample = bus.as_of_now(group.points[0], group.latest.samples[group.points[0]])
        assert isinstance(sample.error, LineDown)
        assert "unplugged" in sample.error.what
        assert (sample.value, bus.latest(group.points[0])) == (None, None)
        read_at = group.latest.samples[group.points[0]].wall
        while is_lost(bus):  # noqa: ASYNC110  it is opened again by itself
            await asyncio.sleep(0.001)
        assert (node.health, qualities(bus, group)) == (Health.UP, [Quality.GOOD] * 3)
        assert bus._lost_seconds > 0
        assert group.good_at(group.points[0]) == read_at


@pytest.mark.asyncio
async def test_a_bus_that_is_not_open_is_not_lost() -> None:
    bus = Bus(MemoryPort(line()))
    node = bus.node(Hcp2Controller.profile, 5)
    assert (bus.condition, node.health) == (PRESENT, Health.UNKNOWN)


def test_a_loss_has_its_first_time_its_latest_reason_and_all_seconds() -> None:
    losses = LossLog()
    losses.lost(10.0, "it hung up")
    losses.lost(12.0, "it does not exist")
    assert losses.condition[1:] == (10.0, "it does not exist")
    losses.lost(13.0, "")
    assert losses.condition.reason == "it does not exist"
    assert losses.seconds(14.0) == 4.0
    losses.found(15.0)
    losses.lost(20.0, "")
    assert (losses.condition.since, losses.seconds(21.0)) == (20.0, 6.0)


class Missing(MemoryPort):
    """A port that cannot be opened so often, each time for another reason."""

    def __init__(self, on_wire: Line, *errors: Exception) -> None:
        super().__init__(on_wire)
        object.__setattr__(self, "errors", list(errors))
        object.__setattr__(self, "reasons", [])

    errors: list[Exception]
    reasons: list[str]
    bus: Bus

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: Identity | None = None
    ) -> MemoryTransport:
        self.reasons.append(self.bus.condition.reason)
        if self.errors:
            raise self.errors.pop(0)
        return await super().open(protocol_factory, only)


def test_a_bus_that_waits_for_its_port_has_the_latest_reason_and_reports_it() -> None:
    async def wait() -> None:
        bug = ValueError("odd")
        port = Missing(line(), LineDown("it does not exist", hint="plug it in"), bug)
        bus = Bus(port, wait_for_port=True)
        object.__setattr__(port, "bus", bus)
        events = bus.events()
        async with bus:
            assert bus.condition.is_lost
            while is_lost(bus):  # noqa: ASYNC110  nobody tells it
                await asyncio.sleep(0.01)
        odd = "cannot open the emulated line: ValueError: odd"
        assert port.reasons == ["its port is not open yet", "it does not exist", odd]
        failed = [event async for event in events if isinstance(event, PortFailed)]
        assert [(event.cause, event.bug) for event in failed] == [("it does not exist", None), (odd, bug)]
        assert failed[0].hint == "plug it in"

    run_in_virtual_time(wait())
