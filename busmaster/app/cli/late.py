"""Reports nodes that reply after their reply window, with a window that would fit."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import anyio

from busmaster import Bus, BusError, NoReply
from busmaster.app.cli.output import Level, note
from busmaster.app.service.remote import RemoteBus
from busmaster.events import MaxReplyDelayRaised, RepliesLate

STEP = 0.05
"""Suggested windows are multiples of this many seconds."""
ROOM = 1.5
"""Factor of the suggested window to the time of the late reply."""
OWNER_REPLIES_WITHIN = 1.0
"""Seconds to wait at the end for events from the owner of a line."""


class LateNodes:
    """The nodes of a bus that have answered late, and after how many seconds."""

    def __init__(self, *, in_file: bool = False) -> None:
        self._in_file = in_file
        self._ages: dict[int, tuple[str, float]] = {}

    async def listen(self, bus: Bus | RemoteBus) -> None:
        """Record late replies, until cancelled."""
        async for event in bus.events():
            if isinstance(event, MaxReplyDelayRaised | RepliesLate):
                self._ages[event.node.address] = (event.node.label, event.age)

    async def explain(self, error: NoReply, max_reply_delay: float) -> None:
        """Add advice to an error if its node replies late. Waits as long as a reply can still arrive."""
        await anyio.sleep(max_reply_delay)
        if error.address is not None and error.address in self._ages:
            _, age = self._ages.pop(error.address)
            error.hint = advice(age, in_file=self._in_file)

    def print_advice(self) -> None:
        """Print advice on standard error, once for each late node."""
        for label, age in self._ages.values():
            note(f"{label}: {advice(age, in_file=self._in_file)}", Level.WARNING)
        self._ages.clear()


def advice(age: float, *, in_file: bool = False) -> str:
    """Return advice for a node with a reply after `age` seconds: an option, or a key of LINE.toml if `in_file`."""
    window = math.ceil(round(ROOM * age / STEP, 6)) * STEP  # 0.2 s times 1.5 is a little more than 0.3 s in floats
    what = (
        f"set timing = {{ window = {window:g} }} in its section of the file"
        if in_file
        else f"try --timeout {window * 1000:.0f}"
    )
    return f"late reply, {age * 1000:.0f} ms after the request; {what}"


@asynccontextmanager
async def late_nodes(bus: Bus | RemoteBus, *, in_file: bool = False) -> AsyncIterator[LateNodes]:
    """Record late replies on an open bus until the end of the block, which reports the remaining ones."""
    late = LateNodes(in_file=in_file)
    listening = asyncio.create_task(late.listen(bus))
    await asyncio.sleep(0)  # it listens from now on
    try:
        yield late
        if isinstance(bus, RemoteBus):
            # The owner sends an event after the reply that caused it: a further reply comes after that.
            with suppress(BusError), anyio.move_on_after(OWNER_REPLIES_WITHIN):
                await bus.statistics()
    finally:
        await asyncio.sleep(0)  # it receives the last events
        listening.cancel()
        late.print_advice()
