"""Which reads prove that replies match requests: each kind of device has them, and a node can be given its own."""

from __future__ import annotations

import random
from typing import Any

import pytest

from busmaster import Bus, BusError, InvalidCommand, MemoryPort, MicroFlexDrive
from busmaster.bus.node import Node
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.hcp2.microflex_device import EmulatedMicroFlex
from busmaster.registry import NodeKind, kinds, make_device
from busmaster.testing.virtual_time import run_in_virtual_time
from tests.stories import in_virtual_time

LASTING = 20.0
"""Seconds of the line's time for which a drive is read."""
SPEED = 120


def good_reads(handle: type[Any], *, lost: float = 0.05, seed: int = 1, **options: Any) -> int:
    """Read one element without a pause, and count the values, while a share of all frames is lost."""
    device = EmulatedMicroFlex(7, **options)
    device.preset("118", 25.0)

    async def read() -> int:
        good = 0
        line = Line(handle.profile.line, [device], chance=random.Random(seed), faults=Faults(lost=lost))
        async with Bus(MemoryPort(line)) as bus:
            drive = handle(bus, 7)
            now = drive.node.now
            end = now() + LASTING
            while now() < end:
                try:
                    await drive.read(SPEED)
                except BusError:
                    continue
                good += 1
        return good

    return run_in_virtual_time(read())


@pytest.mark.parametrize("seed", range(3))
def test_a_microflex_without_unmapped_elements_keeps_most_of_its_rate_when_replies_are_lost(seed: int) -> None:
    answers = good_reads(MicroFlexDrive, seed=seed, refuse_unmapped=False)
    refuses = good_reads(MicroFlexDrive, seed=seed)
    ignores = good_reads(MicroFlexDrive, seed=seed, ignore_unmapped=True)
    assert refuses >= 0.75 * answers
    assert ignores >= 0.75 * answers
    assert answers > 10 * LASTING, "the line was of use at all"


def test_the_reads_of_a_controller_starve_a_microflex_and_sync_reads_of_its_own_cure_that() -> None:
    class Named(Hcp2Controller):
        def __init__(self, bus: Bus, address: int) -> None:
            super().__init__(bus, address)
            self.use_sync_reads(probe="109", sync_reads=("239", "242", "126", "100", "103", "107", "110", "111"))

    usual, own = good_reads(Hcp2Controller), good_reads(Named)
    assert usual < 0.5 * own
    assert own >= 0.75 * good_reads(MicroFlexDrive)


@pytest.mark.parametrize("kind", kinds().values(), ids=lambda kind: kind.name)
def test_the_emulated_device_of_a_kind_has_the_probe_and_the_sync_reads(kind: NodeKind) -> None:
    """It refuses what its document does not have."""
    address = kind.profile.addresses[-1]

    async def read() -> None:
        line = Line(kind.profile.line, [make_device(kind.name, address)], chance=random.Random(1))
        async with Bus(MemoryPort(line)) as bus:
            node = bus.node(kind.profile, address)
            for command in (kind.profile.probe, *kind.profile.sync_reads):
                await node.request(command)

    run_in_virtual_time(read())


@in_virtual_time
async def test_what_a_handle_sets_holds_for_all_handles_of_the_node() -> None:
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line))) as bus:
        first, second, other = Hcp2Controller(bus, 7), MicroFlexDrive(bus, 7), MicroFlexDrive(bus, 8)
        assert first.node.profile.probe == hcp2.Read(1), "as the first handle said"
        second.use_sync_reads(probe="status_word")
        assert first.node.profile.probe == hcp2.Read(109)
        assert first.node.profile.sync_reads == hcp2.PROFILE.sync_reads, "what is left out stays"
        first.use_sync_reads(sync_reads=("239", "242"))
        assert second.node.profile.sync_reads == (hcp2.Read(239), hcp2.Read(242))
        assert first.node.profile.probe == hcp2.Read(109)
        second.use_sync_reads(probe="109", sync_reads=("firmware", "temperature"))
        assert other.node.profile.sync_reads == MicroFlexDrive.profile.sync_reads
        for wrong in ({"probe": "1"}, {"sync_reads": ("239", "1")}):
            with pytest.raises(InvalidCommand, match="another probe or other sync reads"):
                first.use_sync_reads(**wrong)


@in_virtual_time
async def test_a_probe_is_sent_as_the_handle_set_it() -> None:
    ignoring = EmulatedMicroFlex(7, ignore_unmapped=True)
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, [ignoring], chance=random.Random(1)))) as bus:
        controller = Hcp2Controller(bus, 7)
        assert not await Node.of(controller).probe(), "element 1 is ignored"
        controller.use_sync_reads(probe="109")
        assert await Node.of(controller).probe()


@in_virtual_time
async def test_a_probe_that_the_protocol_does_not_have_is_an_error() -> None:
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line))) as bus:
        with pytest.raises(InvalidCommand, match="no such item"):
            Hcp2Controller(bus, 7).use_sync_reads(probe="axis9.position")
        with pytest.raises(InvalidCommand, match="must read, and write element"):
            Hcp2Controller(bus, 7).node.use_sync_reads(hcp2.Write(1, (1.0,)), ())
        with pytest.raises(InvalidCommand, match="must read, and write element"):
            Hcp2Controller(bus, 7).node.use_sync_reads(hcp2.Read(1), (hcp2.Read(2), hcp2.Write(1, (1.0,))))
