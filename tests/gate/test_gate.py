"""The gate: what it refuses, and what it keeps of every write."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace

import pytest

from busmaster.bus.bus import Bus
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import (
    BacklogFull,
    BusError,
    GarbledReply,
    InvalidCommand,
    LineDown,
    NodeDown,
    NoReply,
    NotStarted,
    Refused,
    Superseded,
    VerifyFailed,
    WriteUnconfirmed,
)
from busmaster.gate.gate import MOST_AT_ONCE, Gate, Wish, outcome_of
from busmaster.gate.record import Outcome, WriteRecord
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.modbus.handle import ModbusUnit
from busmaster.registry import make_device
from busmaster.testing.virtual_time import run_in_virtual_time

Story = Callable[[Gate, Hcp2Controller, list[WriteRecord]], Awaitable[None]]


def at_a_gate(story: Story) -> None:
    async def run() -> None:
        async with Bus(MemoryPort(Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)]))) as bus:
            gate, records = Gate(bus), list[WriteRecord]()
            gate.record = records.append
            await story(gate, Hcp2Controller(bus, 5), records)

    run_in_virtual_time(run())


def wish(controller: Hcp2Controller, element: int, door: str = "mqtt") -> Wish:
    return Wish(door=door, by="a test", name=f"5/{element}", point=controller.point(str(element)), value=1)


def test_one_door_cannot_fill_the_line_and_another_is_not_held_up_by_it() -> None:
    async def story(gate: Gate, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        writes = [gate.write(wish(controller, element)) for element in range(1, MOST_AT_ONCE + 4)]
        *ended, other = await asyncio.gather(*writes, gate.write(wish(controller, 30, door="screen")))
        refused = [record for record in ended if not record.ok]
        assert [record.point for record in refused] == ["5/17", "5/18", "5/19"]
        assert {record.error for record in refused} == {f"{MOST_AT_ONCE} commands are being written already"}
        assert other.ok
        assert (await gate.write(wish(controller, 1))).ok  # they are over
        assert len(records) == MOST_AT_ONCE + 5

    at_a_gate(story)


def test_a_write_whose_writer_is_cancelled_is_on_record_as_unconfirmed() -> None:
    async def story(gate: Gate, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        writing = asyncio.ensure_future(gate.write(wish(controller, 1)))
        await asyncio.sleep(0)
        writing.cancel()
        with pytest.raises(asyncio.CancelledError):
            await writing
        [record] = records
        assert (record.outcome, record.error) == (Outcome.UNCONFIRMED, "the program gave up before it was done")

    at_a_gate(story)


def test_what_this_process_wishes_itself_is_on_record_and_raises_on() -> None:
    async def story(gate: Gate, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        with gate.begin(wish(controller, 1, door="safe")):
            await controller.write(1, 1)
        with pytest.raises(InvalidCommand), gate.begin(wish(controller, 2)):
            await controller.write(2, float("nan"))
        assert [(record.point, record.outcome) for record in records] == [
            ("5/1", Outcome.WRITTEN),
            ("5/2", Outcome.REFUSED),
        ]

    at_a_gate(story)


def test_what_is_refused_unread_is_on_record_as_it_came_with_the_value_before_it() -> None:
    async def story(gate: Gate, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        point = controller.point("1")
        await point.write(5)
        await anext(aiter(gate.bus.poll_group("all", period=1, points=[point])))
        for sent in (b"true", "ä".encode(), b"\x1b[2J", b"\xff"):
            gate.refuse(replace(wish(controller, 1), value=sent), "it is no number")
        assert [record.value for record in records] == ["true", "ä", r"\x1b[2J", "\ufffd"]
        assert {record.before for record in records} == {5}

    at_a_gate(story)


def test_of_nonsense_its_beginning_is_kept_and_how_long_it_was() -> None:
    async def story(gate: Gate, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        for sent in ("x" * 60_000, (1,) * 8_000, 10**299, b"x" * 4_096):
            gate.refuse(replace(wish(controller, 1), value=sent, by="b" * 300, name="n" * 300), "e" * 60_000)
        for record, length in zip(records, (60_002, 24_000, 300, 4_096), strict=True):
            assert record.value[200:] == f"... ({length} characters)"
            assert record.error == f"{'e' * 200}... (60000 characters)"
            assert (record.by, record.point) == (f"{'b' * 200}... (300 characters)", f"{'n' * 200}... (300 characters)")
            assert len(record.text) < 1_200
        gate.refuse(replace(wish(controller, 1), value=10**99), "too large")
        assert records[-1].value == 10**99

    at_a_gate(story)


@pytest.mark.parametrize(
    ("polled", "written", "before"),
    [
        (["holding:10"], "holding:10", 11),
        (["holding:10"], "holding:10:int16", 11),  # another name of the same quantity
        (["holding:10:3"], "holding:12", 13),  # one of a block
        (["holding:10", "holding:11"], "holding:10:2", (11, 12)),  # a block of what is polled one by one
        (["holding:10", "holding:12"], "holding:10:3", None),  # a part of it is not known
        (["input:10"], "holding:10", None),
    ],
)
def test_the_value_before_is_known_by_whatever_name_it_was_polled(
    polled: list[str], written: str, before: object
) -> None:
    async def run() -> None:
        async with Bus(MemoryPort(Line(ModbusUnit.profile.line, [make_device("modbus", 5)]))) as bus:
            gate, records, unit = Gate(bus), list[WriteRecord](), ModbusUnit(bus, 5)
            gate.record = records.append
            await unit.write("holding:10", 11, 12, 13)
            group = bus.poll_group("all", period=1, points=[unit.point(item) for item in polled])
            await anext(aiter(group))
            point = unit.point(written)
            value = (1,) * len(before) if isinstance(before, tuple) else (1, 2, 3) if written == "holding:10:3" else 1
            for _ in range(2):
                await gate.write(Wish(door="mqtt", by="a test", name=point.key, point=point, value=value))
            assert [(record.ok, record.before) for record in records] == [(True, before), (True, None)]
            await anext(aiter(group))
            gate.refuse(Wish(door="mqtt", by="a test", name=point.key, point=point, value=value), "a test")
            assert records[-1].before == (value if before is not None else None)

    run_in_virtual_time(run())


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (None, Outcome.WRITTEN),
        (InvalidCommand("x"), Outcome.REFUSED),
        (Refused(), Outcome.REFUSED),
        (OverflowError("x"), Outcome.REFUSED),
        (NotStarted("x"), Outcome.NOT_STARTED),
        (Superseded("x"), Outcome.NOT_STARTED),
        (NodeDown("x"), Outcome.NOT_STARTED),
        (BacklogFull("x"), Outcome.NOT_STARTED),
        (LineDown("x"), Outcome.NOT_STARTED),
        (LineDown("x", attempts=1), Outcome.UNCONFIRMED),
        (NoReply("x", attempts=2), Outcome.UNCONFIRMED),
        (GarbledReply("x", attempts=1), Outcome.UNCONFIRMED),
        (WriteUnconfirmed("x"), Outcome.UNCONFIRMED),
        (VerifyFailed("x"), Outcome.UNCONFIRMED),
        (KeyboardInterrupt(), Outcome.UNCONFIRMED),
    ],
    ids=repr,
)
def test_nothing_that_may_have_been_carried_out_is_called_not_started(
    error: BaseException | None, outcome: Outcome
) -> None:
    assert outcome_of(error)[0] is outcome
    if isinstance(error, BusError | InvalidCommand):
        assert "x" in outcome_of(error)[1] or isinstance(error, Refused)
