"""What the command line and parameter sets use of each handle: its list of parameters, its items, whether it runs."""

from __future__ import annotations

import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from inspect import signature
from typing import Any

import pytest

from busmaster import (
    Bus,
    Hcp2Controller,
    InvalidCommand,
    MemoryPort,
    MentorDrive,
    MicroFlexDrive,
    MscController,
    Refused,
    ext,
)
from busmaster.bus.handle import Handle
from busmaster.bus.node import Node
from busmaster.bus.parameters import FIRST, LAST, USUAL, Parameter
from busmaster.emulator.device import Device
from busmaster.emulator.line import Line
from busmaster.protocols.msc.device import EmulatedMsc
from busmaster.registry import NodeKind, find, kinds, make_device
from tests.stories import in_virtual_time


@asynccontextmanager
async def handle_of(kind: str, address: int, *devices: Device, **options: Any) -> AsyncIterator[Any]:
    """A handle on a line with these devices; by default with its own."""
    own = find(kind)
    line = Line(own.profile.line, devices or [make_device(kind, address)], chance=random.Random(1))
    async with Bus(MemoryPort(line)) as bus:
        yield own.handle(bus, address, **options)


def listed(kind: str, address: int, **options: Any) -> dict[str, Parameter]:
    handle = find(kind).handle(Bus(MemoryPort(Line(find(kind).profile.line))), address, **options)
    found = ext.listed_parameters(handle)
    assert len({one.item for one in found}) == len(found)
    return {one.item: one for one in found}


# lists of parameters


def test_a_controller_lists_the_elements_of_its_program_and_then_those_with_a_name() -> None:
    found = listed("hcp2", 5)
    assert list(found)[:100] == [*map(str, range(1, 100)), "axis0.position"]
    assert [item for item, one in found.items() if one.kept] == ["1", "2", "3", "4", "5", "outputs"]
    assert found["1"].kept == "a write starts an event of the Mint program"
    assert (found["outputs"].access, found["inputs"].access) == ("read/write", "read")
    assert list(listed("hcp", 5)) == [*map(str, range(1, 100))]


def test_a_microflex_lists_its_named_elements_alone_with_their_units() -> None:
    found = listed("microflex", 5)
    assert list(found) == list(MicroFlexDrive.items())
    assert (found["bus_voltage"].unit, found["bus_voltage"].access) == ("V", "read")
    assert found["command_word"].kept
    assert not found["speed_reference"].kept or found["speed_reference"].access == "read/write"


def test_a_mentor_lists_all_numbers_of_its_menus_and_stores_last() -> None:
    found = listed("mentor", 12)
    assert len(found) == 17 * 100
    assert {item for item, one in found.items() if one.stage == LAST} == {f"{menu}.00" for menu in range(17)}
    named = found["1.17"]
    assert (named.name, named.stage) == ("speed_reference_1", USUAL)
    assert named.decimals == find("mentor").decimals("speed_reference_1")


def test_a_drive_of_ct_ansi_keeps_what_it_is_reached_by() -> None:
    found = listed("ct-ansi", 12)
    assert len(found) == 23 * 100
    assert {item: one.kept for item, one in found.items() if one.kept} == {
        "11.23": "the drive is reached by it: serial address",
        "11.24": "the drive is reached by it: serial mode",
        "11.25": "the drive is reached by it: baud rate",
    }


def test_an_instrument_lists_the_parameters_of_its_documents_and_the_mode_first() -> None:
    found = listed("ei-bisynch", 1)
    assert [item for item, one in found.items() if one.stage == FIRST] == ["mA"]
    assert (found["SL"].name, found["SL"].access, found["OP"].unit) == ("target_setpoint", "", "%")
    assert found["PV"].access == "read"
    assert [item for item, one in found.items() if one.kept] == ["EE", "tag130", "tag198"]


@pytest.mark.parametrize(
    ("options", "items"), [({"maximum": 3}, "1 2 3"), ({"maximum": 2, "allow_zero": True}, "0 1 2")]
)
def test_a_dc104_lists_the_numbers_that_it_can_have(options: dict[str, Any], items: str) -> None:
    assert list(listed("dc104", 0, **options)) == items.split()


def test_an_msc_lists_its_symbols_in_the_order_of_their_addresses() -> None:
    found = listed("msc", 3, symbols={"b": 2004, "a": 2000})
    assert [(item, one.name) for item, one in found.items()] == [("2000", "a"), ("2004", "b")]
    assert listed("msc", 3) == {}
    assert listed("modbus", 17) == {}


# handles without decimals of their own


def test_a_parameter_set_has_numbers_without_the_decimals_of_a_handle() -> None:
    for kind, address, item in (("mentor", 12, "1.17"), ("ei-bisynch", 1, "SL"), ("ct-ansi", 12, "1.21")):
        bus = Bus(MemoryPort(Line(find(kind).profile.line)))
        make: Any = find(kind).handle
        handle = make(bus, address, decimals={item: 2})
        plain: Any = ext.plain_handle(handle)
        assert plain is not handle
        assert plain.node is handle.node
        assert (list(handle._decimals.values()), plain._decimals) == ([2], {})
    mentor = MentorDrive(Bus(MemoryPort(Line(MentorDrive.profile.line))), 12)
    assert ext.plain_handle(mentor) is mentor


@pytest.mark.parametrize(
    ("item", "before", "value", "written"),
    [
        ("1.17", 0, 32768, "1.17:wide"),
        ("1.17", 40000, 1, "1.17:wide"),
        ("1.17", 1, 9999, "1.17"),
        ("1.17:hires", 40000, 1, "1.17:hires"),
    ],
)
def test_a_mentor_writes_what_has_no_sign_as_wide(item: str, before: int, value: int, written: str) -> None:
    drive = MentorDrive(Bus(MemoryPort(Line(MentorDrive.profile.line))), 12)
    assert drive._written_item(item, before, value) == written


def test_two_values_are_the_same_to_a_node_within_what_its_line_carries() -> None:
    assert Hcp2Controller._same("1", 0.12341, 0.1234)
    assert not Hcp2Controller._same("1", 0.1235, 0.1233)
    assert MentorDrive._same("1.17:hires", 10, 19 - 10)
    assert not MentorDrive._same("1.17:hires", 10, 20)
    assert not MentorDrive._same("1.17", 10, 11)


# whether a node is in operation


@in_virtual_time
async def test_a_node_in_operation_shows_it_by_its_status() -> None:
    async with handle_of("microflex", 5) as drive:
        assert await drive.in_operation() == ""
        await drive.enable()
        assert await drive.in_operation(priority=0) == "ENABLED is set in its status word"
    device = EmulatedMsc(3)
    async with handle_of("msc", 3, device) as press:
        assert await press.in_operation() == "PROGRAM_RUNNING is set in its status word"
        device.preset("status", 0)
        assert await press.in_operation() == ""
    async with handle_of("dc104", 0) as drive:
        assert await drive.in_operation() is None
        assert Node.of(drive).statistics().attempts == 0


# items of the command line


@in_virtual_time
async def test_a_run_is_read_one_by_one_unless_a_chain_is_wanted() -> None:
    for kind, address, item, count in (
        ("mentor", 11, "1.17:2", 2),
        ("ct-ansi", 11, "1.21:2", 2),
        ("ei-bisynch", 1, "PV,SL", 2),
    ):
        async with handle_of(kind, address) as drive:
            one_by_one = await ext.read_item(drive, item)
            assert (len(one_by_one), Node.of(drive).statistics().attempts) == (count, count)
            assert tuple(await ext.read_item(drive, item, chain=True)) == tuple(one_by_one)
            assert Node.of(drive).statistics().attempts == count + 1
            assert not isinstance(await ext.read_item(drive, item.partition(":")[0].partition(",")[0]), tuple)


@in_virtual_time
async def test_flags_are_read_one_by_one_from_a_model_that_cannot_send_all() -> None:
    device = EmulatedMsc(3, model="MSC-850")
    device.flags.add(3)
    async with handle_of("msc", 3, device) as press:
        assert await ext.read_item(press, "flags") == frozenset({3})
        with pytest.raises(Refused):
            await ext.read_item(press, "65000")


@in_virtual_time
async def test_values_of_an_msc_are_prepared_as_one_write_and_checked_before_it() -> None:
    async with handle_of("msc", 3, address_step=4, symbols={"cam": 2000}) as press:
        [send] = ext.prepare_write(press, "cam", [1, 2, 3])
        await send()
        assert await press.read("cam", 3) == (1, 2, 3)
        [send] = ext.prepare_write(press, "2000:2", [7, 8])
        await send()
        assert await press.read("cam", 3) == (7, 8, 3)
        press.point("2004").limit(maximum=10)
        for item, values, complaint in (
            ("cam", [1, 11], "maximum of 10"),
            ("2000:2", [1, 2, 3], "2"),
            ("status", [1, 2], "no such|read-only"),
            ("flags", [1], "read-only"),
        ):
            with pytest.raises(InvalidCommand, match=complaint):
                ext.prepare_write(press, item, values)
        [send] = ext.prepare_write(press, "cam", [1, 11], safe=True)
        await send()
        assert await press.read("cam", 2) == (1, 11)


@pytest.mark.parametrize(
    ("kind", "address", "item", "run"),
    [
        ("hcp2", 5, "9", ("9", "10")),
        ("mentor", 12, "1.09", ("1.09", "1.10")),
        ("mentor", 12, "1.09:wide", ("1.09:wide", "1.10:wide")),
        ("mentor", 12, "1.09:5", ("1.09", "1.10")),
        ("ei-bisynch", 1, "tag247:hex", ("tag247:hex", "tag248:hex")),
        ("modbus", 17, "holding:9:float32:swapped", ("holding:9:float32:swapped", "holding:11:float32:swapped")),
        ("modbus", 17, "coil:9:5", ("coil:9", "coil:10")),
        ("msc", 3, "2000", ("2000[0]", "2000[1]")),
    ],
)
def test_the_items_of_several_values_are_named(kind: str, address: int, item: str, run: tuple[str, ...]) -> None:
    handle: Handle = find(kind).handle(Bus(MemoryPort(Line(find(kind).profile.line))), address)
    assert ext.run_items(handle, item, 2) == run


@pytest.mark.parametrize(("kind", "address", "item"), [("hcp2", 5, "outputs"), ("ei-bisynch", 1, "SL")])
def test_several_values_begin_at_a_number(kind: str, address: int, item: str) -> None:
    handle: Handle = find(kind).handle(Bus(MemoryPort(Line(find(kind).profile.line))), address)
    with pytest.raises(InvalidCommand, match=f"several values begin at a .*'{item}'"):
        ext.run_items(handle, item, 2)


@pytest.mark.parametrize(
    ("item", "bits"),
    [("holding:1", 16), ("holding:1:int32", 32), ("input:1:uint64", 64), ("coil:1", 1), ("coil:1:8", 0)],
)
def test_an_item_of_a_modbus_unit_has_so_many_bits(item: str, bits: int) -> None:
    kind = find("modbus")
    assert kind.width(item) == bits
    assert kind.whole_numbers(item)
    assert not kind.whole_numbers("holding:1:float32")


def test_a_flag_with_a_number_is_one_item_and_an_address_with_a_count_is_so_many() -> None:
    press = MscController(Bus(MemoryPort(Line(MscController.profile.line))), 3, address_step=4)
    assert ext.counted_items(press, "flag:5") == ("flag:5",)
    assert ext.counted_items(press, "status") == ("status",)
    assert ext.counted_items(press, "2000:3") == ("2000", "2004", "2008")


def test_a_handle_names_its_class_and_its_node() -> None:
    assert repr(Hcp2Controller(Bus(MemoryPort(Line(Hcp2Controller.profile.line))), 5)) == "<Hcp2Controller node 5>"


@pytest.mark.parametrize(
    ("kind", "item", "bits", "whole"),
    [
        ("hcp2", "1", 32, False),
        ("microflex", "status_word", 32, False),
        ("mentor", "1.17", 16, True),
        ("mentor", "1.17:wide", 16, True),
        ("mentor", "1.17:20", 0, True),
        ("ct-ansi", "1.21", 32, False),
        ("ct-ansi", "1.21:8", 0, False),
        ("ei-bisynch", "PV", 16, False),
        ("ei-bisynch", "SW:hex", 16, True),
        ("ei-bisynch", "PV,SL", 0, False),
        ("dc104", "5", 16, True),
        ("msc", "2008", 32, True),
        ("msc", "2008:4", 0, True),
        ("msc", "flag:5", 1, True),
        ("msc", "flags", 256, True),
        ("msc", "status", 16, True),
    ],
)
def test_an_item_has_so_many_bits_and_is_a_whole_number_or_not(kind: str, item: str, bits: int, whole: bool) -> None:
    assert (find(kind).width(item), find(kind).whole_numbers(item)) == (bits, whole)


@pytest.mark.parametrize("kind", kinds().values(), ids=lambda kind: kind.name)
def test_the_options_of_a_kind_are_the_arguments_of_its_handle(kind: NodeKind) -> None:
    usual = {"self", "bus", "address", "timings", "retries", "profile"}
    arguments = set(signature(kind.handle.__init__).parameters) - usual
    assert {option.name for option in kind.options} | ({"decimals"} if kind.takes_decimals else set()) == arguments
    reading = set(signature(kind.handle._read_item).parameters) - {"self", "item", "options"}
    assert {option.name for option in kind.read_options} == reading
