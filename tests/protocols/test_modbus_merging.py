"""Modbus: which reads of a poll group share an exchange, what a refusal does to it, and that no value is another's."""

from __future__ import annotations

import asyncio
from typing import Any, Self

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings
from pymodbus import FramerType
from pymodbus.datastore import ModbusDeviceContext, ModbusSequentialDataBlock, ModbusServerContext
from pymodbus.server import ModbusTcpServer

from busmaster import Bus, InvalidCommand, ModbusUnit, Refused, TcpPort
from busmaster.bus.node import Node
from busmaster.bus.samples import Sample
from busmaster.contract.exchange import Done
from busmaster.contract.profile import LineSettings
from busmaster.planning.merging import without_refused
from busmaster.protocols.modbus.codec import PROFILE, MergedRead, Merging, ReadBits, ReadRegisters
from busmaster.protocols.modbus.device import EmulatedModbus
from tests.ports import free_port
from tests.protocols.modbus_frames import UNIT, frame
from tests.stories import Story, cycles, on_a_bus

LINE = LineSettings(19200, parity="E")
SIZE = 1000


def a_unit(**options: Any) -> EmulatedModbus:
    """A unit whose every place has a value that is its own."""
    return EmulatedModbus(
        UNIT,
        [7 * place % 65521 for place in range(SIZE)],
        inputs=[40_000 + place for place in range(SIZE)],
        coils=[place % 3 == 0 for place in range(SIZE)],
        discretes=[place % 5 == 0 for place in range(SIZE)],
        **options,
    )


def on_a_line(story: Story, device: EmulatedModbus) -> None:
    on_a_bus(story, device, settings=LINE)


def sent(unit: ModbusUnit) -> int:
    return Node.of(unit).statistics().attempts


# the merge


def merged(*commands: Any, **limits: int) -> list[tuple[str, tuple[int, ...]]]:
    return [(str(batch.command), batch.serves) for batch in Merging(**limits)(commands)]


def test_neighbours_of_a_table_are_one_read_and_a_gap_begins_another() -> None:
    reads = [ReadRegisters(12), ReadRegisters(10, 2), ReadRegisters(13), ReadRegisters(15), ReadRegisters(16)]
    assert merged(*reads) == [("read holding 10-13", (1, 0, 2)), ("read holding 15-16", (3, 4))]


def test_tables_are_never_mixed() -> None:
    reads = [ReadRegisters(1), ReadRegisters(2, table="input"), ReadBits(1), ReadBits(2, table="discrete")]
    assert merged(*reads) == []
    others = [ReadRegisters(2), ReadRegisters(1, table="input"), ReadBits(2), ReadBits(1, table="discrete")]
    assert merged(*reads, *others) == [
        ("read holding 1-2", (0, 4)),
        ("read input 1-2", (5, 1)),
        ("read coil 1-2", (2, 6)),
        ("read discrete 1-2", (7, 3)),
    ]


def test_overlapping_reads_share_their_places() -> None:
    assert merged(ReadRegisters(10, 4), ReadRegisters(11), ReadRegisters(12, 4)) == [("read holding 10-15", (0, 1, 2))]


def test_a_read_has_no_more_than_the_unit_returns() -> None:
    registers, bits = [ReadRegisters(n) for n in range(300)], [ReadBits(n) for n in range(2001)]
    assert [len(serves) for _, serves in merged(*registers)] == [125, 125, 50]
    assert [len(serves) for _, serves in merged(*bits)] == [2000]
    assert [len(serves) for _, serves in merged(*registers[:64], *bits[:40], registers=32, bits=16)] == [
        32,
        32,
        16,
        16,
        8,
    ]
    assert merged(*registers[:9], *bits[:9], registers=1, bits=1) == []
    with pytest.raises(InvalidCommand, match="registers of a read must be 1 to 125"):
        Merging(registers=126)
    with pytest.raises(InvalidCommand, match="bits of a read must be 1 to 2000"):
        Merging(bits=0)


def test_a_number_is_in_one_read_whole() -> None:
    floats = [ReadRegisters(2 * n, 2) for n in range(63)]
    assert [batch.command.whole.count for batch in Merging()(floats)] == [124]  # type: ignore[attr-defined]
    assert merged(*floats[:5], registers=3) == []


def test_a_merged_read_with_a_gap_is_refused() -> None:
    with pytest.raises(InvalidCommand, match="gap at holding 3"):
        MergedRead("holding", ((1, 2), (4, 1)))
    for spans in ((), ((0, 100), (100, 26)), ((0, 0),)):
        with pytest.raises(InvalidCommand):
            MergedRead("holding", spans)


@given(st.lists(st.tuples(st.integers(0, 60), st.integers(1, 9)), min_size=1, unique=True), st.integers(9, 40))
@settings(max_examples=100)
def test_each_command_gets_the_values_of_its_own_places(spans: list[tuple[int, int]], most: int) -> None:
    commands = [ReadRegisters(first, count) for first, count in spans]
    served = []
    for batch in Merging(registers=most)(commands):
        whole: ReadRegisters = batch.command.whole  # type: ignore[attr-defined]
        assert whole.count <= most
        words = "".join(f"{1000 + place:04x}" for place in range(whole.first, whole.first + whole.count))
        exchange = batch.command.open(UNIT, PROFILE.timings)
        assert exchange.request == whole.open(UNIT, PROFILE.timings).request
        done = exchange.feed(frame(f"11 03 {2 * whole.count:02x} {words}"))
        assert isinstance(done, Done)
        for index, value in zip(batch.serves, done.value, strict=True):
            assert value == tuple(1000 + place for place in range(spans[index][0], sum(spans[index])))
            served.append(index)
    assert len(set(served)) == len(served)


def test_the_halves_of_a_refused_read_are_proposed_in_its_place() -> None:
    commands = [ReadRegisters(n) for n in range(8)]
    refused: set[Any] = set()
    seen = []
    for _ in range(4):
        batches = without_refused(Merging(), refused)(commands)
        seen.append([str(batch.command) for batch in batches])
        assert all(b.command.spans == tuple((i, 1) for i in b.serves) for b in batches)  # type: ignore[attr-defined]
        refused |= {batches[0].command}
    assert seen == [
        ["read holding 0-7"],
        ["read holding 0-3", "read holding 4-7"],
        ["read holding 0-1", "read holding 2-3", "read holding 4-7"],
        ["read holding 2-3", "read holding 4-7"],
    ]


# poll groups


def test_a_group_reads_each_run_once_and_every_point_has_its_own_value() -> None:
    items = [
        *(f"holding:{n}" for n in range(100, 120)),
        *("holding:120:float32", "holding:122:int32:swapped", "holding:124:uint64", "holding:110:4"),
        *(f"input:{n}" for n in range(100, 104)),
        *(f"coil:{n}" for n in range(30)),
        *(f"discrete:{n}" for n in range(7, 20)),
        "holding:500",
    ]

    async def story(bus: Bus) -> None:
        unit = ModbusUnit(bus, UNIT)
        points = [unit.point(item) for item in items]
        group = bus.poll_group("g", period=1.0, points=points)
        snapshot = (await cycles(group, 1))[0]
        assert sent(unit) == 5
        alone = [await unit.read(item) for item in items]
        assert [snapshot[point].value for point in points] == alone
        assert len(set(map(str, alone))) > 30
        assert [m.serves for m in (await bus.plan()).groups[0].merged] == [24, 4, 30, 13]

    on_a_line(story, a_unit())


def test_one_missing_register_is_found_by_halves_and_remembered() -> None:
    """64 registers, of which the unit lacks the last: one refused point, and the others in a few exchanges."""

    async def story(bus: Bus) -> None:
        unit = ModbusUnit(bus, UNIT)
        points = [unit.point(f"holding:{SIZE - 63 + n}") for n in range(64)]
        group = bus.poll_group("g", period=10.0, points=points)
        first, second = await cycles(group, 2)
        for snapshot in (first, second):
            assert [snapshot[point].value for point in points[:-1]] == [7 * (SIZE - 63 + n) % 65521 for n in range(63)]
            assert isinstance(snapshot[points[-1]].error, Refused)
        # refused: 64, 32, 16, 8, 4, 2, 1 of them; read in each new round: what is not refused yet
        assert (await bus.plan()).groups[0].exchanges == 7
        before = sent(unit)
        await cycles(group, 1)
        assert sent(unit) - before <= 7

    on_a_line(story, a_unit())


class Holed(EmulatedModbus):
    """It lacks the registers 5 and 11, and refuses each read that contains one with exception 3."""

    def _read(self, function: int, first: int, count: int, now: float) -> bytes:
        lacking = {5, 11} & set(range(first, first + count))
        return super()._read(function, first, 0 if lacking else count, now)


def test_two_missing_registers_of_a_run_are_refused_alone_and_the_others_are_read_in_each_cycle() -> None:
    async def story(bus: Bus) -> None:
        unit = ModbusUnit(bus, UNIT)
        points = [unit.point(f"holding:{n}") for n in range(16)]
        group = bus.poll_group("g", period=10.0, points=points)
        async with asyncio.timeout(100.0):
            for snapshot in await cycles(group, 3):
                errors = [type(snapshot[point].error) for point in points]
                assert [n for n, error in enumerate(errors) if error is Refused] == [5, 11]
                assert errors.count(type(None)) == 14
        # of a run, all refused parts are halved at once: 1, 2, 4, 6 and 8 reads, and 8 in each further cycle
        assert sent(unit) <= 1 + 2 + 4 + 6 + 3 * 8
        # read in each cycle: 0-3, 4, 5, 6-7, 8-9, 10, 11 and 12-15
        assert (await bus.plan()).groups[0].exchanges == 8
        before = sent(unit)
        await cycles(group, 1)
        assert sent(unit) - before <= 8, "the refused runs are not sent again"

    on_a_line(story, Holed(UNIT))


class Short(EmulatedModbus):
    """It returns 40 registers at most, and refuses more with exception 3."""

    def _read(self, function: int, first: int, count: int, now: float) -> bytes:
        return super()._read(function, first, count if count <= 40 else 0, now)


def test_a_unit_with_a_lower_limit_is_read_in_halves_or_as_it_is_configured() -> None:
    async def learned(bus: Bus) -> None:
        unit = ModbusUnit(bus, UNIT)
        points = [unit.point(f"holding:{n}") for n in range(100)]
        group = bus.poll_group("g", period=10.0, points=points)
        snapshot = (await cycles(group, 1))[0]
        assert [snapshot[point].value for point in points] == [0] * 100
        assert (await bus.plan()).groups[0].exchanges == 4

    async def configured(bus: Bus) -> None:
        unit = ModbusUnit(bus, UNIT, registers_per_read=40, bits_per_read=8)
        group = bus.poll_group("g", period=10.0, points=[unit.point(f"holding:{n}") for n in range(100)])
        snapshot = (await cycles(group, 1))[0]
        assert {sample.error for sample in snapshot.samples.values()} == {None}
        assert sent(unit) == 3
        assert len(await unit.read("holding:0", 100)) == 100
        assert len(await unit.read("holding:0:float64", 12)) == 12
        assert sent(unit) == 3 + 3 + 2
        other = ModbusUnit(bus, UNIT)
        assert len(await other.read("coil:0", 20)) == 20
        assert sent(unit) == 8 + 3
        with pytest.raises(InvalidCommand, match="another profile"):
            ModbusUnit(bus, UNIT, registers_per_read=41)

    on_a_line(learned, Short(UNIT))
    on_a_line(configured, Short(UNIT))


class Busy(EmulatedModbus):
    """It refuses the first read with exception 6."""

    busy = 1

    def _read(self, function: int, first: int, count: int, now: float) -> bytes:
        if self.busy:
            self.busy -= 1
            return bytes((function | 0x80, 6))
        return super()._read(function, first, count, now)


def test_a_busy_unit_is_not_asked_in_halves() -> None:
    async def story(bus: Bus) -> None:
        unit = ModbusUnit(bus, UNIT)
        points = [unit.point(f"holding:{n}") for n in range(100)]
        group = bus.poll_group("g", period=1.0, points=points)
        first, second = await cycles(group, 2)
        assert {type(first[point].error) for point in points} == {Refused}
        assert {second[point].error for point in points} == {None}
        assert sent(unit) == 2

    on_a_line(story, Busy(UNIT))


def test_a_write_makes_its_point_of_a_merged_read_stale_and_no_other() -> None:
    async def story(bus: Bus) -> None:
        unit = ModbusUnit(bus, UNIT)
        points = [unit.point(f"holding:{n}") for n in range(10)]
        group = bus.poll_group("g", period=10.0, points=points)
        await cycles(group, 1)
        await points[4].write(9)
        assert unit.node.latest(points[4]) is None
        assert unit.node.latest(points[5]) is not None

    on_a_line(story, a_unit())


# against a unit that is not of this project


COUNT = 500


class CountedServer:
    """pymodbus's server, RTU frames over TCP: so many holding registers, each with a value of its own."""

    def __init__(self, registers: int) -> None:
        self.requests: list[tuple[int, int]] = []
        """First address and count of each."""
        block = ModbusSequentialDataBlock(1, [3 * n for n in range(registers)])  # type: ignore[no-untyped-call]
        context = ModbusServerContext(ModbusDeviceContext(hr=block))
        self.port = free_port()
        self._server = ModbusTcpServer(
            context, framer=FramerType.RTU, address=("127.0.0.1", self.port), trace_pdu=self._count
        )

    def _count(self, sending: bool, pdu: Any) -> Any:
        if not sending:
            self.requests.append((pdu.address, pdu.count))
        return pdu

    async def __aenter__(self) -> Self:
        await self._server.serve_forever(background=True)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._server.shutdown()  # type: ignore[no-untyped-call]


async def polled(server: CountedServer, limit: int | None = None) -> tuple[list[tuple[int, int]], list[Sample[Any]]]:
    """The requests of the second cycle of 500 registers, as the server has them, and its samples."""
    async with Bus(TcpPort("127.0.0.1", server.port, baudrate=115200)) as bus:
        unit = ModbusUnit(bus, 1, registers_per_read=limit)
        points = [unit.point(f"holding:{n}") for n in range(COUNT)]
        group = bus.poll_group("g", period=300.0, points=points)
        await cycles(group, 1)
        server.requests.clear()
        group.demand()
        (snapshot,) = await cycles(group, 1)
        return list(server.requests), [snapshot[point] for point in points]


@pytest.mark.slow
def test_500_registers_of_pymodbus_are_4_requests_in_place_of_500() -> None:
    async def story() -> None:
        async with CountedServer(COUNT) as server:
            single, one_by_one = await polled(server, limit=1)
            merged, together = await polled(server)
        # some more are sync reads (R15) of at most four registers at 0
        assert {(n, 1) for n in range(COUNT)} <= set(single)
        assert [request for request in merged if request[1] > 4] == [(0, 125), (125, 125), (250, 125), (375, 125)]
        assert {request for request in merged if request[1] <= 4} <= {(0, n) for n in range(1, 5)}
        for samples in (one_by_one, together):
            assert [sample.value for sample in samples] == [3 * place for place in range(COUNT)]

    asyncio.run(story())


@pytest.mark.slow
def test_a_register_that_pymodbus_lacks_is_refused_alone() -> None:
    """The group chooses again after replies whose bytes came faster than the baud rate: it must still merge."""

    async def story() -> None:
        async with CountedServer(COUNT - 1) as server:
            requests, samples = await polled(server)
        assert [sample.value for sample in samples[:-1]] == [3 * place for place in range(COUNT - 1)]
        assert isinstance(samples[-1].error, Refused)
        assert len([request for request in requests if request[0]]) <= 3 + 8

    asyncio.run(story())
