"""What outputs are given between two cycles: what a write has made stale, and what is read after it."""

from __future__ import annotations

import asyncio
import csv
import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import aiomqtt
import pytest

from busmaster import MemoryPort
from busmaster.app.config import emulated_line
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from tests.app.outputs.brokers import needs_mosquitto, running
from tests.patience import PATIENCE

TEXT = """
port = "/dev/ttyUSB0"
[nodes.winder]
protocol = "hcp2"
address = 1
points.force = { item = "10", unit = "N", read_after_write = true }
points.plain = { item = "11", deadband = 5 }
[groups.slow]
period = 1000
points = ["winder/force", "winder/plain", "winder/20"]
"""
FILES = """
[outputs.csv]
path = "FOLDER/x.csv"
[outputs.jsonl]
path = "FOLDER/x.jsonl"
[outputs.sqlite]
path = "FOLDER/x.sqlite"
"""
ROWS = [
    ("winder/force", 0, "good"),
    ("winder/plain", 0, "good"),
    ("winder/20", 0, "good"),
    ("winder/force", 0, "stale"),
    ("winder/force", 7, "good"),
    ("winder/plain", 0, "stale"),
    ("winder/force", 7, "good"),
    ("winder/plain", 1, "good"),  # within its deadband, but its reader knows it as stale
    ("winder/20", 0, "good"),
]


def opened(folder: Path, outputs: str) -> ConfiguredLine:
    file = read(Source("line.toml", TEXT + outputs.replace("FOLDER", str(folder))))
    return ConfiguredLine(file, port=MemoryPort(emulated_line(file)))


async def until(fact: Any) -> None:
    async with asyncio.timeout(PATIENCE):
        while not fact():  # noqa: ASYNC110  nobody tells it
            await asyncio.sleep(0.002)


def good(quality: str) -> str:
    """A late value is as good here: the machine may stand still."""
    return "good" if quality == "late" else quality


async def write_both(line: ConfiguredLine) -> None:
    """Write a point that is read after a write, then one that is not, twice; then poll once more."""
    group = line.groups["slow"]
    await until(lambda: group.latest is not None)
    await line.point("winder/force").write(7)
    await until(lambda: line.bus._reads_after_writes.read == 1)
    await line.point("winder/plain").write(1)
    await line.point("winder/plain").write(1)
    cycles = group.statistics().cycles
    group.demand()
    await until(lambda: group.statistics().cycles > cycles)


@pytest.mark.asyncio
async def test_files_and_database_have_a_row_for_what_became_stale_and_one_for_what_was_read_after_the_write(
    tmp_path: Path,
) -> None:
    async with opened(tmp_path, FILES) as line:
        await write_both(line)
    with (tmp_path / "x.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(f"{row['node']}/{row['item']}", float(row["value"]), good(row["quality"])) for row in rows] == ROWS
    assert [row["time"] for row in rows] == sorted(row["time"] for row in rows)
    objects = [json.loads(text) for text in (tmp_path / "x.jsonl").read_text().splitlines()]
    samples = [item for cycle in objects if "samples" in cycle for item in cycle["samples"].items()]
    assert [(key, sample["value"], good(sample["quality"])) for key, sample in samples] == ROWS
    with closing(sqlite3.connect(tmp_path / "x.sqlite")) as database:
        found = database.execute("select node || '/' || item, value, quality from history").fetchall()
    assert sorted((name, value, good(quality)) for name, value, quality in found) == sorted(ROWS)


@needs_mosquitto
@pytest.mark.asyncio
async def test_mqtt_publishes_the_new_value_before_the_next_cycle(tmp_path: Path) -> None:
    with running(tmp_path) as broker:
        outputs = f'[outputs.mqtt]\nport = {broker.port}\nprefix = "line"\n'
        async with aiomqtt.Client("127.0.0.1", broker.port) as client, opened(tmp_path, outputs) as line:
            await client.subscribe("line/values/winder/force")
            seen: list[tuple[object, str]] = []
            async with asyncio.timeout(PATIENCE):
                async for message in client.messages:
                    said = json.loads(bytes(message.payload))
                    seen.append((said["value"], good(said["quality"])))
                    if len(seen) == 1:
                        await line.point("winder/force").write(7)
                    if seen[-1] == (7, "good"):
                        break
            assert seen[0] == (0, "good")
            assert set(seen[1:-1]) <= {(0, "stale")}
            assert line.groups["slow"].statistics().cycles == 1
