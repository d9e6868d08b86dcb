"""What a value is said as between programs, that it comes back as it was, and what it is written as."""

from __future__ import annotations

import asyncio
import enum
import json
from dataclasses import replace
from math import inf, nan
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster import (
    Bus,
    Hcp2Controller,
    Health,
    InvalidCommand,
    MemoryPort,
    NoReply,
    Point,
    Quality,
    RemoteBus,
    Sample,
    Service,
    Snapshot,
    connect,
)
from busmaster.app.service.client_requests import _encoded
from busmaster.app.service.messages import encode_json, value_of
from busmaster.app.service.values import (
    cycle_fields,
    event_text,
    json_line,
    json_value,
    name_fields,
    utc,
    value_text,
)
from busmaster.arbiter.transaction import Timeline
from busmaster.emulator.line import Line
from busmaster.events import (
    AlarmChanged,
    LineChange,
    LineChanged,
    MaxReplyDelayRaised,
    NodeChanged,
    PortFailed,
    RepliesLate,
)
from busmaster.ext import Named
from busmaster.protocols.hcp2.codec import Read
from busmaster.protocols.modbus.handle import ModbusUnit
from busmaster.registry import find, make_device
from tests.app.service.lines import Served, on_a_served_line, raw
from tests.patience import PATIENCE


@pytest.mark.parametrize(
    "value", [None, True, 1, 12.5, "a\n", (1, (2, 3)), inf, -inf, frozenset(), frozenset({0, 5, 31}), (frozenset({7}),)]
)
def test_a_value_comes_back_as_it_was(value: Any) -> None:
    assert value_of(json.loads(encode_json(value))) == value


def test_what_is_no_number_comes_back_too() -> None:
    assert str(value_of(json.loads(encode_json((nan,))))) == "(nan,)"


def test_what_cannot_be_said_is_refused() -> None:
    with pytest.raises(TypeError, match="a complex cannot be sent"):
        encode_json(1j)


@pytest.mark.parametrize(
    ("protocol", "item", "written", "refused"),
    [
        ("hcp2", "10", [1, 0], [True, False]),
        ("microflex", "command_word", [1], [True]),
        ("modbus", "holding:5", [1], [True, [True]]),
        ("modbus", "holding:5:2", [[1, 0]], [[True, 0], [1, False], [[True], 0]]),
        ("modbus", "coil:5", [True, 1, False, 0], [2, 0.5, "true"]),
        ("modbus", "coil:5:2", [[True, False], [1, 0]], [[True, 2], True]),
        ("msc", "flag:5", [True, 1, False, 0], [2, -1]),
        ("mentor", "1.21", [True, 1, False], []),  # one digit, where a number has five characters: for a bit
        ("ct-ansi", "1.21", [True, 1, False], []),
    ],
)
def test_true_is_written_where_the_line_has_a_form_for_it_and_is_no_number(
    protocol: str, item: str, written: list[Any], refused: list[Any], tmp_path: Path
) -> None:
    async def run() -> None:
        kind = find(protocol)
        port = MemoryPort(Line(kind.profile.line, [make_device(protocol, 14)], paced=False))
        async with (
            asyncio.timeout(PATIENCE),
            Bus(port) as bus,
            Service(bus, path=tmp_path / "line.sock") as service,
            connect(service.address) as remote,
        ):
            point = kind.handle(bus, 14).point(item)
            bus.poll_group("all", period=1.0, points=[point])
            view = await remote.overview(lambda *_: None)
            for value in written:
                await view.write("all", point.key, value)
                assert await point.read() == (tuple(value) if isinstance(value, list) else value)
            for value in refused:
                with pytest.raises(InvalidCommand):
                    await view.write("all", point.key, value)

    asyncio.run(run())


def test_a_truth_that_is_refused_says_which_number_to_write_and_is_on_record(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        line.bus.poll_group("axes", period=1.0, points=[Hcp2Controller(line.bus, 5).point("10")])
        view = await remote.overview(lambda *_: None)
        for value, said in ((True, "True is not a number: write 1"), (False, "False is not a number: write 0")):
            with pytest.raises(InvalidCommand, match=said):
                await view.write("axes", "5/10", value)
        assert line.audit() == [("5/10", "refused")] * 2
        async with raw(line) as client:  # a raw command: `[true]` was written as 1
            await client.ask("node", protocol="hcp2", address=5)
            command = {"command": "write", "element": 10, "values": [True]}
            answer = await client.ask("request", protocol="hcp2", address=5, command=command)
            assert "True is not a number: write 1" in answer["error"]["message"]
        assert await Hcp2Controller(remote, 5).read(10) == 0

    on_a_served_line(tmp_path, story)


class Mode(enum.Enum):
    """As an action of a handle returns it."""

    SLOW = 1.0
    FAST = 2.5


class Word(enum.IntFlag):
    READY = 1
    FAULT = 4


@pytest.mark.parametrize(
    ("value", "precision", "text"),
    [
        (12.345, 2, "12.35"),
        (-0.004, 2, "0.00"),
        (-0.4, 0, "0"),
        (-0.006, 2, "-0.01"),
        (5, 1, "5.0"),
        ((1.26, -2.0), 1, "1.3,-2.0"),
        (Mode.SLOW, None, "1 SLOW"),
        (Mode.FAST, 0, "2.5 FAST"),
        (Named(3, "on"), 2, "3 on"),
        (Word(5), None, "5 READY|FAULT"),
        (Word(3), None, "3 READY|0x2"),
        (inf, None, "inf"),
        (nan, 1, "nan"),
        ("a text", 2, "a text"),
        (frozenset({16, 8, 1}), None, "1,8,16"),
    ],
)
def test_a_value_is_shown_with_its_digits_and_names(value: Any, precision: int | None, text: str) -> None:
    assert value_text(value, precision) == text


@pytest.mark.parametrize(
    ("value", "written", "names"),
    [
        (Mode.SLOW, 1, {"label": "SLOW"}),
        (Mode.FAST, 2.5, {"label": "FAST"}),
        (Named(3, "on"), 3, {"label": "on"}),
        (Word(3), 3, {"names": ["READY", "0x2"]}),
        (True, 1, {}),
        ((True, Mode.SLOW, nan), [1, 1, None], {}),
        (-inf, None, {}),
        (2.0**53 - 1, 2**53 - 1, {}),
        (2.0**53, 2.0**53, {}),
        ("a text", "a text", {}),
        (frozenset({16, 8, 1}), [1, 8, 16], {}),
    ],
)
def test_a_value_in_json_is_a_number_and_its_name_is_beside_it(value: Any, written: Any, names: dict[str, Any]) -> None:
    said = json_value(value)
    assert (said, type(said)) == (written, type(written))
    assert name_fields(value) == names


def test_a_line_of_json_has_letters_as_they_are_and_other_objects_as_text() -> None:
    assert json_line(name="Wickler №", path=Path("a")) == '{"name": "Wickler №", "path": "a"}'


def test_a_time_is_written_in_utc_with_as_many_digits_as_are_wanted() -> None:
    assert utc(1_700_000_000.1239) == "2023-11-14T22:13:20.123Z"
    assert utc(1_700_000_000.1239, "seconds") == "2023-11-14T22:13:20Z"


TIMES = Timeline(10.0, 10.1, None, None, 1, 0, 0.0)


def test_a_cycle_in_json_has_its_times_and_every_sample_with_its_error() -> None:
    controller: Any = type("Controller", (), {"address": 5})()
    points: list[Point[Any]] = [Point(controller, item, Read(1)) for item in ("1", "2", "3")]
    good, late, bad = points
    error = NoReply("no reply within 100 ms", hint="check the wiring", command="read element 3", attempts=2)
    samples: dict[Point[Any], Sample[Any]] = {
        good: Sample(2.0, None, 10.0, 10.1, 10.2, Quality.GOOD, TIMES, 0.0),
        late: Sample(Named(1, "on"), None, 10.0, 10.1, 10.2, Quality.LATE, TIMES, 0.0),
        bad: Sample(None, error, 10.0, None, 10.2, Quality.BAD, TIMES, 0.0),
    }
    snapshot = Snapshot("axes", 7, 10.0, 10.1000001, 10.25, 3, 0.0, samples)
    fields = cycle_fields(snapshot, lambda moment: moment + 100)
    assert fields.pop("samples") == {
        "5/1": {"quality": "good", "value": 2, "error": None, "late": False},
        "5/2": {"quality": "late", "value": 1, "error": None, "late": True, "label": "on"},
        "5/3": {
            "quality": "bad",
            "value": None,
            "error": "no reply within 100 ms",
            "late": False,
            "hint": "check the wiring",
        },
    }
    assert fields == {"group": "axes", "cycle": 7, "due": 110, "started": 110.1, "finished": 110.25, "missed": 3}
    assert cycle_fields(replace(snapshot, started=None), float)["started"] is None


NODE: Any = SimpleNamespace(label="node 5", address=5)
ALARM = AlarmChanged(Point(NODE, "pull", Read(1)), "high", 5.0, 6.0, active=True)


@pytest.mark.parametrize(
    ("event", "text"),
    [
        (NodeChanged(NODE, Health.UP, Health.DOWN, returning=False), "node 5 is down, was up"),
        (NodeChanged(NODE, Health.DOWN, Health.UP, returning=True), "node 5 is up, was down"),
        (NodeChanged(NODE, Health.UNKNOWN, Health.DOWN, returning=False), "node 5 is down, was unknown"),
        (NodeChanged(NODE, Health.UNKNOWN, Health.UP, returning=False), ""),
        (
            MaxReplyDelayRaised(NODE, 1.1404, 1.2236),
            "node 5 replied after 1140 ms; maximum reply delay raised to 1224 ms",
        ),
        (
            RepliesLate(NODE, 0.1404, 0.0125),
            "node 5 replies after 140 ms, later than its reply window of 12.5 ms; its values are marked late",
        ),
        (LineChanged(LineChange.NOISY), "the line is noisy"),
        (LineChanged(LineChange.DOWN, "the adapter is gone"), "the line is down: the adapter is gone"),
        (ALARM, ALARM.text),
        (PortFailed("in use"), "cannot connect: in use"),
        (PortFailed("in use", "end gpsd"), "cannot connect: in use; end gpsd"),
    ],
)
def test_an_event_is_a_sentence(event: Any, text: str) -> None:
    assert event_text(event) == text


def test_a_whole_number_may_be_sent_with_a_decimal_point_and_a_read_only_point_is_not_written() -> None:
    unit = ModbusUnit(Bus(MemoryPort(Line(ModbusUnit.profile.line))), 5)
    holding = unit.point("holding:5")
    assert str(_encoded(holding, 7.0)) == str(_encoded(holding, 7))
    with pytest.raises(InvalidCommand) as own:
        holding.encode(7.5)  # type: ignore[misc]  # it can be written
    with pytest.raises(InvalidCommand) as caught:
        _encoded(holding, 7.5)
    assert str(caught.value) == str(own.value)
    with pytest.raises(InvalidCommand, match="input:5 is read-only"):
        _encoded(unit.point("input:5"), 7)
