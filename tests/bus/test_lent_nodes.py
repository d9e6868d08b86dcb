"""Nodes that are lent: they leave the bus with the last who borrowed them, unless the bus's own program has them."""

from __future__ import annotations

import asyncio

import pytest

from busmaster import Bus, BusError, Hcp2Controller, MemoryPort, Node
from busmaster.arbiter.events import NodeChanged
from busmaster.arbiter.health import Health
from busmaster.emulator.line import Line
from busmaster.errors import InvalidCommand, NoReply
from busmaster.protocols.hcp2.codec import Write
from busmaster.registry import find, make_device
from busmaster.testing.virtual_time import run_in_virtual_time

PROFILE = Hcp2Controller.profile
ABSENT = 9


def bus_with(*addresses: int) -> Bus:
    return Bus(MemoryPort(Line(PROFILE.line, [make_device("hcp2", address) for address in addresses])))


def test_a_lent_node_leaves_with_the_last_who_gives_it_back() -> None:
    async def run() -> None:
        async with bus_with(5) as bus:
            node = bus._lend_node(PROFILE, 5)
            assert bus._lend_node(PROFILE, 5) is node
            bus._give_back(node)
            assert list(bus.nodes) == [node]
            bus._give_back(node)
            assert not bus.nodes
            assert await Hcp2Controller(bus, 5).read(1) == 0

    run_in_virtual_time(run())


def test_a_node_that_the_bus_has_itself_stays_whoever_named_it_first() -> None:
    async def run() -> None:
        async with bus_with(5) as bus:
            lent = bus._lend_node(PROFILE, 5)
            own = Node.of(Hcp2Controller(bus, 5))
            bus._give_back(lent)
            assert bus.nodes == (own,)

    run_in_virtual_time(run())


def test_a_dead_node_that_was_given_back_is_probed_no_more() -> None:
    async def run() -> None:
        async with bus_with(5) as bus:
            lent = bus._lend_node(PROFILE, ABSENT)
            with pytest.raises(NoReply):
                await lent.request(PROFILE.probe, retries=0)
            await asyncio.sleep(10)
            probed = lent.statistics().probes
            assert probed > 1
            bus._give_back(lent)
            await asyncio.sleep(1)
            exchanges = (await bus.statistics()).exchanges
            await asyncio.sleep(60)
            assert (await bus.statistics()).exchanges == exchanges

    run_in_virtual_time(run())


def test_what_is_on_the_wire_when_a_node_is_given_back_runs_out() -> None:
    async def run() -> None:
        async with bus_with(5) as bus:
            lent = bus._lend_node(PROFILE, ABSENT)
            asking = asyncio.ensure_future(lent.request(PROFILE.probe, retries=0))
            await asyncio.sleep(0.01)
            asking.cancel()
            bus._give_back(lent)
            assert await Hcp2Controller(bus, 5).read(1) == 0
            assert [node.address for node in bus.nodes] == [5]

    run_in_virtual_time(run())


def test_another_protocol_may_be_lent_once_the_line_has_no_node_of_the_first() -> None:
    async def run() -> None:
        async with bus_with(5) as bus:
            lent = bus._lend_node(find("modbus").profile, 5)
            with pytest.raises(InvalidCommand, match="modbus"):
                Hcp2Controller(bus, 5)
            bus._give_back(lent)
            assert await Hcp2Controller(bus, 5).read(1) == 0

    run_in_virtual_time(run())


def test_another_protocol_may_be_lent_once_the_nodes_of_two_have_left() -> None:
    async def run() -> None:
        async with bus_with(5) as bus:
            for lent in [bus._lend_node(find(name).profile, 5) for name in ("hcp", "hcp2")]:
                bus._give_back(lent)
            assert [bus._lend_node(find("modbus").profile, 5)] == list(bus.nodes)

    run_in_virtual_time(run())


def test_r11_only_a_node_that_is_new_to_the_line_is_lent_within_the_probe_budget() -> None:
    async def run() -> None:
        async with bus_with(5, 6) as bus:
            own = Node.of(Hcp2Controller(bus, 5))
            lent = bus._lend_node(PROFILE, 6)
            for node in (own, lent):
                await node.request(PROFILE.probe)
                assert bus._lend_node(PROFILE, node.address, budgeted=True) is node
                assert node.health is Health.UP
            assert bus._lend_node(PROFILE, ABSENT, budgeted=True).health is Health.DOWN

    run_in_virtual_time(run())


def test_no_queue_is_kept_of_nodes_that_were_given_back() -> None:
    async def run() -> None:
        async with bus_with(5) as bus:
            own = Hcp2Controller(bus, 5)
            for address in (8, 9, 10):
                lent = bus._lend_node(PROFILE, address)
                writing = asyncio.ensure_future(lent.request(Write(1, (1,)), retries=0))
                await asyncio.sleep(0.01)
                writing.cancel()  # it is on the wire, and ends after its node has left
                bus._give_back(lent)
                await own.read(1)
            bus._give_back(bus._lend_node(PROFILE, 11))
            assert not Node.of(own)._shared.arbiter.dispatcher.writes.queues

    run_in_virtual_time(run())


def test_what_happens_to_a_node_that_was_given_back_is_not_reported() -> None:
    async def run() -> None:
        async with bus_with(5) as bus:
            await Hcp2Controller(bus, 5).read(1)
            events = bus.events()
            lent = bus._lend_node(PROFILE, ABSENT)
            failing = asyncio.ensure_future(lent.request(PROFILE.probe, retries=0))
            await asyncio.sleep(0.01)
            bus._give_back(lent)
            again = bus._lend_node(PROFILE, ABSENT)
            assert again is not lent
            with pytest.raises(BusError):
                await failing
            await asyncio.sleep(1)
            events.close()
            assert [event async for event in events if isinstance(event, NodeChanged)] == []

    run_in_virtual_time(run())
