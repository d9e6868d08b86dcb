"""From the line to its outputs: what is polled and what happens reaches each of them."""

from __future__ import annotations

import json
import os
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import anyio
import pytest

from busmaster import Bus, Hcp2Controller, Health, MemoryPort, Snapshot
from busmaster.app.config import FileError, emulated_line
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.app.outputs.distributor import Wanted, label_of
from busmaster.app.outputs.exceptions import News
from busmaster.app.outputs.settings import MqttSettings
from busmaster.bus.node import Node
from busmaster.emulator.line import Line
from busmaster.events import (
    AlarmChanged,
    BusEvent,
    LineChange,
    LineChanged,
    MaxReplyDelayLowered,
    MaxReplyDelayRaised,
    NodeChanged,
    PortFailed,
    RepliesLate,
)

TEXT = """
port = "/dev/ttyUSB0"
[nodes.winder]
protocol = "hcp2"
address = 1
[nodes.away]
protocol = "hcp2"
address = 2
[groups.fast]
period = 0.02
points = "winder/1-2"
[groups.slow]
period = 0.1
points = "winder/3"
[emulator.nodes.away]
faults = { dead = 1 }
[outputs.sqlite]
path = "FOLDER/x.db"
[outputs.jsonl]
path = "FOLDER/x.jsonl"
groups = ["slow"]
"""


def opened(folder: Path, text: str = TEXT, outputs: bool = True) -> ConfiguredLine:
    file = read(Source("line.toml", text.replace("FOLDER", str(folder))))
    return ConfiguredLine(file, port=MemoryPort(emulated_line(file)), outputs=outputs)


async def run(line: ConfiguredLine, cycles: int) -> None:
    async with line:
        async for snapshot in line.groups["fast"]:
            if snapshot.cycle >= cycles:
                break


@pytest.mark.asyncio
async def test_nothing_is_lost_between_the_line_and_an_output(tmp_path: Path) -> None:
    """What was polled before the line was closed is written when it is closed."""
    line = opened(tmp_path)
    await run(line, 20)
    check_written(line, tmp_path)


@pytest.mark.asyncio
async def test_nothing_is_lost_if_the_program_is_cancelled_and_stays_so(tmp_path: Path) -> None:
    """As in a task group of anyio: every wait in a cancelled scope is cancelled, also one while the line is closed."""
    line = opened(tmp_path)
    with anyio.CancelScope() as scope:
        async with line:
            async for snapshot in line.groups["fast"]:
                if snapshot.cycle >= 20:
                    scope.cancel()
    check_written(line, tmp_path)


def check_written(line: ConfiguredLine, folder: Path) -> None:
    counts = {output.kind: output for output in line.outputs.statistics()}
    assert counts["sqlite"].dropped == counts["sqlite"].waiting == 0
    polled = 2 * line.groups["fast"].statistics().cycles + line.groups["slow"].statistics().cycles
    with closing(sqlite3.connect(folder / "x.db")) as database:
        [samples] = database.execute("select count(*) from samples").fetchone()
        [events] = database.execute("select count(*) from events").fetchone()
    assert samples == polled
    assert samples + events == counts["sqlite"].written


@pytest.mark.asyncio
async def test_an_output_gets_the_groups_that_it_asked_for_and_all_events(tmp_path: Path) -> None:
    line = opened(tmp_path)
    async with line:
        await Node.of(line.nodes["away"]).probe()
        async for _ in line.groups["slow"]:
            break
    objects = [json.loads(text) for text in (tmp_path / "x.jsonl").read_text().splitlines()]
    assert {found["group"] for found in objects if "group" in found} == {"slow"}
    assert "away is down, was unknown" in [found.get("event") for found in objects]


@pytest.mark.asyncio
async def test_without_outputs_nothing_is_written(tmp_path: Path) -> None:
    await run(opened(tmp_path, outputs=False), 1)
    assert os.listdir(tmp_path) == []


def test_an_extra_that_is_not_there_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for output, extra in (("mqtt", "mqtt"), ("metrics", "metrics")):
        with pytest.raises(FileError, match=rf"outputs\.{output}: .* pip install 'busmaster\[{extra}\]'"):
            opened(tmp_path, f"{TEXT}[outputs.{output}]\n")


@pytest.mark.asyncio
async def test_a_bug_that_ends_the_feed_of_the_outputs_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: object, snapshot: Snapshot) -> Snapshot:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(News, "of", broken)
    reported: list[str] = []
    line = opened(tmp_path)
    line.outputs.report = reported.append
    await run(line, 3)
    assert "outputs get no more values of fast: ZeroDivisionError: a bug; report this bug, and restart" in "".join(
        reported
    )


@pytest.mark.asyncio
async def test_an_event_of_a_node_has_its_label_and_one_of_the_line_has_none(tmp_path: Path) -> None:
    line = opened(tmp_path, outputs=False)
    async with line:
        node, point = line.bus.nodes[0]._record, line.groups["fast"].points[0]
        events: list[BusEvent] = [
            NodeChanged(node, Health.UP, Health.DOWN, returning=False),
            MaxReplyDelayRaised(node, age=0.2, max_reply_delay=0.25),
            MaxReplyDelayLowered(node, max_reply_delay=0.15),
            RepliesLate(node, age=0.12, window=0.1),
            AlarmChanged(point, limit="high", bound=5.0, value=6.0, active=True),
        ]
        assert [label_of(event) for event in events] == ["winder"] * len(events)
        assert label_of(LineChanged(LineChange.UP)) == label_of(PortFailed("unplugged")) == ""


def test_an_output_is_another_one_if_its_settings_or_what_it_lets_others_write_differ() -> None:
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    point, settings = Hcp2Controller(bus, 5).point("1"), MqttSettings()
    wanted = Wanted(settings, {"5/1": point})
    assert wanted.same(Wanted(MqttSettings(), {"5/1": point}))
    assert not wanted.same(None)
    assert not wanted.same(Wanted(MqttSettings(port=1884), {"5/1": point}))
    assert not wanted.same(Wanted(settings, {}))
    assert not wanted.same(Wanted(settings, {"5/1": point, "5/2": point}))
    assert not Wanted(settings, {}).same(wanted)
    assert not wanted.same(Wanted(settings, {"5/1": replace(point)})), "an equal point may have another scale"
