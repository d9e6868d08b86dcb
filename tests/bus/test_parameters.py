"""Parameter sets through handles: saved, compared, loaded and undone on emulated devices, in virtual time."""

from __future__ import annotations

import random

from busmaster import Bus, Dc104Drive, MemoryPort, MentorDrive
from busmaster.bus.handle import Handle
from busmaster.bus.parameters import Entry, ParameterLoad, ParameterSet, Result
from busmaster.emulator.device import Device
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.protocols.dc104.device import EmulatedDc104
from busmaster.protocols.mentor.device import EmulatedMentor
from tests.stories import in_virtual_time


def bus_of(handle: type[Handle], *devices: Device) -> Bus:
    return Bus(MemoryPort(Line(handle.profile.line, devices, chance=random.Random(1))))


def changed(one: ParameterSet, **values: float) -> ParameterSet:
    entries = {item: Entry(entry.parameter, values.get(f"p{item}", entry.value)) for item, entry in one.entries.items()}
    return ParameterSet(protocol=one.protocol, address=one.address, saved=one.saved, entries=entries)


async def written(load: ParameterLoad) -> list[Result]:
    return [outcome.result async for outcome in load.write()]


@in_virtual_time
async def test_a_set_is_saved_loaded_and_undone_though_two_in_a_hundred_replies_are_lost() -> None:
    device = EmulatedDc104()
    device.faults = Faults(lost=0.02)
    async with bus_of(Dc104Drive, device) as bus:
        drive = Dc104Drive(bus)
        saved = await drive.save_parameters()
        assert len(saved.entries) == 255
        load = await drive.prepare_load(changed(saved, p5=7, p9=8))
        assert await written(load) == [Result.WRITTEN] * 2
        assert (device.registers[5], device.registers[9], load.equal) == (7, 8, 253)
        assert await written(await drive.prepare_load(load.undo)) == [Result.WRITTEN] * 2
        assert drive.differences(saved, await drive.save_parameters()) == ()


@in_virtual_time
async def test_a_refusal_is_reported_and_the_others_are_written() -> None:
    device = EmulatedDc104(read_only=frozenset({5}))
    async with bus_of(Dc104Drive, device) as bus:
        drive = Dc104Drive(bus)
        saved = await drive.save_parameters(drive.parameters(["4:3"]))
        load = await drive.prepare_load(changed(saved, p5=7, p6=8))
        assert await written(load) == [Result.REFUSED, Result.WRITTEN]


@in_virtual_time
async def test_gaps_are_left_out_and_the_address_of_a_drive_is_never_written() -> None:
    async with bus_of(MentorDrive, EmulatedMentor(11)) as bus:
        drive = MentorDrive(bus, 11, decimals={"1.17": 1})
        saved = await drive.save_parameters(drive.parameters(["1.15:4", "11.11"]))
        assert list(saved.entries) == ["1.17", "1.18", "11.11"]
        wanted = changed(saved, **{"p1.18": 3, "p11.11": 12})
        load = await drive.prepare_load(wanted)
        assert [change.parameter.item for change in load.changes] == ["1.18"]
        assert [left.parameter.item for left in load.left] == ["11.11"]
