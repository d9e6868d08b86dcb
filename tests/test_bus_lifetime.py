"""A bus is opened once and closed once, whatever happens to whoever does it."""

from __future__ import annotations

import asyncio
import random

import pytest

from busmaster.bus import Bus
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.errors import BusClosed
from busmaster.profile import LineSettings
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.testing.virtual_time import run_in_virtual_time
from busmaster.transport.memory import MemoryPort


def slow_bus() -> Bus:
    """On a line whose one controller takes 80 ms to answer."""
    line = Line(LineSettings(57600), [EmulatedMint(1, delay=Delay(0.080))], chance=random.Random(1))
    return Bus(MemoryPort(line), seed=1)


def test_a_bus_that_was_closed_is_not_opened_again() -> None:
    async def story() -> None:
        bus = slow_bus()
        async with bus:
            axis = Hcp2Controller(bus, 1)
        with pytest.raises(BusClosed):
            async with bus:
                pass
        with pytest.raises(BusClosed):
            bus.poll_group("late", period=1.0, points=[axis.point("1")])
        with pytest.raises(BusClosed):
            bus.events()

    run_in_virtual_time(story())


def test_closing_ends_even_if_whoever_closes_is_cancelled_meanwhile() -> None:
    """The exchange on the wire may run out, for 80 ms; the owner's patience ends within them."""

    async def story() -> None:
        bus = slow_bus()

        async def own() -> None:
            async with bus:
                reading = asyncio.create_task(Hcp2Controller(bus, 1).read(1))
                await asyncio.sleep(0.5)
                reading.cancel()
                following = asyncio.create_task(Hcp2Controller(bus, 1).read(1))
                await asyncio.sleep(0.01)
                following.cancel()

        owner = asyncio.create_task(own())
        await asyncio.sleep(0.52)
        owner.cancel()
        with pytest.raises(asyncio.CancelledError):
            await owner
        assert not bus.running
        await asyncio.sleep(0)
        assert asyncio.all_tasks() == {asyncio.current_task()}

    run_in_virtual_time(story())


def test_a_closed_bus_sets_no_timer() -> None:
    async def story() -> None:
        async with slow_bus() as bus:
            dead = Hcp2Controller(bus, 9)
            bus.poll_group("dead", period=0.5, points=[dead.point("1")])
            await asyncio.sleep(3.0)
        dead.node.suspend(5.0)
        with pytest.raises(RuntimeError, match="no timer is set"):
            await asyncio.Event().wait()

    with pytest.raises(RuntimeError, match="no timer is set"):
        run_in_virtual_time(story())
