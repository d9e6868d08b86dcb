"""What points mean, as each output tells it: names beside numbers, bits as values of their own, alarms that stand."""

from __future__ import annotations

import asyncio
import json
import sqlite3
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from busmaster.app.outputs.base import Output
from busmaster.app.outputs.files import CsvOutput, JsonlOutput
from busmaster.app.outputs.metrics import MetricsOutput
from busmaster.app.outputs.settings import FileSettings, MetricsSettings, SqliteSettings
from busmaster.app.outputs.sqlite import SqliteOutput
from busmaster.app.service.values import value_text
from busmaster.bus.bus import Bus
from busmaster.bus.meaning import Meaning, Named
from busmaster.bus.points import Point
from busmaster.bus.polling import PollGroup, Snapshot
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.registry import make_device
from tests.app.outputs.brokers import Broker, needs_mosquitto, running
from tests.app.outputs.cycles import cycle, until
from tests.app.outputs.test_metrics import of, scraped
from tests.app.outputs.test_mqtt import heard, listening, publishing

needs_prometheus = pytest.mark.skipif(
    find_spec("prometheus_client") is None, reason="needs prometheus-client (the extra named metrics)"
)
MODES = Meaning(labels={0: "off", 1: "on"})


@pytest.mark.parametrize(
    ("value", "precision", "text"),
    [
        (1.25, None, "1.25"),
        (1.26, 1, "1.3"),
        (5, 2, "5.00"),
        (-0.04, 1, "0.0"),
        (-0.0, 0, "0"),
        (-0.6, 0, "-1"),
        (1e20, 1, "100000000000000000000.0"),
        ((1.25, -2.0), 1, "1.2,-2.0"),
        (float("nan"), 1, "nan"),
        (Named(1, "on"), 2, "1 on"),
        (None, 2, "-"),
        ("text", 2, "text"),
        (frozenset({5, 0}), 2, "0,5"),
    ],
)
def test_people_are_shown_as_many_digits_as_they_asked_for(value: Any, precision: int | None, text: str) -> None:
    assert value_text(value, precision) == text


def modes(number: int, value: int, meaning: Meaning = MODES) -> Snapshot:
    """Return a cycle of one point with labels."""
    found = cycle(number, value)
    samples = {
        replace(point, meaning=meaning): sample._replace(value=meaning.named(sample.value))
        for point, sample in found.samples.items()
    }
    return replace(found, samples=samples)


def written(output: Output, *snapshots: Snapshot) -> None:
    output.start()
    for snapshot in snapshots:
        output.offer(snapshot)
    output.close(10)


def test_files_have_the_number_and_what_it_is_called(tmp_path: Path) -> None:
    for kind in (CsvOutput, JsonlOutput):
        written(kind("file", FileSettings(path=str(tmp_path / kind.__name__))), modes(1, 1), modes(2, 7))
    rows = [line.split(",") for line in (tmp_path / "CsvOutput").read_text().splitlines()]
    assert [row[5] for row in rows] == ["value", "1 on", "7"]
    samples = [json.loads(line)["samples"]["5/1"] for line in (tmp_path / "JsonlOutput").read_text().splitlines()]
    assert samples == [
        {"value": 1, "quality": "good", "error": None, "late": False, "label": "on"},
        {"value": 7, "quality": "good", "error": None, "late": False},
    ]


def rows(path: Path) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(path)) as database:
        return database.execute("select value, typeof(value), label from history order by time").fetchall()


def test_a_database_holds_numbers_and_what_each_was_called_last(tmp_path: Path) -> None:
    path = tmp_path / "x.sqlite"
    written(SqliteOutput("sqlite", SqliteSettings(path=str(path))), modes(1, 1), modes(2, 7))
    assert rows(path) == [(1, "integer", "on"), (7, "integer", None)]
    renamed = Meaning(labels={7: "seven"})
    written(SqliteOutput("sqlite", SqliteSettings(path=str(path))), modes(3, 7, renamed))
    assert rows(path) == [(1, "integer", "on"), (7, "integer", "seven"), (7, "integer", "seven")]


def test_a_database_of_a_version_before_labels_goes_on_and_gets_them(tmp_path: Path) -> None:
    path = tmp_path / "x.sqlite"
    written(SqliteOutput("sqlite", SqliteSettings(path=str(path))), modes(1, 1))
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("drop view history")
        database.execute("drop table labels")
        database.execute("create view history as select time, value from samples")
    written(SqliteOutput("sqlite", SqliteSettings(path=str(path))), modes(2, 1))
    assert rows(path) == [(1, "integer", "on"), (1, "integer", "on")]


@needs_mosquitto
@pytest.mark.parametrize(("options", "value", "alarm"), [("alarm_if_set", 8, "set"), ("alarm_if_clear", 0, "clear")])
@pytest.mark.asyncio
async def test_mqtt_has_the_alarm_of_a_bit_as_set_or_clear(
    tmp_path: Path, options: str, value: int, alarm: str
) -> None:
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)])))
    drive = Hcp2Controller(bus, 5)
    meaning: dict[str, Any] = {"bits": {"FAULT": 3}, options: ("FAULT",)}
    word = replace(drive.point("11"), meaning=Meaning(**meaning))
    with running(tmp_path) as broker:
        async with bus, publishing(broker, bus), listening(broker, "line/alarms/#") as client:
            await drive.write(11, value)
            bus.poll_group("axes", period=0.02, points=list(word.bits))
            assert await told(client) == [("line/alarms/5/11.FAULT", alarm)]


@needs_mosquitto
@pytest.mark.asyncio
async def test_mqtt_has_bits_labels_and_alarms_under_their_names(tmp_path: Path) -> None:
    device = make_device("hcp2", 5)
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line, [device])))
    drive = Hcp2Controller(bus, 5)
    word = replace(drive.point("11"), meaning=Meaning(bits={"READY": 0, "FAULT": 3}))
    speed = replace(drive.point("10"), meaning=Meaning(high=5, hysteresis=1))
    with running(tmp_path) as broker:
        async with bus, publishing(broker, bus) as output, listening(broker, "line/alarms/#") as client:
            await drive.write(11, 9)
            await drive.write(10, 6)
            group = bus.poll_group("axes", period=0.02, points=[word, *word.bits, speed])
            assert [message[:2] for message in await told(client)] == [("line/alarms/5/10", "high")]
            await drive.write(10, 4.5)
            await polled(group, speed, 4.5)  # back, but not by the hysteresis
            assert bus.alarms[speed] is not None
            await drive.write(10, 4)
            assert [message[:2] for message in await told(client)] == [("line/alarms/5/10", None)]
            output.offer(await polled(group, speed, 4))
            async with listening(broker, "line/values/#") as values:
                found: dict[str, Any] = {}
                while found.get("line/values/5/10", {}).get("value") != 4:  # before it, stale ones are retained
                    found |= {topic: payload for topic, payload, _ in await heard(values, 1)}
        assert {topic: (payload["value"], payload.get("label")) for topic, payload in found.items()} == {
            "line/values/5/11": (9, "READY|FAULT"),
            "line/values/5/11.READY": (1, None),
            "line/values/5/11.FAULT": (1, None),
            "line/values/5/10": (4, None),
        }
        await standing(broker)


async def polled(group: PollGroup, point: Point[Any], value: float) -> Snapshot:
    """Return the next cycle that has this value of the point, and no error."""
    async for snapshot in group:
        if snapshot[point].value == value and all(sample.error is None for sample in snapshot.values()):
            return snapshot
    raise AssertionError("the group was closed")


async def told(client: Any) -> list[tuple[str, str | None]]:
    """Return the next alarm that is published, and its name."""
    return [(topic, payload["alarm"]) for topic, payload, _ in await heard(client, 1)]


async def standing(broker: Broker) -> None:
    """Check that whoever comes later hears how it stands: the last word on each point is retained."""
    async with listening(broker, "line/alarms/#") as late:
        assert [(topic, payload["alarm"], kept) for topic, payload, kept in await heard(late, 1)] == [
            ("line/alarms/5/10", None, True)
        ]


@needs_prometheus
@pytest.mark.asyncio
async def test_metrics_have_an_alarm_as_long_as_it_lasts() -> None:
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)])))
    output = MetricsOutput("metrics", MetricsSettings(port=0), bus)
    async with bus:
        output.start()
        await asyncio.to_thread(until, lambda: output.port != 0)
        drive = Hcp2Controller(bus, 5)
        await drive.write(10, 6)
        for limits, level in ((Meaning(high=5), 1), (Meaning(low=7), -1), (Meaning(low=5, high=7), 0)):
            speed = replace(drive.point("10"), meaning=limits)
            group = bus.poll_group("axes", period=0.02, points=[speed])
            await polled(group, speed, 6)
            metrics = await asyncio.to_thread(scraped, output.port)
            group.close()
            assert of(metrics, "alarm", node="5", item="10") == level
        await asyncio.to_thread(output.close, 5)
