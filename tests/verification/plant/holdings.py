"""What each output holds, read as anybody would read it: the file, the database, what the broker sent."""

from __future__ import annotations

import csv
import io
import json
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.printed import Line
from tests.verification.plant.brokers import Heard

Value = tuple[str, Any]
"""A point's key, and what it held: of telling drives each comes but once."""
Write = tuple[str, str]
"""The id of a command, and what became of it."""


@dataclass
class Holding:
    """The good values, how many samples tell an error, the events, and the audit log.

    `twice` counts the samples that were there already.
    """

    values: list[Value] = field(default_factory=list)
    errors: int = 0
    twice: int = 0
    events: list[str] = field(default_factory=list)
    writes: list[Write] = field(default_factory=list)
    samples: dict[tuple[str, Any], Any] = field(default_factory=dict)
    """What each held, by key and by what tells it from the others of its point: its time, say."""

    def add(self, key: str, mark: Any, value: Any, error: object, quality: str = "") -> None:
        """Take a sample. A stale row that only says again what a write has made old is none."""
        if quality == "stale" and (key, value) in self.values:
            return
        if (key, mark) in self.samples:
            self.twice += 1
            return
        self.samples[(key, mark)] = value
        if error:
            self.errors += 1
        else:
            self.values.append((key, value))


def of_csv(texts: Iterable[str]) -> Holding:
    held = Holding()
    for text in texts:
        for row in csv.DictReader(io.StringIO(text)):
            if row["error"] is not None:  # else a half line of a crash
                name = f"{row['node']}/{row['item']}"
                held.add(name, row["time"], number(row["value"]), row["error"], row["quality"])
    return held


def of_jsonl(texts: Iterable[str]) -> Holding:
    held = Holding()
    for fields in (fields for text in texts for fields in json_lines(text.splitlines())):
        if "write" in fields:
            held.writes.append((str(fields["id"]), fields["outcome"]))
        elif "event" in fields:
            held.events.append(fields["event"])
        else:
            for key, sample in fields["samples"].items():
                held.add(key, fields["due"], sample["value"], sample["error"], sample["quality"])
    return held


def of_sqlite(paths: Iterable[Path]) -> Holding:
    held = Holding()
    for path in paths:
        with closing(sqlite3.connect(path, timeout=30.0)) as database:
            for node, item, moment, value, error, quality in database.execute(
                "select node, item, time, value, error, quality from samples join points on points.id = samples.point"
                " order by samples.rowid"
            ):
                held.add(f"{node}/{item}", moment, value, error, quality)
            held.events += [text for [text] in database.execute("select text from events order by rowid")]
            held.writes += [(str(mark), out) for mark, out in database.execute("select id, outcome from audit")]
    return held


def of_mqtt(heard: Iterable[Heard]) -> Holding:
    held = Holding()
    for message in heard:
        kind, _, name = message.topic.partition("/")
        if kind == "values":
            held.add(name, message.payload["time"], message.payload["value"], message.payload["error"])
        elif kind == "events":
            held.events.append(message.payload["text"])
        elif kind == "audit":
            held.writes.append((str(message.payload["id"]), message.payload["outcome"]))
    return held


@dataclass
class Polled:
    """What a run printed of its cycles: the account of what was polled that no output has a hand in."""

    samples: int = 0
    errors: int = 0
    missed: int = 0
    vanished: int = 0
    """Cycles of the grid that were neither polled nor counted as missed."""
    cycles: dict[str, int] = field(default_factory=dict)
    """The last one of each group."""
    points: dict[str, int] = field(default_factory=dict)


def of_stdout(lines: Iterable[Line], periods: dict[str, float]) -> Polled:
    polled = Polled()
    series: list[list[dict[str, Any]]] = []
    current: dict[str, list[dict[str, Any]]] = {}
    for fields in json_lines(line.text for line in lines):
        group, known = fields["group"], current.get(fields["group"])
        if known is None or fields["cycle"] <= known[-1]["cycle"]:  # a group that was made anew counts anew
            current[group] = []
            series.append(current[group])
        current[group].append(fields)
    for cycles in series:
        first, last = cycles[0], cycles[-1]
        polled.samples += (last["cycle"] - first["cycle"] + 1) * len(last["samples"])
        polled.errors += sum(bool(sample["error"]) for cycle in cycles for sample in cycle["samples"].values())
        polled.missed += last["missed"]
        on_grid = round((last["due"] - first["due"]) / periods[last["group"]])
        # those that are missed while a cycle runs are counted in that one: only the sum over all can be held against it
        polled.vanished += max(0, on_grid - (last["cycle"] - first["cycle"]) - last["missed"])
        polled.cycles[last["group"]], polled.points[last["group"]] = last["cycle"], len(last["samples"])
    return polled


def json_lines(lines: Iterable[str]) -> Iterator[dict[str, Any]]:
    """A line that a crash has cut off is left out."""
    for line in lines:
        try:
            yield json.loads(line)
        except ValueError:
            continue


def number(text: str) -> Any:
    try:
        return int(text)
    except ValueError:
        try:
            return float(text)
        except ValueError:
            return text
