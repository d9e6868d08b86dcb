"""Stories told in virtual time, on a bus with an emulated line or on one of their own."""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable, Coroutine
from functools import wraps
from math import inf
from typing import Any, ParamSpec

from busmaster.bus.bus import Bus
from busmaster.bus.polling import PollGroup, Snapshot
from busmaster.contract.profile import LineSettings
from busmaster.emulator.device import Device
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.emulator.world import World
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.testing.virtual_time import run_in_virtual_time

P = ParamSpec("P")
Story = Callable[[Bus], Awaitable[None]]


def in_virtual_time(test: Callable[P, Coroutine[Any, Any, None]]) -> Callable[P, None]:
    """Run a test on a loop of its own, which keeps virtual time."""

    @wraps(test)
    def run(*arguments: P.args, **options: P.kwargs) -> None:
        run_in_virtual_time(test(*arguments, **options))

    return run


def on_a_bus(story: Story, *devices: Device, settings: LineSettings | None = None) -> None:
    """Run it on a line with these devices; two HCP2 controllers, 1 and 2, by default."""

    async def run() -> None:
        chosen = devices or (EmulatedMint(1), EmulatedMint(2))
        line = Line(settings or LineSettings(57600), chosen, chance=random.Random(1))
        async with Bus(MemoryPort(line), seed=1) as bus:
            in_use(bus)
            await story(bus)

    run_in_virtual_time(run())


def in_use(line: Bus | World) -> None:
    """Take the line for one that has been in use: no node holds a part of an earlier master's frame, which the first
    write would otherwise wait for (R15). Once the line is up."""
    arbiter = line._arbiter if isinstance(line, Bus) else line.arbiter
    arbiter._in_sync.lone_bytes_until = -inf


async def cycles(group: PollGroup, count: int) -> list[Snapshot]:
    """So many snapshots from now on."""
    consumer = group.subscribe(buffer=count)
    try:
        return [await anext(consumer) for _ in range(count)]
    finally:
        consumer.close()
