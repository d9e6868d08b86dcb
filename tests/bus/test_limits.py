"""Limits: held at the node, so that no name and no way of writing goes round them; and a stop passes all of them."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, TypeAlias, cast

import pytest

from busmaster.bus.bus import Bus
from busmaster.bus.handle import Handle
from busmaster.bus.node import Health, Node, Priority
from busmaster.bus.requester import WriteOptions
from busmaster.emulator.device import Delay, Device
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import (
    BusError,
    GarbledReply,
    InvalidCommand,
    NoReply,
    NotStarted,
    Refused,
    Superseded,
    WriteUnconfirmed,
)
from busmaster.protocols.ct_ansi.handle import CtAnsiDrive
from busmaster.protocols.dc104.handle import Dc104Drive
from busmaster.protocols.hcp.handle import HcpController
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.hcp2.microflex_handle import MicroFlexDrive
from busmaster.protocols.mentor.codec import PROFILE as MENTOR
from busmaster.protocols.mentor.handle import MentorDrive
from busmaster.protocols.modbus.codec import PROFILE as MODBUS
from busmaster.protocols.modbus.codec import WriteRegisters
from busmaster.protocols.modbus.handle import ModbusUnit
from busmaster.protocols.msc.handle import MscController
from busmaster.registry import make_device
from tests.stories import in_use, in_virtual_time

Way: TypeAlias = Callable[[Any, float], Awaitable[None]]


def bus_of(handle: type[Handle], *devices: Device) -> Bus:
    return Bus(MemoryPort(Line(handle.profile.line, list(devices), chance=random.Random(1))))


@asynccontextmanager
async def controller() -> AsyncIterator[Hcp2Controller]:
    bus = bus_of(Hcp2Controller, make_device("hcp2", 5))
    async with bus:
        in_use(bus)
        yield Hcp2Controller(bus, 5)


@asynccontextmanager
async def slow_drive(seconds: float) -> AsyncIterator[tuple[Hcp2Controller, Bus]]:
    """A drive that takes this time to reply, of which one value changes in steps."""
    async with bus_of(Hcp2Controller, make_device("hcp2", 5, delay=Delay(seconds, seconds))) as bus:
        in_use(bus)
        drive = Hcp2Controller(bus, 5)
        await drive.read(10)
        drive.element(10).limit(max_step=20)
        yield drive, bus


HCP2_WAYS: dict[str, Way] = {
    "its point": lambda drive, value: drive.element(10).write(value),
    "another point of it": lambda drive, value: drive.point("10").write(value),
    "by number": lambda drive, value: drive.write(10, value),
    "in a list": lambda drive, value: drive.write(9, 1.0, value, 2.0),
    "in the second telegram of a list": lambda drive, value: drive.write(1, *[1234.5678] * 9, value),
    "from the command line": lambda drive, value: drive._prepare_write("10", [value])[0](),
    "as a raw command": lambda drive, value: drive.node.request(hcp2.Write(10, (value,))),
    "as a timed request": lambda drive, value: drive.node.timed_request(hcp2.Write(10, (value,))),
    "as an urgent command": lambda drive, value: drive.write(10, value, priority=Priority.URGENT),
    "from another handle": lambda drive, value: MicroFlexDrive(drive.bus, 5).element(10).write(value),
}


@pytest.mark.parametrize("way", HCP2_WAYS.values(), ids=HCP2_WAYS)
@in_virtual_time
async def test_no_way_of_writing_goes_round_a_limit(way: Way) -> None:
    async with controller() as drive:
        drive.element(10).limit(minimum=-50, maximum=500)
        await way(drive, 500)
        assert await drive.read(10) == 500
        sent = Node.of(drive).statistics().attempts
        for value, limit in ((501, "maximum of 500"), (-51, "minimum of -50"), (1e9, "maximum")):
            with pytest.raises(InvalidCommand, match=f"node 5: 10 = .* its {limit}"):
                await way(drive, value)
        assert Node.of(drive).statistics().attempts == sent
        assert await drive.read(10) == 500


@in_virtual_time
async def test_what_may_not_be_written_is_refused_whatever_the_value() -> None:
    async with controller() as drive:
        drive.element(10).limit(writable=False)
        with pytest.raises(InvalidCommand, match="10 may not be written"):
            await drive.write(9, 1.0, 2.0)
        await drive.write(9, 1.0)


PLACES: list[tuple[str, type[Handle], int, str, dict[str, Any]]] = [
    ("hcp", HcpController, 5, "10", {}),
    ("hcp2", Hcp2Controller, 5, "10", {}),
    ("mentor", MentorDrive, 14, "1.17", {}),
    ("mentor", MentorDrive, 14, "speed_reference_1", {}),
    ("ct-ansi", CtAnsiDrive, 14, "1.21", {}),
    ("dc104", Dc104Drive, 0, "12", {}),
    ("msc", MscController, 3, "2008", {}),
    ("modbus", ModbusUnit, 17, "holding:40", {}),
    ("modbus", ModbusUnit, 17, "holding:40:float32", {}),
]


@pytest.mark.parametrize(("kind", "handle", "address", "item", "options"), PLACES, ids=str)
@in_virtual_time
async def test_every_protocol_says_what_its_writes_change(
    kind: str, handle: type[Handle], address: int, item: str, options: dict[str, Any]
) -> None:
    bus = bus_of(handle, make_device(kind, address))
    async with bus:
        drive = handle(bus, address, **options)
        drive.point(item).limit(minimum=0, maximum=50, max_step=40)
        await drive.point(item).write(30)
        assert await drive.point(item).read() == 30
        with pytest.raises(InvalidCommand, match=f"{item} = 51.* above its maximum of 50"):
            await drive.point(item).write(51)
        await drive.point(item).write(0)
        with pytest.raises(InvalidCommand, match="max_step is 40"):
            await drive._prepare_write(item, [45])[0]()


@in_virtual_time
async def test_a_number_of_two_registers_is_not_written_in_halves() -> None:
    bus = bus_of(ModbusUnit, make_device("modbus", 17))
    async with bus:
        unit = ModbusUnit(bus, 17)
        unit.point("holding:40:float32").limit(maximum=500.0)
        for work in (
            unit.write("holding:40", 0x4B00),
            unit.write("holding:39", 1, 0x4B00),
            unit.node.request(WriteRegisters(41, (5,))),
        ):
            with pytest.raises(InvalidCommand, match="write it as a whole"):
                await work
        await unit.write("holding:39", 1, 0x43FA, 0)
        assert await unit.read("holding:40:float32") == 500.0
        with pytest.raises(InvalidCommand, match="maximum of 500"):
            await unit.write("holding:39", 1, 0x4B00, 0)


@in_virtual_time
async def test_a_block_of_an_msc_is_held_to_the_limit_of_each_of_its_values() -> None:
    bus = bus_of(MscController, make_device("msc", 3))
    async with bus:
        press = MscController(bus, 3, symbols={"speed": 2012})
        press.point("speed").limit(maximum=100)
        press.point("flag:5").limit(writable=False)
        with pytest.raises(InvalidCommand, match="as a whole, and alone"):
            await press.write_block(2000, range(32))
        press.address_step = 4
        await press.write_block(2000, range(32))
        for work in (
            press.write_block(2000, range(98, 130)),
            press.write(2012, 101),
            press.write(2010, 1),
            press.write_block(1996, [0, 0, 0, 0, 101]),
            press.point("1996:5").write((0, 0, 0, 0, 101)),
            press.set_flag(5),
        ):
            with pytest.raises(InvalidCommand):
                await work
        assert await press.read("speed") == 3


@pytest.mark.parametrize(
    ("profile", "handle", "item", "first"),
    [(MENTOR, MentorDrive, "1.17", 14), (MODBUS, ModbusUnit, "holding:40", 14)],
    ids=["mentor", "modbus"],
)
@in_virtual_time
async def test_a_write_to_all_is_held_to_the_limits_of_each(
    profile: Any, handle: type[Handle], item: str, first: int
) -> None:
    bus = bus_of(handle, make_device(profile.name, first), make_device(profile.name, first + 1))
    async with bus:
        drives = [handle(bus, address) for address in (first, first + 1)]
        drives[1].point(item).limit(maximum=100, max_step=60)
        everyone = handle(bus, 0)
        with pytest.raises(InvalidCommand, match=r"node 15: .* maximum of 100"):
            await everyone.write(item, 101)
        with pytest.raises(InvalidCommand, match=r"node 15: .* max_step is 60"):
            await everyone.write(item, 61)
        await everyone.write(item, 50)
        await drives[0].write(item, 101)
        with pytest.raises(InvalidCommand, match="101"):
            await drives[1].write(item, 101)
        await drives[1].write(item, 100)


@in_virtual_time
async def test_a_step_counts_from_the_last_confirmed_value_which_is_read_first_if_unknown() -> None:
    async with controller() as drive:
        await drive.write(10, 100.0)
        drive.element(10).limit(max_step=20)
        with pytest.raises(InvalidCommand, match="10 = 121 is too far from 100: its max_step is 20"):
            await drive.write(10, 121)
        await drive.write(10, 120)
        await drive.write(9, 0.0, 140)
        await drive.write(10, 0, priority=Priority.URGENT)
        with pytest.raises(InvalidCommand, match="from 0"):
            await drive.write(10, 21)
        first, second = await asyncio.gather(drive.write(10, 20), drive.write(10, -20), return_exceptions=True)
        assert first is None
        assert "from 20" in str(second)
        first, late = await asyncio.gather(
            drive.write(10, 21), drive.write(10, 22, start_within=0.0), return_exceptions=True
        )
        assert first is None
        assert isinstance(late, NotStarted)
        assert await drive.read(10) == 21


@in_virtual_time
async def test_a_step_counts_from_what_is_read_where_the_write_before_may_have_been_carried_out() -> None:
    device = make_device("hcp2", 5)
    async with bus_of(Hcp2Controller, device) as bus:
        drive = Hcp2Controller(bus, 5)
        drive.element(10).limit(max_step=20)
        await drive.write(10, 20)
        device.faults.lost = 1.0
        with pytest.raises(WriteUnconfirmed):
            await drive.write(10, 40, idempotent=False)
        device.faults.lost = 0.0
        await drive.write(10, 60)


@in_virtual_time
async def test_a_step_counts_from_what_is_read_where_the_writer_before_was_cancelled() -> None:
    async with controller() as drive:
        drive.element(10).limit(max_step=20)
        await drive.write(10, 20)
        writing = asyncio.ensure_future(drive.write(10, 40))
        await asyncio.sleep(0.001)  # it is on the wire
        writing.cancel()
        await asyncio.gather(writing, return_exceptions=True)
        await drive.write(10, 60)
        assert await drive.read(10) == 60


@in_virtual_time
async def test_a_step_counts_from_what_is_read_after_a_stop() -> None:
    async with bus_of(MicroFlexDrive, make_device("microflex", 7)) as bus:
        drive = MicroFlexDrive(bus, 7)
        drive.command_word.limit(max_step=5)
        await drive.write("command_word", 3)
        await drive.disable()
        with pytest.raises(InvalidCommand, match="8 is too far from 0"):
            await drive.write("command_word", 8)


@in_virtual_time
async def test_a_limit_that_is_set_while_a_write_waits_for_its_step_holds_it() -> None:
    async with controller() as drive:
        drive.element(10).limit(max_step=20)
        waiting = asyncio.ensure_future(drive.write(10, 20))
        await asyncio.sleep(0)  # it reads the value before it
        drive.element(10).limit(maximum=10)
        with pytest.raises(InvalidCommand, match="maximum of 10"):
            await waiting
        assert await drive.read(10) == 0


@in_virtual_time
async def test_a_limit_that_is_lifted_and_held_again_reads_the_value_it_steps_from() -> None:
    device = make_device("hcp2", 5)
    async with bus_of(Hcp2Controller, device) as bus:
        drive = Hcp2Controller(bus, 5)
        drive.element(10).limit(max_step=20)
        await drive.write(10, 20)
        [limit] = Node.of(drive).limits
        Node.of(drive).lift(limit)
        assert Node.of(drive).limits == ()
        await drive.write(10, 100)
        Node.of(drive).limit(limit)
        with pytest.raises(InvalidCommand, match="30 is too far from 100"):
            await drive.write(10, 30)


@in_virtual_time
async def test_a_step_counts_from_what_is_read_where_the_node_was_away() -> None:
    device = make_device("hcp2", 5)
    async with bus_of(Hcp2Controller, device) as bus:
        drive = Hcp2Controller(bus, 5)
        drive.element(10).limit(max_step=20)
        await drive.write(10, 20)
        for state, dead in ((Health.DOWN, 1.0), (Health.UP, 0.0)):
            device.faults.dead = dead
            while Node.of(drive).health is not state:
                await asyncio.gather(drive.read(1), asyncio.sleep(0.5), return_exceptions=True)
        device.preset("10", 100)
        with pytest.raises(InvalidCommand, match="30 is too far from 100"):
            await drive.write(10, 30)


@in_virtual_time
async def test_the_time_of_a_write_counts_from_before_the_value_is_read_from_which_it_steps() -> None:
    slow = 0.03
    async with slow_drive(slow) as (drive, bus):
        began = bus.now()
        with pytest.raises(WriteUnconfirmed):
            await drive.write(10, 20, finish_within=2 * slow)
        assert bus.now() - began == pytest.approx(2 * slow, abs=0.001)


@in_virtual_time
async def test_a_write_to_all_is_held_to_the_limits_of_those_of_another_protocol_that_hear_it() -> None:
    async with bus_of(MentorDrive, make_device("mentor", 14), make_device("ct-ansi", 15)) as bus:
        CtAnsiDrive(bus, 15).point("1.21").limit(maximum=100)
        with pytest.raises(InvalidCommand, match=r"node 15: .* maximum of 100"):
            await MentorDrive(bus, 0).write("1.21", 101)


@in_virtual_time
async def test_an_urgent_write_that_is_refused_overtakes_nothing() -> None:
    async with controller() as drive:
        drive.element(10).limit(maximum=100, max_step=20)
        waiting = asyncio.ensure_future(drive.write(10, 20))
        await asyncio.sleep(0)
        with pytest.raises(InvalidCommand, match="maximum of 100"):
            await drive.element(10).write(101, priority=Priority.URGENT)
        await waiting
        assert await drive.read(10) == 20


@in_virtual_time
async def test_a_stop_passes_every_limit_and_what_waits_for_a_step_is_not_sent_after_it() -> None:
    bus = bus_of(MicroFlexDrive, make_device("microflex", 7))
    async with bus:
        drive = MicroFlexDrive(bus, 7)
        await drive.enable()
        drive.command_word.limit(minimum=1, max_step=1, writable=False)
        drive.speed_reference.limit(maximum=50, max_step=5)
        with pytest.raises(InvalidCommand):
            await drive.write("command_word", 0)
        waiting = [asyncio.ensure_future(drive.speed_reference.write(value)) for value in (1, 2, 3)]
        await asyncio.sleep(0)
        await drive.disable()
        ended = await asyncio.gather(*waiting, return_exceptions=True)
        assert any(isinstance(end, Superseded) for end in ended)
        assert not any(isinstance(end, InvalidCommand) for end in ended)
        assert not await drive.status() & 0x80
        with pytest.raises(InvalidCommand, match="maximum of 50"):
            await drive.set_speed_reference(51)


def test_limits_that_mean_nothing_are_refused() -> None:
    bus = bus_of(MscController)
    press = MscController(bus, 3)
    wrongs: list[dict[str, Any]] = [{"minimum": 2, "maximum": 1}, {"max_step": 0}]
    for wrong in wrongs:
        with pytest.raises(InvalidCommand):
            press.point("2008").limit(**wrong)
    with pytest.raises(InvalidCommand, match="limit each value"):
        press.point("2008:32").limit(maximum=1)


@in_virtual_time
async def test_a_value_beyond_its_limits_comes_back_by_a_step_from_the_nearest_limit() -> None:
    async with controller() as drive:
        for outside, inside, too_far, limit in ((900, 450, 449, 500), (-40, 50, 51, 0)):
            await drive.write(10, outside)
            held = drive.element(10).limit(minimum=0, maximum=500, max_step=50)
            with pytest.raises(InvalidCommand) as refused:
                await drive.write(10, too_far)
            assert f"10 = {too_far} is too far from {limit} (it is {outside} now, beyond its limits)" in str(
                refused.value
            )
            await drive.write(10, inside)
            with pytest.raises(InvalidCommand, match=f"too far from {inside}: "):
                await drive.write(10, inside + 60 if limit == 0 else inside - 60)
            Node.of(drive).lift(held)


@pytest.mark.parametrize(("fault", "cause"), [({"dead": 1.0}, NoReply), ({"flip": 1.0}, GarbledReply)], ids=str)
@in_virtual_time
async def test_a_write_is_not_sent_if_the_value_from_which_it_steps_cannot_be_read(
    fault: dict[str, float], cause: type[BusError]
) -> None:
    device = make_device("hcp2", 5)
    async with bus_of(Hcp2Controller, device) as bus:
        drive = Hcp2Controller(bus, 5)
        drive.element(10).limit(max_step=20)
        for name, rate in fault.items():
            setattr(device.faults, name, rate)
        for finish_within in (None, 100.0):
            with pytest.raises(NotStarted, match="the current value, needed for max_step, could not be read") as failed:
                await drive.write(10, 20, finish_within=finish_within)
            assert isinstance(failed.value.__cause__, cause)
            assert failed.value.__cause__.what in failed.value.what
            assert failed.value.hint == cause.hint
            assert (failed.value.label, failed.value.command) == ("node 5", "write element 10 = 20")


@in_virtual_time
async def test_a_write_is_not_sent_if_the_node_refuses_to_read_the_value_from_which_it_steps() -> None:
    async with bus_of(Dc104Drive, make_device("dc104", 0, maximum=9)) as bus:
        drive = Dc104Drive(bus, maximum=12)
        drive.point("12").limit(max_step=20)
        with pytest.raises(NotStarted, match="could not be read") as failed:
            await drive.write(12, 20)
        assert isinstance(failed.value.__cause__, Refused)


@in_virtual_time
async def test_a_write_that_does_not_declare_its_changes_is_refused_by_a_node_with_limits() -> None:
    class Opaque:
        """A write of an element, which does not declare its changes."""

        writes, idempotent, open = True, False, hcp2.Write(11, (5.0,)).open

        def __str__(self) -> str:
            return "opaque write"

    async with controller() as drive:
        await drive.node.request(Opaque())
        drive.element(10).limit(maximum=10)
        with pytest.raises(InvalidCommand, match="node 5 has limits, and opaque write does not declare its changes"):
            await drive.node.request(Opaque())


@in_virtual_time
async def test_the_limits_of_a_lent_node_end_with_the_last_who_gives_it_back() -> None:
    async with bus_of(Hcp2Controller, make_device("hcp2", 5)) as bus:
        lent = bus._lend_node(Hcp2Controller.profile, 5)
        point = Hcp2Controller(SimpleNamespace(node=lambda *_, **__: lent), 5).element(10)
        point.limit(maximum=10)
        assert [limit.name for limit in lent.limits] == ["10"]
        bus._give_back(lent)
        assert not [limit.name for limit in lent.limits]
        await Hcp2Controller(bus, 5).write(10, 11)


@in_virtual_time
async def test_a_limit_of_a_held_handle_applies_to_its_node() -> None:
    async with controller() as drive, drive.exclusive() as held:
        held.element(10).limit(maximum=10)
        with pytest.raises(InvalidCommand, match="maximum of 10"):
            await held.write(10, 11)
        with pytest.raises(InvalidCommand, match="maximum of 10"):
            drive.node.check(hcp2.Write(10, (11.0,)))
        with pytest.raises(InvalidCommand, match="maximum of 10"):
            held.node.check(hcp2.Write(9, (1.0,)), hcp2.Write(10, (11.0,)))
        drive.node.check(hcp2.Write(10, (11.0,)), stop=True)
        held.node.check(hcp2.Write(10, (11.0,)), stop=True)
        assert len(Node.of(drive).limits) == 1


@in_virtual_time
async def test_the_value_from_which_a_write_steps_is_read_with_the_priority_of_the_write() -> None:
    async with bus_of(Hcp2Controller, make_device("hcp2", 5)) as bus:
        drive = Hcp2Controller(bus, 5)
        drive.element(10).limit(max_step=20)
        await drive.write(10, 20, priority=Priority.BACKGROUND)
        waits = (await bus.statistics()).waits
        assert (waits[Priority.BACKGROUND].count, waits[Priority.COMMAND].count) == (2, 0)


@in_virtual_time
async def test_a_step_counts_from_what_is_read_after_a_write_to_all_because_no_node_confirms_it() -> None:
    device = make_device("mentor", 14)
    async with bus_of(MentorDrive, device) as bus:
        drive = MentorDrive(bus, 14)
        drive.point("1.17").limit(max_step=60)
        await MentorDrive(bus, 0).write("1.17", 50)
        device.preset("1.17", 100)
        await drive.write("1.17", 150)
        assert await drive.read("1.17") == 150


@pytest.mark.parametrize(
    "times",
    [
        {"start_within": 0.05},
        {"finish_within": 0.05},
        {"start_within": 0.05, "finish_within": 5.0},
        {"start_within": 5.0, "finish_within": 0.05},
    ],
)
@in_virtual_time
async def test_a_write_is_not_sent_if_the_value_from_which_it_steps_is_not_read_within_its_time(
    times: dict[str, float],
) -> None:
    async with bus_of(Hcp2Controller, make_device("hcp2", 5, delay=Delay(0.09))) as bus:
        in_use(bus)
        drive = Hcp2Controller(bus, 5)
        drive.element(10).limit(max_step=20)
        began, options = bus.now(), cast("WriteOptions", times)
        with pytest.raises(NotStarted, match="the current value was not read in time"):
            await drive.write(10, 20, **options)
        assert bus.now() - began == pytest.approx(0.05, abs=0.001)
        assert await drive.read(10) == 0


@in_virtual_time
async def test_a_message_about_a_limit_has_the_unit_of_the_point() -> None:
    async with controller() as drive:
        replace(drive.element(10), unit="m/min").limit(maximum=500, max_step=50)
        with pytest.raises(InvalidCommand, match=r"10 = 501 m/min is above its maximum of 500 m/min$"):
            await drive.write(10, 501)
        with pytest.raises(InvalidCommand, match=r"10 = 51 m/min is too far from 0 m/min: its max_step is 50 m/min$"):
            await drive.write(10, 51)


@in_virtual_time
async def test_the_time_in_which_a_write_must_be_sent_counts_from_before_its_current_value_is_read() -> None:
    slow = 0.03
    async with slow_drive(slow) as (drive, _):
        writing = asyncio.ensure_future(drive.write(10, 20, start_within=1.5 * slow))
        await asyncio.sleep(0.001)
        reading = asyncio.ensure_future(drive.read(10))  # goes before the write, which waits for its value
        with pytest.raises(NotStarted):
            await writing
        assert await reading == 0


@in_virtual_time
async def test_a_write_of_the_safe_state_is_not_limited_and_needs_no_current_value() -> None:
    async with controller() as drive:
        drive.element(10).limit(maximum=50, max_step=5)
        await drive.write(10, 100, safe=True)
        assert Node.of(drive).statistics().attempts == 1, "the value before was not read"
        assert await drive.read(10) == 100


def test_a_limit_allows_for_the_rounding_of_the_protocol_and_steps_begin_at_the_nearest_limit() -> None:
    drive = Hcp2Controller(bus_of(Hcp2Controller), 5)
    limit = drive.element(10).limit(minimum=10.1, maximum=20.1, max_step=0.3)
    for value in (10.1, 10.0999999, 20.1, 20.1000001):
        limit.check(value)
    for value, text in ((10.099, "below its minimum of 10.1"), (20.101, "above its maximum of 20.1")):
        with pytest.raises(InvalidCommand, match=text):
            limit.check(value)
    for before, value in ((10.1, 10.1 + 0.1 + 0.1 + 0.1), (0.0, 10.4), (99.0, 19.8)):
        limit.check_step(before, value)
    for before, value in ((10.1, 10.401), (0.0, 10.401), (99.0, 19.799)):
        with pytest.raises(InvalidCommand, match="is too far from"):
            limit.check_step(before, value)
