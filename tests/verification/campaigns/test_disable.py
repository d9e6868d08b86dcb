"""`disable()` right after a write that was not answered: sent within its bound, and never confirmed by an unexpected
ACK.

The drive hears the write, and acknowledges it late; what comes after that it does not hear. An ACK that comes now is
the write's, whatever the master has asked since.
"""

from __future__ import annotations

import asyncio
import random
from contextlib import suppress
from dataclasses import dataclass, field

import pytest

from busmaster import Bus, BusError, MicroFlexDrive, Priority, WriteUnconfirmed
from busmaster.bus.node import Node
from busmaster.contract.profile import LineSettings
from busmaster.contract.tap import Attempt
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2 import microflex
from busmaster.protocols.hcp2.microflex_device import EmulatedMicroFlex
from busmaster.testing.virtual_time import run_in_virtual_time
from tests.tiers import one_by_default

SETTINGS = LineSettings(57600)
WARM = 0.5
"""Seconds in which all nodes answer first."""
DISABLE = hcp2.Write(microflex.COMMAND_WORD.number, (0,))


@dataclass
class Sent:
    """A tap: when what was sent."""

    frames: list[tuple[float, bytes]] = field(default_factory=list)

    def transmitted(self, now: float, data: bytes, _attempt: Attempt | None, /) -> None:
        self.frames.append((now, data))

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None: ...

    def attempted(self, attempt: Attempt, /) -> None: ...

    def first(self, request: bytes, since: float) -> float:
        return next(now for now, data in self.frames if now >= since and request in data)


@dataclass
class Trial:
    """What came of one disable(): how long after the call it was sent, its bound, and whether it was confirmed."""

    waited: float
    bound: float
    confirmed: bool
    obeyed: bool


def trial(
    nodes: int,
    late: float,
    *,
    polled: bool,
    silent: bool,
    hears: bool = False,
    at_once: bool = False,
    paced: bool = True,
) -> Trial:
    """A write to the first of `nodes` drives is acknowledged `late` seconds after it; then comes disable().

    `at_once`: while that write is on the wire. `silent`: no drive hears anything any more, but for the first one if it
    `hears`. `polled`: each drive has a poll group of one point.
    """
    devices = [EmulatedMicroFlex(address, delay=Delay(0.002)) for address in range(1, nodes + 1)]
    line = Line(SETTINGS, devices, paced=paced, chance=random.Random(1))
    sent = Sent()

    async def main() -> Trial:
        async with Bus(MemoryPort(line), tap=sent, seed=1) as bus:
            drives = [MicroFlexDrive(bus, device.address) for device in devices]
            if polled:
                for drive in drives:
                    bus.poll_group(f"of {drive.node.label}", period=0.05, points=[drive.status_word])
            await asyncio.gather(*(drive.enable() for drive in drives))
            await asyncio.sleep(WARM)
            devices[0].delay = Delay(late)
            write = asyncio.ensure_future(drives[0].set_speed_reference(12.0))
            if at_once:
                await asyncio.sleep(0.01)
            else:
                with suppress(
                    WriteUnconfirmed
                ):  # it is repeated, and confirmed late where the maximum reply delay was raised
                    await write
            devices[0].delay = Delay(0.002)
            for device in devices if silent else devices[:1]:
                device.faults.deaf = 0.0 if hears and device is devices[0] else 1.0
            bound, called = bus.worst_case_wait(Priority.URGENT), bus.now()
            try:
                await drives[0].disable()
                confirmed = True
            except BusError:
                confirmed = False
            await asyncio.gather(write, return_exceptions=True)
            request = DISABLE.open(1, Node.of(drives[0]).timings).request
            obeyed = not devices[0].command_word
            return Trial(sent.first(request, called) - called, bound, confirmed, obeyed)

    return run_in_virtual_time(main())


LATE = [step / 1000 for step in range(153, 700, 13)]
"""Seconds after which the ACK of the write comes: beyond the maximum reply delay, as behind a network."""
one_or_several = pytest.mark.parametrize("nodes", [1, 4])
with_or_without_polls = pytest.mark.parametrize("polled", [False, True], ids=["no polls", "polls"])


@one_or_several
@with_or_without_polls
@pytest.mark.parametrize("silent", one_by_default([False, True]), ids=["others answer", "all are silent"])
def test_a_disable_that_the_drive_does_not_hear_is_never_confirmed_by_the_ack_of_the_write_before(
    nodes: int, polled: bool, silent: bool
) -> None:
    for late in LATE:
        found = trial(nodes, late, polled=polled, silent=silent)
        assert not found.confirmed, f"its write's ACK came after {late:g} s"
        assert found.waited <= found.bound


@one_or_several
@with_or_without_polls
def test_nor_where_it_overtakes_the_write_on_the_wire(nodes: int, polled: bool) -> None:
    for late in LATE:
        found = trial(nodes, late, polled=polled, silent=False, at_once=True, paced=False)
        assert not found.confirmed, f"its write's ACK came after {late:g} s"
        assert found.waited <= found.bound


@one_or_several
@with_or_without_polls
def test_a_disable_that_the_drive_hears_is_confirmed_although_the_write_before_was_answered_late(
    nodes: int, polled: bool
) -> None:
    """Within its maximum reply delay the write is confirmed late. A drive that is slower is slow to answer the disable
    too."""
    for late in (0.101, 0.12, 0.149):
        found = trial(nodes, late, polled=polled, silent=True, hears=True)
        assert found.obeyed
        assert found.confirmed, f"its write's ACK came after {late:g} s"
        assert found.waited <= found.bound
