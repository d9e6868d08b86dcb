"""`read(item, count)` and `write(item, *values)` of every handle, on emulated lines in virtual time."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from busmaster import (
    Bus,
    CtAnsiDrive,
    Dc104Drive,
    Hcp2Controller,
    HcpController,
    InvalidCommand,
    MemoryPort,
    MentorDrive,
    ModbusUnit,
    MscController,
    Node,
    Point,
    VerifyFailed,
)
from busmaster.bus.handle import Handle
from busmaster.bus.limits import Limit
from busmaster.emulator.device import Device
from busmaster.emulator.line import Line
from busmaster.protocols.modbus.handle import Place
from busmaster.registry import make_device
from busmaster.testing import run_in_virtual_time
from tests.stories import cycles


class PointByPoint(MentorDrive):
    """A handle that leaves `read` and `write` to the base class."""

    read = Handle.read  # type: ignore[assignment]  # without the options of the drive
    write = Handle.write  # type: ignore[assignment]  # likewise


@dataclass(frozen=True)
class Case:
    """A handle, an item with those that follow it, and values that they take."""

    kind: str
    handle: type[Handle]
    items: tuple[Any, ...]
    values: tuple[float, ...] = (7, 5, 3)
    address: int = 14
    last: Any = "1.99"
    """An item that no other follows."""
    options: dict[str, Any] = field(default_factory=dict)


CASES = {
    "hcp": Case("hcp", HcpController, (10, 11, 12), (1.5, -2.25, 3), last=99),
    "hcp2": Case("hcp2", Hcp2Controller, (10, 11, 12), (1.5, -2.25, 3), last=255),
    "mentor": Case("mentor", MentorDrive, ("1.17", "1.18", "1.19"), (-4.7, 5, 3), options={"decimals": {"1.17": 1}}),
    "ct-ansi": Case("ct-ansi", CtAnsiDrive, ("1.21", "1.22", "1.23"), (-47.6, 12.5, 3)),
    "dc104": Case("dc104", Dc104Drive, (1, 2, 3), address=0, last=255),
    "modbus": Case("modbus", ModbusUnit, ("holding:10", "holding:11", "holding:12"), last="holding:65535"),
    "modbus numbers": Case(
        "modbus",
        ModbusUnit,
        tuple(f"holding:{at}:float32:swapped" for at in (10, 12, 14)),
        (1.5, -2.25, 3),
        last="holding:65534:float32:swapped",
    ),
    "modbus bits": Case("modbus", ModbusUnit, ("coil:9", "coil:10", "coil:11"), (1, 0, 1), last="coil:65535"),
    "msc": Case("msc", MscController, (2000, 2004, 2008), address=3, last=None, options={"address_step": 4}),
    "point by point": Case("mentor", PointByPoint, ("1.17", "1.18", "1.19")),
}
every_handle = pytest.mark.parametrize("case", CASES.values(), ids=CASES)


def told(case: Case, story: Callable[[Any, Device, Bus], Awaitable[None]]) -> None:
    async def run() -> None:
        device = make_device(case.kind, case.address)
        async with Bus(MemoryPort(Line(case.handle.profile.line, [device]))) as bus:
            await story(case.handle(bus, case.address, **case.options), device, bus)

    run_in_virtual_time(run())


@every_handle
def test_several_values_are_written_and_read_from_an_item_on(case: Case) -> None:
    async def story(handle: Any, device: Device, bus: Bus) -> None:
        await handle.write(case.items[0], *case.values, verify=True)
        assert await handle.read(case.items[0], 3) == case.values
        assert tuple([await handle.read(item) for item in case.items]) == case.values
        assert await handle.read(case.items[1], 1) == case.values[1:2]

    told(case, story)


@every_handle
def test_nothing_is_sent_if_one_of_the_items_or_values_is_wrong(case: Case) -> None:
    async def story(handle: Any, device: Device, bus: Bus) -> None:
        before = (await bus.statistics()).exchanges
        with pytest.raises(InvalidCommand, match=r"no value to write|takes a value, not 0"):
            await handle.write(case.items[0])
        with pytest.raises(InvalidCommand):
            await handle.write(case.items[0], case.values[0], "x")
        for count in (0, -1, 1.5, True, 70_000):
            with pytest.raises(InvalidCommand):
                await handle.read(case.items[0], count)
        if case.last is not None:
            with pytest.raises(InvalidCommand):
                await handle.read(case.last, 2)
            with pytest.raises(InvalidCommand):
                await handle.write(case.last, *case.values[:2])
        assert (await bus.statistics()).exchanges == before

    told(case, story)


@every_handle
def test_no_value_is_sent_if_one_of_them_is_beyond_a_limit(case: Case) -> None:
    async def story(handle: Any, device: Device, bus: Bus) -> None:
        before = (await bus.statistics()).exchanges
        point = handle.point(str(case.items[1]))
        Node.of(handle).limit(Limit(name="limited", read=point.command, decode=point.value_of, minimum=100))
        with pytest.raises(InvalidCommand, match="100"):
            await handle.write(case.items[0], *case.values)
        assert (await bus.statistics()).exchanges == before

    told(case, story)


def test_the_methods_of_0_2_say_what_replaces_them() -> None:
    drive = MentorDrive(Bus(MemoryPort(Line(MentorDrive.profile.line))), 14)
    for name in ("read_run", "read_block"):
        with pytest.raises(AttributeError, match=r"read\(item, count\)"):
            getattr(drive, name)
    assert not hasattr(drive, "reed")


def test_modbus_reads_more_registers_than_fit_one_exchange_and_tears_no_number() -> None:
    async def story(unit: Any, device: Device, bus: Bus) -> None:
        numbers = tuple(float(n) for n in range(130))
        await unit.write("holding:1:float64", *numbers)
        assert await unit.read("holding:1:float64", 130) == numbers
        assert [read.count for read in Place.parse("holding:1:float64").reads(130, 125, "")] == [124, 124, 124, 124, 24]
        with pytest.raises(InvalidCommand, match="a run already"):
            await unit.read("holding:1:10", 2)

    told(CASES["modbus"], story)


def test_every_value_is_verified_if_that_is_wanted() -> None:
    class OneMore(PointByPoint):
        def point(self, item: str) -> Point[Any]:
            read: Point[Any] = replace(super().point(item), decode=lambda number: number + (item == "1.18"))
            return read

    async def story(drive: Any, device: Device, bus: Bus) -> None:
        await drive.write("1.17", 7, 5, 3)
        with pytest.raises(VerifyFailed, match=r"1\.18 reads 6 after 5 was written"):
            await drive.write("1.17", 7, 5, 3, verify=True)
        assert await drive.read("1.17", 3) == (7, 6, 3)

    told(Case("mentor", OneMore, ()), story)


def test_a_write_of_several_values_makes_no_other_values_of_the_node_stale() -> None:
    async def story(drive: Any, device: Device, bus: Bus) -> None:
        points = [drive.point(item) for item in ("1.17", "1.18", "1.19")]
        await cycles(bus.poll_group("g", period=1000.0, points=points), 1)
        await drive.write("1.17", 7, 5)
        assert [bus.latest(point) is None for point in points] == [True, True, False]

    told(CASES["point by point"], story)


def test_a_chain_or_a_step_needs_a_count() -> None:
    async def story(drive: Any, device: Device, bus: Bus) -> None:
        for options in ({"chain": True}, {"step": -1}):
            with pytest.raises(InvalidCommand, match="need a count"):
                await drive.read("1.17", **options)

    told(CASES["mentor"], story)
