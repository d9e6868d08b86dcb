"""What a user mistypes is told at once, in words, and nothing is sent."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from decimal import Decimal
from math import inf, nan
from typing import Any, cast

import pytest

from busmaster import (
    Bus,
    CtAnsiDrive,
    Hcp2Controller,
    InvalidCommand,
    LineSettings,
    MemoryPort,
    MentorDrive,
    MicroFlexDrive,
    PollGroup,
    Priority,
    ReplyTiming,
    SerialPort,
    Superseded,
    TcpPort,
    Timings,
)
from busmaster.bus.node import Node
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import find, make_device
from busmaster.testing import run_in_virtual_time

TIMING = ReplyTiming(0.05, 0.1, 0.15, 0.02)


def bus_of(*protocols: str, delay: float = 0.002) -> Bus:
    """On a line with a node 1 of each protocol."""
    devices = [make_device(protocol, 1, delay=Delay(delay)) for protocol in protocols or ("hcp2",)]
    return Bus(MemoryPort(Line(LineSettings(57600), devices)))


@pytest.mark.parametrize(
    "mistake",
    [
        lambda: Bus(cast("Any", "/dev/ttyUSB0")),
        lambda: Bus(SerialPort("/dev/ttyUSB0", baudrate=57600), capacity=0),
        lambda: Bus(SerialPort("/dev/ttyUSB0", baudrate=57600), capacity=cast("Any", nan)),
        lambda: TcpPort("host", cast("Any", "x")),
        lambda: SerialPort("/dev/ttyUSB0", baudrate=cast("Any", "57600")),
        lambda: SerialPort("/dev/ttyUSB0", baudrate=True),
        *(lambda wrong=wrong: replace(TIMING, late_after=wrong) for wrong in (-0.01, nan, True, "0.05")),
        *(lambda wrong=wrong: replace(TIMING, max_reply_delay=wrong) for wrong in (inf, nan, None)),
        *(lambda wrong=wrong: replace(TIMING, inter_byte_timeout=wrong) for wrong in (0.0, -1.0, True)),
    ],
)
def test_a_wrong_kind_of_value_for_a_port_or_a_time_is_refused_in_words(mistake: Callable[[], object]) -> None:
    with pytest.raises(InvalidCommand):
        mistake()


REQUESTS: list[Callable[[Hcp2Controller], Awaitable[object]]] = [
    lambda axis: axis.node.request(cast("Any", "read")),
    lambda axis: axis.read(1, priority=cast("Any", -1)),
    lambda axis: axis.read(1, priority=cast("Any", 4)),
    lambda axis: axis.read(1, priority=cast("Any", True)),
    lambda axis: axis.read(1, priority=cast("Any", 0.0)),
    lambda axis: axis.write(1, 1.0, priority=cast("Any", "urgent")),
    lambda axis: axis.element(1).read(priority=cast("Any", -1)),
    lambda axis: axis.element(1).write(1.0, priority=cast("Any", -1)),
    lambda axis: Node.of(axis).timed_request(hcp2.Read(1), priority=cast("Any", -1)),
    lambda axis: axis.read(1, retries=-1),
    lambda axis: axis.read(1, retries=101),
    lambda axis: axis.read(1, retries=True),
    lambda axis: axis.read(1, retries=cast("Any", 1.5)),
    lambda axis: axis.read(1, start_within=-1.0),
    lambda axis: axis.read(1, start_within=nan),
    lambda axis: axis.read(1, start_within=inf),
    lambda axis: axis.read(1, start_within=True),
    lambda axis: axis.read(1, start_within=cast("Any", "1")),
    lambda axis: axis.read(True),
    lambda axis: axis.read(cast("Any", 1.0)),
    lambda axis: axis.element(1).read(max_age=nan),
    lambda axis: axis.element(1).read(max_age=-1.0),
    lambda axis: MicroFlexDrive(axis.bus, 1).enable(within=nan),
    lambda axis: MicroFlexDrive(axis.bus, 1).disable(within=-1.0),
]


@pytest.mark.parametrize("ask", REQUESTS)
def test_a_mistyped_request_is_refused_before_anything_is_sent(
    ask: Callable[[Hcp2Controller], Awaitable[object]],
) -> None:
    async def main() -> None:
        async with bus_of() as bus:
            with pytest.raises(InvalidCommand):
                await ask(Hcp2Controller(bus, 1))
            assert (await bus.statistics()).exchanges == 0

    run_in_virtual_time(main())


def group(bus: Bus, **options: Any) -> PollGroup:
    usual: dict[str, Any] = {"period": 1.0, "points": [Hcp2Controller(bus, 1).element(1)]}
    return bus.poll_group("group", **(usual | options))


@pytest.mark.parametrize(
    "mistake",
    [
        *(lambda bus, wrong=wrong: bus.node(hcp2.PROFILE, wrong) for wrong in (True, 1.0, "1", 256, -1)),
        *(lambda bus, wrong=wrong: Hcp2Controller(bus, 2, retries=wrong) for wrong in (True, -1, 101, 1.0)),
        lambda bus: Hcp2Controller(bus, 2, timings=cast("Any", TIMING)),
        lambda bus: Hcp2Controller(bus, 1).axis(True),
        lambda bus: Hcp2Controller(bus, 1).axis(8),
        lambda bus: Hcp2Controller(bus, 1).io.adc(True),
        lambda bus: Node.of(Hcp2Controller(bus, 1)).suspend(nan),
        lambda bus: Node.of(Hcp2Controller(bus, 1)).suspend(True),
        lambda bus: MentorDrive(bus, 11, decimals={"1.17": cast("Any", 1.5)}),
        *(lambda bus, wrong=wrong: CtAnsiDrive(bus, 11, decimals={"1.21": wrong}) for wrong in (1.5, "1", -1, True)),
        lambda bus: CtAnsiDrive(bus, 11, decimals={"1.21": 1, "01.21": 2}),
        *(lambda bus, wrong=wrong: group(bus, period=wrong) for wrong in (0.0, -1.0, nan, inf, True, "1")),
        *(lambda bus, wrong=wrong: group(bus, phase=wrong) for wrong in (-0.1, 1.0, nan, True)),
        *(lambda bus, wrong=wrong: group(bus, priority=wrong) for wrong in (-1, 4, True, 2.0, "poll")),
        *(lambda bus, wrong=wrong: group(bus).subscribe(wrong) for wrong in (0, True, 1.5)),
        *(lambda bus, wrong=wrong: bus.worst_case_wait(wrong) for wrong in (-1, True, 1.0)),
    ],
)
def test_a_mistyped_argument_of_a_bus_or_a_handle_is_refused(mistake: Callable[[Bus], object]) -> None:
    async def main() -> None:
        async with bus_of() as bus:
            with pytest.raises(InvalidCommand):
                mistake(bus)
            assert (await bus.statistics()).exchanges == 0

    run_in_virtual_time(main())


MANY = "9" * 5000
"""More digits than Python makes a number of."""
NO_NUMBERS: list[Any] = ["x", "", MANY, None, [], {}, b"1", 1 + 2j, nan, inf, Decimal("nan"), 10**400]


@pytest.mark.parametrize(
    ("protocol", "items"),
    [
        ("hcp", "1"),
        ("hcp2", "1 outputs"),
        ("microflex", "speed_reference command_word"),
        ("msc", "2008 2008:2 flag:5"),
        ("mentor", "1.17 speed_reference_1 1.17:wide 1.17:hires"),
        ("ct-ansi", "1.21 1.22"),
        ("dc104", "5"),
        ("modbus", "holding:1 holding:1:2 holding:1:float32 holding:1:int32 coil:1 coil:1:2"),
    ],
)
def test_what_is_no_number_and_no_item_is_refused_in_words_by_every_handle(protocol: str, items: str) -> None:
    kind = find(protocol)
    address = next(iter(kind.profile.addresses), 0) if protocol != "mentor" else 11

    async def main() -> None:
        async with Bus(MemoryPort(Line(kind.profile.line, [make_device(protocol, address)]))) as bus:
            options: dict[str, Any] = {"decimals": {"1.21": 1}} if protocol == "ct-ansi" else {}
            handle = kind.handle(bus, address, **options)
            for item in items.split():
                for wrong in NO_NUMBERS:
                    with pytest.raises(InvalidCommand):
                        await handle.point(item).write(wrong)
            for mistyped in (MANY, f"1.{MANY}", f"1.17:{MANY}", f"holding:{MANY}", f"coil:1:{MANY}", "", "\u0661"):
                with pytest.raises(InvalidCommand):
                    handle.point(mistyped)
            assert (await bus.statistics()).exchanges == 0

    run_in_virtual_time(main())


def test_the_number_of_a_priority_is_that_priority_and_an_urgent_write_overtakes_by_it() -> None:
    async def main() -> None:
        async with bus_of("microflex", delay=0.05) as bus:
            drive = MicroFlexDrive(bus, 1)
            reading = asyncio.create_task(drive.read(109))
            enabling = asyncio.create_task(drive.write(108, 128.0))
            await asyncio.sleep(0.01)
            await drive.write(108, 0.0, priority=cast("Any", 0))
            with pytest.raises(Superseded):
                await enabling
            await reading
            assert bus.worst_case_wait(cast("Any", 0)) == bus.worst_case_wait(Priority.URGENT)

    run_in_virtual_time(main())


def test_timings_are_taken_as_timings() -> None:
    async def main() -> None:
        async with bus_of() as bus:
            assert Node.of(Hcp2Controller(bus, 1, timings=Timings.uniform(TIMING))).timings.read == TIMING

    run_in_virtual_time(main())
