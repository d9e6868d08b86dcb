"""Nodes that answer, but only after their window: a command that hears them says so, as the doctor would."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager

import anyio

from busmaster.arbiter.events import LatenessRaised
from busmaster.bus.bus import Bus
from busmaster.errors import NoReply
from busmaster.service.remote import RemoteBus

STEP = 0.05
"""Suggested windows are multiples of this many seconds."""
ROOM = 1.5
"""How much longer than the late answer took they are."""


class LateNodes:
    """The nodes of a bus that have answered late, and after how many seconds."""

    def __init__(self) -> None:
        self._ages: dict[int, float] = {}

    async def listen(self, bus: Bus | RemoteBus) -> None:
        """Note late answers, until cancelled."""
        async for event in bus.events():
            if isinstance(event, LatenessRaised):
                self._ages[event.node.address] = event.age

    async def explain(self, error: NoReply, lateness: float) -> None:
        """Say in an error what to try where its node is only late. Waits as long as the answer may still come."""
        await anyio.sleep(lateness)
        if error.address in self._ages:
            error.hint = advice(self._ages[error.address])

    def advice(self) -> Iterator[tuple[int, str]]:
        """Yield each late node's address, and what to try."""
        for address, age in self._ages.items():
            yield address, advice(age)


def advice(age: float) -> str:
    """Return what to try for a node that has answered after so many seconds."""
    window = math.ceil(ROOM * age / STEP) * STEP
    return f"it answers late, after {age * 1000:.0f} ms: try --timeout {window * 1000:.0f}"


@asynccontextmanager
async def late_nodes(bus: Bus | RemoteBus) -> AsyncIterator[LateNodes]:
    """Listen for late answers on an open bus until the end of the block."""
    late = LateNodes()
    listening = asyncio.create_task(late.listen(bus))
    await asyncio.sleep(0)  # it hears from now on
    try:
        yield late
    finally:
        listening.cancel()
