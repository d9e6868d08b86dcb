"""From the handles of MSC, Mentor II and DC104 to emulated devices and back, in virtual time."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from busmaster import (
    Bus,
    Dc104Drive,
    GarbledReply,
    Hcp2Controller,
    HcpController,
    InvalidCommand,
    MemoryPort,
    MentorDrive,
    MscController,
    NoSuchParameter,
    PollGroup,
    Refused,
    Snapshot,
    VerifyFailed,
)
from busmaster.bus.handle import Handle
from busmaster.emulator.device import Device
from busmaster.emulator.line import Line
from busmaster.protocols._comms.device import HCP
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.dc104 import device as dc104
from busmaster.protocols.mentor import device as mentor
from busmaster.protocols.msc import codec as msc_commands
from busmaster.protocols.msc import device as msc
from busmaster.protocols.msc.status import ProgramStatus
from busmaster.testing.virtual_time import run_in_virtual_time
from tests.stories import in_use, in_virtual_time


async def cycles(group: PollGroup, count: int) -> list[Snapshot]:
    """The next so many."""
    found: list[Snapshot] = []
    async for snapshot in group:
        found.append(snapshot)
        if len(found) == count:
            break
    return found


@asynccontextmanager
async def line_of(handle: type[Handle], *devices: Device) -> AsyncIterator[Bus]:
    """A bus on a line as that handle's protocol has it, once it has resynchronised."""
    async with Bus(MemoryPort(Line(handle.profile.line, devices, chance=random.Random(1)))) as bus:
        in_use(bus)
        yield bus


# MSC


@in_virtual_time
async def test_msc_reads_right_through_two_naks_and_four_bad_packets() -> None:
    device = msc.EmulatedMsc(3)
    device.set_value(2008, 1234)
    device.naks_ahead, device.bad_packets_ahead = 2, 4
    async with line_of(MscController, device) as bus:
        assert await MscController(bus, 3).read(2008) == 1234
    assert device.retransmitted == 4


@in_virtual_time
async def test_msc_gives_up_after_six_bad_packets_and_leaves_the_line_free() -> None:
    """The host NAKs five times; the sixth packet is ACKed all the same, so that the controller falls silent."""
    device, other = msc.EmulatedMsc(3), msc.EmulatedMsc(4)
    device.bad_packets_ahead = 6
    other.set_value(2008, 44)
    async with line_of(MscController, device, other) as bus:
        with pytest.raises(GarbledReply):
            await MscController(bus, 3, retries=0).read(2008)
        failed = bus.now()
        assert await MscController(bus, 4).read(2008) == 44
        silence = msc_commands.PROFILE.timings.packet.inter_byte_timeout + msc_commands.PROFILE.line.byte_time
        assert bus.now() - failed < silence + 0.05, "no maximum reply delay: the packet had begun"
        assert device.retransmitted == 5
        assert not device.unacknowledged
        assert await MscController(bus, 3).read(2008) == 0


@in_virtual_time
async def test_a_cam_table_of_1000_values_is_written_and_verified_at_nearly_the_speed_of_the_line() -> None:
    device = msc.EmulatedMsc(3)
    table = [number * 7919 % 2**32 - 2**31 for number in range(1000)]
    told: list[tuple[int, int]] = []
    async with line_of(MscController, device) as bus:
        press = MscController(bus, 3, symbols={"cam": 4000}, address_step=4)
        await press.status()
        begun = bus.now()
        await press.load_cam("cam", table, progress=lambda done, total: told.append((done, total)))
        taken = bus.now() - begun
        tau = press.profile.line.byte_time
    written = 31 * (145 + 1) + 8 * (21 + 1)  # blocks of 32 and the rest one by one, each with its ACK
    verified = 16 + 1 + 18 + 1 + 32 * (16 + 1 + 142 + 1)
    assert taken < 1.1 * (written + verified) * tau
    assert [device.value(4000 + 4 * index) for index in range(1000)] == table
    assert told[-1] == (2000, 2000)
    assert len(told) == len(set(told)) == 31 + 8 + 1 + 32


@pytest.mark.parametrize("step", [1, 4])
def test_the_address_step_is_found_and_a_wrong_one_fails_verification(step: int) -> None:
    async def story() -> None:
        device = msc.EmulatedMsc(3, address_step=step)
        device.set_value(2000, *range(1, 40))
        async with line_of(MscController, device) as bus:
            press = MscController(bus, 3)
            assert await press.find_address_step(2000) == step
            assert await press.read(2000, 39) == tuple(range(1, 40))
            press.address_step = 5 - step
            with pytest.raises(VerifyFailed):
                await press.load_cam(3000, range(100))

    run_in_virtual_time(story())


@in_virtual_time
async def test_msc_blocks_of_any_length_touch_nothing_else() -> None:
    device = msc.EmulatedMsc(3)
    device.set_value(4000, *[-1] * 200)
    async with line_of(MscController, device) as bus:
        press = MscController(bus, 3, address_step=4)
        for length in (1, 2, 31, 32, 33, 64, 70):
            values = tuple(range(length, 2 * length))
            await press.write_block(4000, values, verify=True)
            assert await press.read(4000, length) == values
            assert device.value(4000 + 4 * length) == -1
        last = 0x8000 - 4 * 40
        await press.write_block(last, range(40), verify=True)
        assert await press.read(last, 40) == tuple(range(40))  # the last 32 would reach beyond the data area
        with pytest.raises(Refused):
            await press.write(0x8000, 1)


@in_virtual_time
async def test_msc_flags_and_status() -> None:
    new, old = msc.EmulatedMsc(3, read_only_flags=frozenset({7})), msc.EmulatedMsc(4, model="MSC-850")
    async with line_of(MscController, new, old) as bus:
        press, winder = MscController(bus, 3, model="MSC-250"), MscController(bus, 4, model="MSC-850")
        for handle in (press, winder):
            await handle.set_flag(0)
            await handle.set_flag(200)
            await handle.set_flag(255)
            await handle.clear_flag(0)
            assert await handle.flags() == {200, 255}
            assert await handle.flag(255) is True
            assert await handle.flag(0) is False
            assert await handle.status() == ProgramStatus.PROGRAM_RUNNING | ProgramStatus.AUTO_START_ENABLED
        with pytest.raises(Refused):
            await press.set_flag(7)
        count = await press.read(msc.COUNT)
        assert count > 0
        with pytest.raises(Refused):
            await winder.point("flags").read()  # RFLAGS


# Mentor II


@in_virtual_time
async def test_mentor_parameters_with_and_without_decimals_wide_and_fine() -> None:
    device = mentor.EmulatedMentor(14)
    async with line_of(MentorDrive, device) as bus:
        drive = MentorDrive(bus, 14, decimals={"1.17": 1})
        await drive.write("1.17", -47.6, verify=True)
        assert await drive.read("1.17") == -47.6
        await drive.write("1.17", -47.65, high_resolution=True, verify=True)
        assert await drive.read("1.17") == -47.6
        await drive.write("15.60", 54321, wide=True, verify=True)
        await drive.write("4.26", True, verify=True)
        assert [await drive.read(parameter) for parameter in ("15.60", "4.26", "11.11")] == [54321, 1, 14]
        with pytest.raises(NoSuchParameter):
            await drive.read("17.23")
        with pytest.raises(Refused):
            await drive.write("1.17", 100.1)
        assert await drive.read("1.17", 3) == await drive.read("1.17", 3, chain=True) == (-47.6, 0, 0)
        assert await drive.read("1.19", 3, step=-1) == (0, 0, -47.6)
        assert await drive.read("1.19", 3, step=-1, chain=True) == (0, 0, -47.6)
        assert await drive.read("1.17", 3, step=0, chain=True) == (-47.6, -47.6, -47.6)
        await drive.write("15.61", 65535, verify=True)


@in_virtual_time
async def test_mentor_drives_start_together_and_follow_their_reference() -> None:
    devices = [mentor.EmulatedMentor(address) for address in (11, 14, 27)]
    async with line_of(MentorDrive, *devices) as bus:
        drives = [MentorDrive(bus, address) for address in (11, 14, 27)]
        await drives[0].write_all("1.17", 250)
        assert [await drive.read("1.17") for drive in drives] == [250] * 3
        group = bus.poll_group("speeds", period=1.0, points=[drive.point("3.02") for drive in drives])
        snapshot = (await cycles(group, 2))[-1]
        assert [sample.value for sample in snapshot.values()] == [250] * 3
        with pytest.raises(InvalidCommand):
            await MentorDrive(bus, 0).read("1.17")


@in_virtual_time
async def test_neighbouring_parameters_are_polled_as_runs_where_that_is_allowed() -> None:
    device = mentor.EmulatedMentor(14)
    for number in range(17, 25):
        device.set_value(100 + number, number, 0.0)
    async with line_of(MentorDrive, device) as bus:
        drive = MentorDrive(bus, 14, chained=True)
        points = [drive.point(f"1.{number}") for number in range(17, 25)]
        group = bus.poll_group("references", period=1.0, points=points)
        [snapshot] = await cycles(group, 1)
        assert [snapshot[point].value for point in points] == list(range(17, 25))
        assert (await bus.statistics()).exchanges == 1


# DC104


@in_virtual_time
async def test_dc104_parameters() -> None:
    device = dc104.EmulatedDc104(maximum=100)
    async with line_of(Dc104Drive, device) as bus:
        drive = Dc104Drive(bus)
        await drive.write(12, 1500, verify=True)
        assert await drive.read(12) == 1500
        with pytest.raises(Refused):
            await drive.read(101)
        with pytest.raises(Refused):
            await Dc104Drive(bus, allow_zero=True).write(0, 1)


# HCP and HCP2 share a line


@in_virtual_time
async def test_controllers_of_both_host_comms_protocols_share_a_line() -> None:
    devices = [EmulatedMint(1, HCP), EmulatedMint(2, HCP), EmulatedMint(4), EmulatedMint(200)]
    async with line_of(Hcp2Controller, *devices) as bus:
        handles = [HcpController(bus, 1), HcpController(bus, 2), Hcp2Controller(bus, 4), Hcp2Controller(bus, 200)]
        for number, handle in enumerate(handles):
            await handle.write(1, *(100 * number + value for value in range(20)), verify=True)
        points = [handle.point(str(element)) for handle in handles for element in (1, 4, 17)]
        group = bus.poll_group("both", period=0.1, points=points)
        for snapshot in await cycles(group, 20):
            assert [snapshot[point].value for point in points] == [
                100 * number + value for number in range(4) for value in (0, 3, 16)
            ]
        assert (await bus.statistics()).unexpected_bytes == (await bus.statistics()).collisions == 0
