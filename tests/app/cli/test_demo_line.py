"""The line of `busmaster demo`, in virtual time: what the death of a node costs the others."""

from __future__ import annotations

import asyncio

import pytest

from busmaster.app.cli import demo_line
from busmaster.app.cli.demo import PERIOD, devices
from busmaster.app.cli.demo_line import AWAY_FOR, CONTROLLERS, LOSES_ITS_WIRE, SETTINGS, UP_FOR, make_line
from busmaster.bus.bus import Bus
from busmaster.bus.node import Health
from busmaster.emulator.memory import MemoryPort
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.testing.virtual_time import run_in_virtual_time


async def missed_cycles() -> tuple[list[int], float]:
    """Cycles missed while all nodes reply, then while one is away: until it is down, until it would be back, up to a
    minute after that, and in the minute behind it. With them the longest period."""
    line = make_line()
    bus = Bus(MemoryPort(line), seed=1)
    assert bus.endpoint.settings == SETTINGS
    _, points = devices(bus)
    missed: list[int] = []
    async with bus:
        group = bus.poll_group("drives", period=PERIOD, points=points)
        node = next(node for node in bus.nodes if node.address == LOSES_ITS_WIRE)
        await asyncio.sleep(UP_FOR)
        missed.append(group.statistics().missed)
        line.cut(bus.now(), line.device(LOSES_ITS_WIRE))
        died = bus.now()
        while node.health is not Health.DOWN:  # noqa: ASYNC110  time is virtual
            await asyncio.sleep(PERIOD)
        for until in (bus.now(), died + AWAY_FOR, died + 60, died + 120):
            await asyncio.sleep(until - bus.now())
            missed.append(group.statistics().missed - sum(missed))
        return missed, max(group.recent_periods)


@pytest.mark.slow
def test_r11_a_node_that_dies_costs_a_second_of_cycles_and_a_node_that_is_down_next_to_none() -> None:
    (before, dying, probed, later, last), longest = run_in_virtual_time(missed_cycles())
    assert before == 0
    assert 3 <= dying <= 1.4 / PERIOD
    assert longest <= 1.4
    assert probed <= 3
    assert later <= 0.02 * 54 / PERIOD
    assert last <= 0.01 * 60 / PERIOD


def test_the_axes_of_the_controllers_move() -> None:
    async def moved() -> list[bool]:
        bus = Bus(MemoryPort(make_line()), seed=1)
        axes = [Hcp2Controller(bus, address).axis(0).position for address in CONTROLLERS]
        async with bus:
            before = [await axis.read() for axis in axes]
            await asyncio.sleep(1.0)
            return [abs(await axis.read() - one) > 1 for axis, one in zip(axes, before, strict=True)]

    assert run_in_virtual_time(moved()) == [True] * len(CONTROLLERS)


def test_the_drive_that_loses_its_wire_gets_it_back(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []

    class Server:
        path = "a port"

        def __enter__(self) -> Server:
            return self

        def __exit__(self, *_: object) -> None: ...

    def input_ended(within: float) -> bool:
        told.append(f"{within:g} s")
        return len(told) > 8

    monkeypatch.setattr(demo_line, "serve_pty", lambda line: Server())
    monkeypatch.setattr(demo_line, "input_ended", input_ended)
    monkeypatch.setattr(demo_line, "unplug", lambda server, address: told.append(f"without {address}"))
    monkeypatch.setattr(demo_line, "plug_in", lambda server: told.append("whole"))
    demo_line.main()
    again = [f"{UP_FOR:g} s", f"without {LOSES_ITS_WIRE}", f"{AWAY_FOR:g} s", "whole"]
    assert told == [*again, *again, f"{UP_FOR:g} s"]
