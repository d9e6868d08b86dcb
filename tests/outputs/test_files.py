"""CSV and JSON lines."""

from __future__ import annotations

import csv
import json
import os
import time
from datetime import UTC, datetime
from pathlib import Path

import pytest

from busmaster.errors import InvalidCommand, NoReply
from busmaster.outputs.base import Happening
from busmaster.outputs.files import CsvOutput, JsonlOutput
from busmaster.outputs.settings import FileSettings
from busmaster.protocols.msc.status import ProgramStatus
from tests.outputs.cycles import cycle


def written(path: Path) -> list[str]:
    return path.read_text().splitlines()


def test_csv_has_a_line_a_value_under_a_head_and_grows(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    before = time.time()
    for number in (1, 2):
        output = CsvOutput("csv", FileSettings(path=str(path)))
        output.start()
        output.offer(cycle(number, 12.5, ProgramStatus(65), (1, 2), NoReply("no reply within 100 ms")))
        output.close(5)
    rows = list(csv.DictReader(written(path)))
    assert [row["cycle"] for row in rows] == ["1"] * 4 + ["2"] * 4
    assert [row["value"] for row in rows[:4]] == ["12.5", "65 PROGRAM_RUNNING|AUTO_START_ENABLED", "1,2", ""]
    assert [row["quality"] for row in rows[:4]] == ["good", "good", "good", "bad"]
    assert rows[3]["error"] == "no reply within 100 ms"
    assert [(row["node"], row["item"], row["group"]) for row in rows[:2]] == [("5", "1", "axes"), ("5", "2", "axes")]
    moment = datetime.fromisoformat(rows[0]["time"])
    assert moment.tzinfo == UTC
    assert before - 1 < moment.timestamp() < time.time() + 1


def test_json_lines_are_cycles_and_events(tmp_path: Path) -> None:
    path = tmp_path / "x.jsonl"
    output = JsonlOutput("jsonl", FileSettings(path=str(path)))
    output.start()
    output.offer(cycle(1, 12.0, NoReply("no reply")))
    output.offer(Happening(time.monotonic(), "winder", "winder is down, was suspect"))
    output.close(5)
    first, second = map(json.loads, written(path))
    assert first["samples"] == {
        "5/1": {"value": 12, "error": None, "late": False},
        "5/2": {"value": None, "error": "no reply", "late": False},
    }
    assert (first["group"], first["cycle"], first["missed"]) == ("axes", 1, 0)
    assert abs(first["started"] - time.time()) < 5
    assert (second["event"], second["node"]) == ("winder is down, was suspect", "winder")


def test_a_new_file_begins_when_the_date_in_its_name_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    days = iter([1, 1, 2])
    monkeypatch.setattr(time, "strftime", lambda pattern: pattern.replace("%d", str(next(days, 2))))
    output = CsvOutput("csv", FileSettings(path=str(tmp_path / "x-%d.csv")))
    for number in (1, 2):
        output.commit([output.format(cycle(number, number), lambda t: t) or b""])
    output.shut()
    assert [len(written(tmp_path / f"x-{day}.csv")) for day in (1, 2)] == [2, 2]


def test_a_batch_that_the_disk_has_no_room_for_leaves_no_half_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.jsonl"
    output = JsonlOutput("jsonl", FileSettings(path=str(path)))
    output.commit([b"first\n"])
    write = os.write
    pieces = iter([3])

    def short(descriptor: int, data: memoryview) -> int:
        for size in pieces:
            return write(descriptor, data[:size])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "write", short)
    with pytest.raises(OSError, match="No space"):
        output.commit([b"second\n"])
    monkeypatch.undo()
    output.commit([b"second\n"])
    output.shut()
    assert written(path) == ["first", "second"]


def test_a_folder_that_is_not_there_is_said_before_anything_starts(tmp_path: Path) -> None:
    with pytest.raises(InvalidCommand, match="there is no folder"):
        CsvOutput("csv", FileSettings(path=str(tmp_path / "none" / "x.csv")))
