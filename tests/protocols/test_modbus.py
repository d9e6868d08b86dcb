"""Modbus RTU: it keeps the contract, and its device is not fooled by its own exchange.

The frames are those of the Modbus application protocol, V1.1b3, sections 6.1 to 6.6, 6.11 and 6.12, as RTU.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

import pytest

from busmaster import Bus, InvalidCommand, MemoryPort, ModbusUnit, Refused, VerifyFailed
from busmaster.contract.exchange import Done, FrameError
from busmaster.emulator.line import Line
from busmaster.protocols.modbus.codec import PROFILE, ReadBits, ReadRegisters, WriteCoils, WriteRegisters
from busmaster.protocols.modbus.device import EmulatedModbus
from busmaster.protocols.modbus.handle import Number, Place, is_whole
from busmaster.testing import Case, Foreign, RoundTrip, answers_of, check_protocol
from busmaster.testing.virtual_time import run_in_virtual_time
from tests.protocols.modbus_frames import UNIT, frame

CASES = [
    Case(ReadRegisters(0x6B, 3), UNIT, [frame("11 03 06 022b 0000 0064")], (555, 0, 100)),
    Case(ReadRegisters(7), UNIT, [bytes.fromhex("11 03 02 02 2b 38 f8")], (555,)),
    Case(ReadRegisters(8, table="input"), UNIT, [frame("11 04 02 000a")], (10,), request=frame("11 04 0008 0001")),
    Case(ReadRegisters(7), UNIT, [frame("11 83 02")], raises=Refused),
    Case(
        ReadBits(0x13, 19),
        UNIT,
        [frame("11 01 03 cd 6b 05")],
        tuple(bit == "1" for bit in "1011001111010110101"),
        request=frame("11 01 0013 0013"),
    ),
    Case(
        ReadBits(0xC4, 22, "discrete"),
        UNIT,
        [frame("11 02 03 ac db 35")],
        tuple(bit == "1" for bit in "0011010111011011101011"),
        request=frame("11 02 00c4 0016"),
    ),
    Case(
        WriteRegisters(1, (3,)),
        UNIT,
        [bytes.fromhex("11 06 00 01 00 03 9a 9b")],
        request=bytes.fromhex("110600010003 9a9b"),
    ),
    Case(WriteRegisters(1, (3,)), UNIT, [frame("11 86 03")], raises=Refused),
    Case(WriteRegisters(1, (10, 258)), UNIT, [frame("11 10 0001 0002")], request=frame("11 10 0001 0002 04 000a 0102")),
    Case(WriteCoils(0xAC, (True,)), UNIT, [frame("11 05 00ac ff00")], request=frame("11 05 00ac ff00")),
    Case(WriteCoils(0xAC, (False,)), UNIT, [frame("11 05 00ac 0000")], request=frame("11 05 00ac 0000")),
    Case(
        WriteCoils(0x13, tuple(bit == "1" for bit in "1011001110")),
        UNIT,
        [frame("11 0f 0013 000a")],
        request=frame("11 0f 0013 000a 02 cd 01"),
    ),
    Case(WriteRegisters(1, (3,)), 0, []),
    Case(WriteCoils(1, (True, False)), 0, []),
]


def what_a_reply_names(command: Any, address: int) -> object:
    """A reply to a read names unit, function and size, not the places; one to a write all but the values."""
    match command:
        case ReadRegisters():
            return address, command.table, command.count
        case ReadBits():
            return address, command.table, (command.count + 7) // 8
        case _:
            return address, type(command), command.first, len(command.values), command.values[1:] or command.values


def test_modbus_keeps_the_contract() -> None:
    numbers = [0, 1, 65535]
    tally = check_protocol(
        PROFILE,
        CASES,
        names=what_a_reply_names,
        foreign=[
            Foreign(ReadRegisters(7), UNIT, frame("12 03 02 02 2b"), "another unit's reply"),
            Foreign(ReadRegisters(7), UNIT, frame("11 04 02 02 2b"), "a reply to another function"),
        ],
        invalid=[
            lambda: ReadRegisters(65536),
            lambda: ReadRegisters(0, 126),
            lambda: ReadRegisters(65535, 2),
            lambda: ReadRegisters(0, 1, "coil"),
            lambda: ReadBits(0, 2001),
            lambda: ReadBits(0, 1, "holding"),
            lambda: WriteRegisters(0, ()),
            lambda: WriteRegisters(0, (65536,)),
            lambda: WriteRegisters(0, (1,) * 124),
            lambda: WriteCoils(0, ()),
            lambda: WriteCoils(0, (2,)),  # type: ignore[arg-type]  # that is what is refused
            lambda: WriteCoils(0, (True,) * 1969),
        ],
        round_trips=[
            RoundTrip(UNIT, lambda value: WriteRegisters(7, (value,)), ReadRegisters(7), numbers, lambda v: (v,)),
            RoundTrip(UNIT, lambda values: WriteRegisters(7, values), ReadRegisters(7, 2), [(1, 2), (65535, 0)]),
            RoundTrip(UNIT, lambda value: WriteCoils(7, (value,)), ReadBits(7), [True, False], lambda v: (v,)),
            RoundTrip(
                UNIT, lambda values: WriteCoils(7, values), ReadBits(7, 9), [(True, False, True) * 3, (False,) * 9]
            ),
        ],
        device=answers_of(EmulatedModbus(UNIT)),
    )
    assert min(tally.values()) > 0


def test_a_read_is_never_sent_to_all() -> None:
    for command in (ReadRegisters(0), ReadBits(0)):
        with pytest.raises(InvalidCommand, match="a read of all units has no reply"):
            command.open(0, PROFILE.timings)


def test_a_write_to_all_ends_without_an_answer_and_leaves_them_time() -> None:
    exchange = WriteRegisters(1, (3,)).open(0, PROFILE.timings)
    assert not exchange.answered
    assert exchange.expired(False) == Done(None)
    assert exchange.timing.driver_release_time >= PROFILE.timings.write.late_after


# numbers


@pytest.mark.parametrize(
    ("kind", "value", "words"),
    [
        ("int16", -2, (0xFFFE,)),
        ("uint16", 65535, (0xFFFF,)),
        ("int32", -70000, (0xFFFE, 0xEE90)),
        ("uint32", 0x12345678, (0x1234, 0x5678)),
        ("int64", -2, (0xFFFF, 0xFFFF, 0xFFFF, 0xFFFE)),
        ("int64", 0x0123456789ABCDEF, (0x0123, 0x4567, 0x89AB, 0xCDEF)),
        ("uint64", 2**64 - 2, (0xFFFF, 0xFFFF, 0xFFFF, 0xFFFE)),
        ("float32", -12.5, (0xC148, 0x0000)),
        ("float64", 1.1, (0x3FF1, 0x9999, 0x9999, 0x999A)),
    ],
)
def test_a_number_takes_its_registers_most_significant_first_or_last(
    kind: str, value: float, words: tuple[int, ...]
) -> None:
    for number, wanted in ((Number(kind), words), (Number(kind, swapped=True), words[::-1])):
        assert number.encode(value) == wanted
        assert number.decode(wanted) == value
        assert number.registers == len(words)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("int16", 32768),
        ("int16", -32769),
        ("uint16", -1),
        ("uint32", 2**32),
        ("int32", 1.5),
        ("uint16", True),
        ("int64", 2**63),
        ("int64", -(2**63) - 1),
        ("uint64", 2**64),
        ("uint64", -1),
        ("float32", 1e39),
        ("float32", math.nan),
        ("float64", math.inf),
        ("float32", True),
        ("float32", "1"),
    ],
)
def test_a_number_that_does_not_fit_is_refused(kind: str, value: Any) -> None:
    with pytest.raises(InvalidCommand):
        Number(kind).encode(value)


# the handle


def told(story: Callable[[ModbusUnit, EmulatedModbus], Coroutine[Any, Any, None]]) -> None:
    """With the handle of a unit, and the unit."""

    async def main() -> None:
        device = EmulatedModbus(UNIT, inputs=range(1000), coils=(False,) * 2000, read_only=frozenset({990}))
        async with Bus(MemoryPort(Line(PROFILE.line, [device, EmulatedModbus(3)]))) as bus:
            await story(ModbusUnit(bus, UNIT), device)

    run_in_virtual_time(main())


def test_items_are_read_and_written_in_their_tables() -> None:
    async def story(unit: ModbusUnit, device: EmulatedModbus) -> None:
        await unit.write("holding:100", 7)
        await unit.write("holding:101:int16", -2)
        await unit.write("holding:102:float32:swapped", -12.5)
        await unit.write("coil:5", 1)
        assert device.registers[100:104] == [7, 0xFFFE, 0, 0xC148]
        assert await unit.read("holding:100:4") == (7, 0xFFFE, 0, 0xC148)
        assert await unit.read("holding:102:float32:swapped") == -12.5
        assert await unit.read("coil:4:3") == (False, True, False)
        assert await unit.read("input:999") == 999
        assert await unit.read("discrete:0") is False
        await unit.point("holding:100:2").write((1, 2))
        assert device.registers[100:102] == [1, 2]

    told(story)


def test_many_values_go_in_as_many_exchanges_as_it_takes_and_no_number_is_torn() -> None:
    async def story(unit: ModbusUnit, device: EmulatedModbus) -> None:
        await unit.write("holding:0:float32", *(i / 2 for i in range(100)), verify=True)
        assert device.registers[:200] == [word for i in range(100) for word in Number("float32").encode(i / 2)]
        await unit.write("coil:0", *(i % 3 == 0 for i in range(900)), verify=True)
        assert device.coils[:900] == [i % 3 == 0 for i in range(900)]

    told(story)


@pytest.mark.parametrize(("item", "most"), [("holding:0", 123), ("coil:0", 1968)])
def test_a_run_is_written_whole_by_its_point_or_not_at_all(item: str, most: int) -> None:
    async def story(unit: ModbusUnit, device: EmulatedModbus) -> None:
        await unit.point(f"{item}:{most}").write((1,) * most)
        stored = device.registers if item == "holding:0" else device.coils
        assert [sum(stored), stored[most]] == [most, 0]
        with pytest.raises(InvalidCommand, match="takes more than one exchange to write: use the handle's write"):
            await unit.point(f"{item}:{most + 1}").write((0,) * (most + 1))
        for wrong in (0, None, (0,) * (most - 1)):
            with pytest.raises(InvalidCommand, match=f"takes {most} values"):
                await unit.point(f"{item}:{most}").write(wrong)
        assert sum(stored) == most
        await unit.write(f"{item}:{most + 1}", *(1,) * (most + 1))
        assert stored[most] == 1

    told(story)


def test_what_the_unit_does_not_have_or_take_is_refused_by_name() -> None:
    async def story(unit: ModbusUnit, device: EmulatedModbus) -> None:
        with pytest.raises(Refused, match="illegal data address"):
            await unit.read("holding:999:2")
        with pytest.raises(Refused, match="illegal data value"):
            await unit.write("holding:990", 1)
        device.functions -= {4}
        with pytest.raises(Refused, match="illegal function"):
            await unit.read("input:0")

    told(story)


def test_a_value_that_differs_after_writing_is_told() -> None:
    async def story(unit: ModbusUnit, device: EmulatedModbus) -> None:
        device.lively = True
        with pytest.raises(VerifyFailed, match=r"holding 0 reads 3\d+ after 1 was written"):
            await unit.write("holding:0", 1, verify=True)

    told(story)


def test_values_of_each_exchange_of_a_long_write_are_verified() -> None:
    async def story(unit: ModbusUnit, device: EmulatedModbus) -> None:
        store = device._store

        def stuck(first: int, values: Sequence[int]) -> None:
            store(first, values)
            device.registers[125] = 5

        device._store = stuck  # type: ignore[method-assign]
        with pytest.raises(VerifyFailed, match="holding 125 reads 5 after 1 was written"):
            await unit.write("holding:0", *(1,) * 130, verify=True)

    told(story)


def test_a_number_is_never_divided_between_two_writes() -> None:
    writes = Place.parse("holding:10:float64").write([1.5] * 60)
    assert [(write.first, len(write.values)) for write in writes] == [(10, 120), (130, 120)]


@pytest.mark.parametrize("kind", ["float32", "float64"])
@pytest.mark.parametrize("value", [True, float("nan"), 1e400, 10**400, "1.5", None])
def test_what_is_not_a_finite_number_cannot_be_sent_as_a_float(kind: str, value: Any) -> None:
    with pytest.raises(InvalidCommand, match=f"cannot be sent as {kind}"):
        Number(kind).encode(value)


def test_a_write_to_all_reaches_every_unit() -> None:
    async def story(unit: ModbusUnit, device: EmulatedModbus) -> None:
        everyone = ModbusUnit(unit.bus, 0)
        await everyone.write("holding:100", 5)
        assert await unit.read("holding:100") == await ModbusUnit(unit.bus, 3).read("holding:100") == 5
        with pytest.raises(InvalidCommand):
            await everyone.read("holding:100")
        with pytest.raises(InvalidCommand, match="modbus: a write to all cannot be verified"):
            await everyone.write("holding:100", 6, verify=True)
        assert device.registers[100] == 5

    told(story)


@pytest.mark.parametrize(
    "item",
    [
        *("100", "holding", "holding:", "holding:x", "holding:1.5", "registers:1"),
        *("holding:1:int8", "coil:1:int16", "holding:1:swapped", "holding:1:float32:wrong", "coil:1:int16:swapped"),
        *("holding:65536", "input:65535:2", "holding:1:126", "holding:1:0"),
    ],
)
def test_an_item_that_does_not_exist_is_refused(item: str) -> None:
    async def story(unit: ModbusUnit, device: EmulatedModbus) -> None:
        with pytest.raises(InvalidCommand):
            unit.point(item)

    told(story)


def test_inputs_are_read_only_and_a_run_takes_as_many_values_as_it_has() -> None:
    async def story(unit: ModbusUnit, device: EmulatedModbus) -> None:
        for item in ("input:1", "discrete:1"):
            assert not unit.point(item).writable
            with pytest.raises(InvalidCommand, match="read-only"):
                unit._prepare_write(item, (1,))
        with pytest.raises(InvalidCommand, match="takes 3 values, not 2"):
            unit._prepare_write("holding:1:3", (1, 2))

    told(story)


def test_each_of_several_values_has_its_own_item() -> None:
    async def story(unit: ModbusUnit, device: EmulatedModbus) -> None:
        assert unit._run_items("holding:100:3", 3) == ("holding:100", "holding:101", "holding:102")
        assert unit._run_items("holding:100:float32:swapped", 2) == (
            "holding:100:float32:swapped",
            "holding:102:float32:swapped",
        )
        assert unit._run_items("coil:9", 2) == ("coil:9", "coil:10")

    told(story)


def test_only_floats_are_not_rounded_when_they_are_scaled() -> None:
    assert is_whole("holding:1")
    assert is_whole("holding:1:int32:swapped")
    assert not is_whole("holding:1:float64")


def test_of_several_values_that_no_coil_can_have_the_first_is_named() -> None:
    with pytest.raises(InvalidCommand, match="a coil is written 1 or 0, not 7"):
        WriteCoils(0, (True, 7, 9))  # type: ignore[arg-type]  # a stand-in


def test_a_reply_without_its_end_is_reported_with_its_length() -> None:
    exchange = ReadRegisters(0, 2).open(UNIT, PROFILE.timings)
    exchange.feed(frame("11 03 04 0001 0002")[:5])
    with pytest.raises(FrameError, match="reply cut short after 5 bytes"):
        exchange.expired(True)
    with pytest.raises(FrameError, match="no reply"):
        ReadRegisters(0, 2).open(UNIT, PROFILE.timings).expired(False)
