"""Authorisation: what it refuses, and what it keeps of every write."""

from __future__ import annotations

import asyncio
import getpass
import logging
import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import replace

import pytest

from busmaster.app.bounds import MOST_AT_ONCE
from busmaster.app.service.authorisation import Authorisation, WriteRequest, outcome_of
from busmaster.app.service.permission import Access
from busmaster.app.service.record import LONGEST_SHOWN, Outcome, WriteRecord, cut, this_user
from busmaster.app.service.values import write_fields
from busmaster.bus.bus import Bus
from busmaster.contract.timing import ReplyTiming, Timings
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
from busmaster.ext import Command
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.modbus.handle import ModbusUnit
from busmaster.registry import make_device
from busmaster.testing.virtual_time import run_in_virtual_time

FRESH = 1.0
"""Seconds: a command that has waited for longer is not sent (docs/service.md)."""
Story = Callable[[Authorisation, Hcp2Controller, list[WriteRecord]], Awaitable[None]]


def at_the_authorisation(story: Story) -> None:
    async def run() -> None:
        async with Bus(MemoryPort(Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)]))) as bus:
            authorisation, records = Authorisation(bus), list[WriteRecord]()
            authorisation.record = records.append
            await story(authorisation, Hcp2Controller(bus, 5), records)

    run_in_virtual_time(run())


def request(controller: Hcp2Controller, element: int, interface: str = "mqtt") -> WriteRequest:
    return WriteRequest(
        interface=interface, by="a test", name=f"5/{element}", point=controller.point(str(element)), value=1
    )


def test_one_interface_cannot_fill_the_line_and_another_is_not_held_up_by_it() -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        writes = [authorisation.write(request(controller, element)) for element in range(1, MOST_AT_ONCE + 4)]
        *ended, other = await asyncio.gather(*writes, authorisation.write(request(controller, 30, interface="screen")))
        refused = [record for record in ended if not record.ok]
        assert [record.point for record in refused] == ["5/17", "5/18", "5/19"]
        assert {record.error for record in refused} == {
            f"{MOST_AT_ONCE} commands are already being written; wait for them"
        }
        assert other.ok
        assert (await authorisation.write(request(controller, 1))).ok  # they are over
        assert len(records) == MOST_AT_ONCE + 5

    at_the_authorisation(story)


def test_of_the_commands_that_are_being_written_each_that_ends_makes_room_for_one() -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, _: list[WriteRecord]) -> None:
        first, *others = [
            asyncio.ensure_future(authorisation.write(request(controller, element)))
            for element in range(1, MOST_AT_ONCE + 1)
        ]
        assert (await first).ok
        assert not any(other.done() for other in others)
        later = await asyncio.gather(*(authorisation.write(request(controller, element)) for element in (30, 31)))
        assert [record.ok for record in later] == [True, False]
        assert all(record.ok for record in await asyncio.gather(*others))

    at_the_authorisation(story)


def test_a_write_whose_writer_is_cancelled_is_on_record_as_unconfirmed() -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        writing = asyncio.ensure_future(authorisation.write(request(controller, 1)))
        await asyncio.sleep(0)
        writing.cancel()
        with pytest.raises(asyncio.CancelledError):
            await writing
        [record] = records
        assert (record.outcome, record.error) == (
            Outcome.UNCONFIRMED,
            "the program cancelled the write before it ended",
        )

    at_the_authorisation(story)


def test_what_this_process_wishes_itself_is_on_record_and_raises_on() -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        with authorisation.begin(request(controller, 1, interface="safe")):
            await controller.write(1, 1)
        with pytest.raises(InvalidCommand), authorisation.begin(request(controller, 2)):
            await controller.write(2, float("nan"))
        assert [(record.point, record.outcome) for record in records] == [
            ("5/1", Outcome.WRITTEN),
            ("5/2", Outcome.REFUSED),
        ]

    at_the_authorisation(story)


def test_what_is_refused_unread_is_on_record_as_it_came_with_the_value_before_it() -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        point = controller.point("1")
        await point.write(5)
        await anext(aiter(authorisation.bus.poll_group("all", period=1, points=[point])))
        for sent in (b"true", "ä".encode(), b"\x1b[2J", b"\xff"):
            authorisation.refuse(replace(request(controller, 1), value=sent), "it is no number")
        assert [record.value for record in records] == ["true", "ä", r"\x1b[2J", "\ufffd"]
        assert {record.before for record in records} == {5}

    at_the_authorisation(story)


def test_of_nonsense_its_beginning_is_kept_and_how_long_it_was() -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        for sent in ("x" * 60_000, (1,) * 8_000, 10**299, b"x" * 4_096):
            authorisation.refuse(
                replace(request(controller, 1), value=sent, by="b" * 300, name="n" * 300), "e" * 60_000
            )
        for record, length in zip(records, (60_002, 24_000, 300, 4_096), strict=True):
            assert record.value[200:] == f"... ({length} characters)"
            assert record.error == f"{'e' * 200}... (60000 characters)"
            assert (record.by, record.point) == (f"{'b' * 200}... (300 characters)", f"{'n' * 200}... (300 characters)")
            assert len(record.text) < 1_200
        authorisation.refuse(replace(request(controller, 1), value=10**99), "too large")
        assert records[-1].value == 10**99

    at_the_authorisation(story)


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
            authorisation, records, unit = Authorisation(bus), list[WriteRecord](), ModbusUnit(bus, 5)
            authorisation.record = records.append
            await unit.write("holding:10", 11, 12, 13)
            group = bus.poll_group("all", period=1, points=[unit.point(item) for item in polled])
            await anext(aiter(group))
            point = unit.point(written)
            value = (1,) * len(before) if isinstance(before, tuple) else (1, 2, 3) if written == "holding:10:3" else 1
            for _ in range(2):
                await authorisation.write(
                    WriteRequest(interface="mqtt", by="a test", name=point.key, point=point, value=value)
                )
            assert [(record.ok, record.before) for record in records] == [(True, before), (True, None)]
            await anext(aiter(group))
            authorisation.refuse(
                WriteRequest(interface="mqtt", by="a test", name=point.key, point=point, value=value), "a test"
            )
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


ABSENT = 9
LONG = Timings.uniform(ReplyTiming(5.0, 5.0, 5.0, 0.02))
"""Of a node that is not there: a request to it keeps the line busy for five seconds."""


@asynccontextmanager
async def busy(authorisation: Authorisation) -> AsyncIterator[None]:
    """Keep the line busy for longer than a command is fresh."""
    holding = asyncio.ensure_future(Hcp2Controller(authorisation.bus, ABSENT, timings=LONG).read(1, retries=0))
    await asyncio.sleep(0)
    yield
    with pytest.raises(NoReply):
        await holding


def test_writes_that_fail_give_their_places_back() -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        absent = Hcp2Controller(authorisation.bus, ABSENT)
        for _ in range(MOST_AT_ONCE):
            await authorisation.write(request(absent, 1))
        refused = Hcp2Controller(authorisation.bus, 5).point("1")
        refused.limit(maximum=0)
        for _ in range(MOST_AT_ONCE):
            await authorisation.write(request(controller, 1))
        assert not any(record.ok for record in records)
        assert (await authorisation.write(request(controller, 2))).ok

    at_the_authorisation(story)


def test_writes_whose_writers_are_cancelled_give_their_places_back() -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        writing = [asyncio.ensure_future(authorisation.write(request(controller, 1))) for _ in range(MOST_AT_ONCE)]
        await asyncio.sleep(0)
        for one in writing:
            one.cancel()
        await asyncio.gather(*writing, return_exceptions=True)
        assert (await authorisation.write(request(controller, 2))).ok

    at_the_authorisation(story)


def test_a_line_that_is_left_or_read_only_lets_no_write_through() -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        authorisation.leaving = True
        assert (await authorisation.write(request(controller, 1))).error == "the line is closing; nothing was sent"
        authorisation.leaving, authorisation.read_only = False, True
        assert (await authorisation.write(request(controller, 1))).error == "this line is read-only"
        authorisation.read_only = False
        assert (await authorisation.write(request(controller, 1))).ok
        outcomes = [record.outcome for record in records]
        assert outcomes == [Outcome.REFUSED, Outcome.REFUSED, Outcome.WRITTEN]

    at_the_authorisation(story)


def test_a_command_waits_for_the_line_as_long_as_it_is_fresh_and_its_age_counts() -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        async with busy(authorisation):
            began = authorisation.bus.now()
            new, old = (
                authorisation.write(replace(request(controller, 1), arrived=began - age)) for age in (0.0, FRESH / 2)
            )
            ended = asyncio.ensure_future(old)
            assert (await new).outcome is Outcome.NOT_STARTED
            assert authorisation.bus.now() - began == pytest.approx(FRESH, abs=0.001)
            assert ended.result().took == pytest.approx(FRESH / 2, abs=0.001)
            assert ended.result().outcome is Outcome.NOT_STARTED
        too_old = await authorisation.write(replace(request(controller, 1), arrived=authorisation.bus.now() - FRESH))
        assert (too_old.outcome, too_old.error) == (Outcome.REFUSED, "the command has expired; nothing was sent")
        assert (await authorisation.write(replace(request(controller, 1), arrived=authorisation.bus.now()))).ok

    at_the_authorisation(story)


def test_a_command_that_says_until_when_it_is_meant_is_held_to_that_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    today = 1_800_000_000.0
    monkeypatch.setattr(time, "time", lambda: today)

    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        old = replace(request(controller, 1), arrived=authorisation.bus.now() - 10 * FRESH)
        assert (await authorisation.write(replace(old, expires=today + FRESH))).ok
        assert (
            await authorisation.write(replace(old, expires=today))
        ).error == "the command has expired; nothing was sent"
        async with busy(authorisation):
            [record] = await asyncio.gather(authorisation.write(replace(old, expires=today + 2 * FRESH)))
            assert record.outcome is Outcome.NOT_STARTED
            assert record.took == pytest.approx(2 * FRESH, abs=0.001)

    at_the_authorisation(story)


def test_the_log_says_how_a_write_ended_and_warns_of_one_that_is_unconfirmed(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "busmaster.audit")

    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        began = authorisation.bus.now()
        await authorisation.write(replace(request(Hcp2Controller(authorisation.bus, ABSENT), 1), id="a1"))
        assert records[0].took == authorisation.bus.now() - began > 0
        await authorisation.write(request(controller, 1))
        authorisation.refuse(request(controller, 1), "no")
        audit = [record for record in caplog.records if record.name == "busmaster.audit"]
        assert [record.levelno for record in audit] == [logging.WARNING, logging.INFO, logging.INFO]
        assert f"unconfirmed in {records[0].took:.3f} s by mqtt a test [a1], " in audit[0].message

    at_the_authorisation(story)


class Kept(logging.Handler):
    """A handler of an application, which keeps the texts of the audit log."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.name == "busmaster.audit":
            self.texts.append(record.getMessage())


def test_entries_reach_the_handlers_of_an_application_and_without_any_none_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root, audit = logging.getLogger(), logging.getLogger("busmaster.audit")
    kept, own = Kept(), Kept()
    monkeypatch.setattr(root, "handlers", [])
    monkeypatch.setattr(audit, "handlers", [])
    monkeypatch.setattr(audit, "propagate", True)  # pytest leaves its own handlers at a logger that does not propagate

    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        absent = request(Hcp2Controller(authorisation.bus, ABSENT), 1)
        await authorisation.write(absent)  # unconfirmed: a warning
        root.addHandler(kept)
        await authorisation.write(absent)
        audit.addHandler(own)
        Authorisation(authorisation.bus)  # of another service in this process
        await authorisation.write(absent)
        assert [record.outcome for record in records] == [Outcome.UNCONFIRMED] * 3
        texts = [record.text for record in records]
        assert (kept.texts, own.texts) == (texts[1:], texts[2:])
        assert len(audit.handlers) == 2, "what many services leave there is bounded"

    at_the_authorisation(story)
    assert "unconfirmed" not in capsys.readouterr().err


def test_a_user_without_a_name_is_on_record_by_number(monkeypatch: pytest.MonkeyPatch) -> None:
    def nameless() -> str:
        raise KeyError("getpwuid(): uid not found: 12345")

    monkeypatch.setattr(getpass, "getuser", nameless)
    monkeypatch.setattr(os, "getuid", lambda: 12345)

    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        await authorisation.write(request(controller, 1))
        assert (records[0].user, records[0].process) == ("12345", os.getpid())

    at_the_authorisation(story)


ENTRY = WriteRecord(
    time=1_700_000_000.1234567,
    interface="mqtt",
    by="a topic",
    user="op",
    process=17,
    point="winder/speed",
    before=0.0,
    value=12.5,
    outcome=Outcome.UNCONFIRMED,
    error="no reply",
    took=0.01449,
    id="job 7",
)


@pytest.mark.parametrize(
    ("entry", "text"),
    [
        (
            ENTRY,
            "winder/speed = 12.5 (before: 0.0) unconfirmed in 0.014 s by mqtt a topic [job 7], op 17: no reply",
        ),
        (
            ENTRY._replace(before=None, value="on", outcome=Outcome.WRITTEN, error="", took=1.0, id=""),
            "winder/speed = 'on' written in 1.000 s by mqtt a topic, op 17",
        ),
    ],
)
def test_an_entry_is_one_line_of_what_is_known_of_the_write(entry: WriteRecord, text: str) -> None:
    assert entry.text == text


def test_only_a_write_that_was_confirmed_is_ok() -> None:
    assert [outcome for outcome in Outcome if ENTRY._replace(outcome=outcome).ok] == [Outcome.WRITTEN]


def test_an_entry_as_json_has_null_for_what_there_is_not() -> None:
    entry = {
        "time": 1_700_000_000.123457,
        "interface": "mqtt",
        "by": "a topic",
        "user": "op",
        "process": 17,
        "point": "winder/speed",
        "before": 0,
        "value": 12.5,
        "outcome": "unconfirmed",
        "error": "no reply",
        "took": 0.01449,
        "id": "job 7",
    }
    assert write_fields(ENTRY) == entry
    assert write_fields(ENTRY._replace(error="", id="", before=None, value=frozenset({5, 1}))) == {
        **entry,
        "error": None,
        "id": None,
        "before": None,
        "value": [1, 5],
    }


def test_a_long_text_is_cut_and_its_length_is_kept() -> None:
    assert cut("x" * LONGEST_SHOWN) == "x" * LONGEST_SHOWN
    assert cut("x" * LONGEST_SHOWN + "y") == "x" * LONGEST_SHOWN + "... (201 characters)"


@pytest.mark.parametrize("error", [KeyError("uid not found"), OSError("No username set in the environment")])
def test_a_user_without_a_name_is_a_number(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def getuser() -> str:
        raise error

    monkeypatch.setattr(getpass, "getuser", getuser)
    assert this_user() == str(os.getuid())


@pytest.mark.parametrize("error", [OverflowError("too large"), TypeError("no number"), ZeroDivisionError("no scale")])
def test_a_value_that_cannot_be_encoded_is_refused_with_the_reason_and_raises_nothing(error: Exception) -> None:
    def encode(_: object) -> Command[None]:
        raise error

    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        point = replace(controller.point("1"), encode=encode)
        record = await authorisation.write(replace(request(controller, 1), point=point, id="a1"))
        assert (record.outcome, record.error) == (Outcome.REFUSED, f"the value cannot be sent: {error}")
        assert records == [record]
        assert (record.id, record.interface, record.by, record.value) == ("a1", "mqtt", "a test", 1)
        assert (await authorisation.write(request(controller, 1))).ok

    at_the_authorisation(story)


NOT_DURABLE = "the value was written, but its audit entry is not on the disk: "


@pytest.mark.parametrize(
    ("reason", "outcome", "error"),
    [
        ("", Outcome.WRITTEN, ""),
        ("disk full", Outcome.UNCONFIRMED, "the value was written, but its audit entry is not on the disk: disk full"),
        (
            "x" * 300,
            Outcome.UNCONFIRMED,
            f"{'the value was written, but its audit entry is not on the disk: ':x<200}...",
        ),
    ],
    ids=["", "short", "long"],
)
def test_a_write_whose_entry_is_not_on_the_disk_is_unconfirmed_with_the_reason(
    reason: str, outcome: Outcome, error: str
) -> None:
    async def durable() -> str:
        return reason

    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        def record(entry: WriteRecord) -> Awaitable[str]:
            records.append(entry)
            return durable()

        authorisation.record = record
        ended = await authorisation.write(request(controller, 1))
        assert (ended.outcome, ended.error.partition(" (")[0]) == (outcome, error)
        assert [entry.outcome for entry in records] == [Outcome.WRITTEN]  # as the other outputs have it

    at_the_authorisation(story)


def test_each_function_that_waits_for_other_roles_or_tokens_is_called() -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        called: list[str] = []
        authorisation.on_access += [lambda: called.append("first"), lambda: called.append("second")]
        authorisation.take_secrets({"hmi": b"1"})
        authorisation.take_secrets({"logger": b"2"})
        assert authorisation.access.secrets == {"logger": b"2"}
        authorisation.access = Access(secrets={"hmi": b"3"})
        assert called == ["first", "second"] * 3

    at_the_authorisation(story)


def test_a_command_that_expired_before_1970_has_expired() -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        for expires, arrived in ((0.0, None), (-1.0, authorisation.bus.now())):
            record = await authorisation.write(replace(request(controller, 1), expires=expires, arrived=arrived))
            assert record.error == "the command has expired; nothing was sent"

    at_the_authorisation(story)


@pytest.mark.parametrize(("value", "shown"), [(-1e99, -1e99), (-1e101, "-1e+101"), (1e100, "1e+100"), ("on", "'on'")])
def test_a_number_that_is_too_large_is_on_record_as_text(value: object, shown: object) -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        assert authorisation.refuse(replace(request(controller, 1), value=value), "no").value == shown

    at_the_authorisation(story)


def test_an_entry_has_the_time_of_the_line_and_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(authorisation: Authorisation, controller: Hcp2Controller, records: list[WriteRecord]) -> None:
        monkeypatch.setattr(authorisation.bus, "wall_time", lambda: 1_800_000_000.5)
        record = await authorisation.write(request(controller, 1))
        assert (record.time, record.user) == (1_800_000_000.5, this_user())

    at_the_authorisation(story)
