"""CSV and JSON lines."""

from __future__ import annotations

import csv
import json
import os
import time
from datetime import UTC, datetime
from pathlib import Path

import pytest

from busmaster.app.outputs.base import Happening
from busmaster.app.outputs.files import COLUMNS, CsvOutput, JsonlOutput
from busmaster.app.outputs.settings import DATE_FIELDS, FileSettings
from busmaster.errors import InvalidCommand, NoReply
from busmaster.protocols.msc.status import ProgramStatus
from tests.app.outputs.cycles import cycle
from tests.patience import PATIENCE


def written(path: Path) -> list[str]:
    return path.read_text().splitlines()


def test_csv_has_a_line_a_value_under_a_head_and_grows(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    before = time.time()
    for number in (1, 2):
        output = CsvOutput("csv", FileSettings(path=str(path)))
        output.start()
        output.offer(cycle(number, 12.5, ProgramStatus(65), (1, 2), NoReply("no reply within 100 ms")))
        output.close(PATIENCE)
    rows = list(csv.DictReader(written(path)))
    assert [row["cycle"] for row in rows] == ["1"] * 4 + ["2"] * 4
    assert [row["value"] for row in rows[:4]] == ["12.5", "65 PROGRAM_RUNNING|AUTO_START_ENABLED", "1,2", ""]
    assert [row["quality"] for row in rows[:4]] == ["good", "good", "good", "bad"]
    assert rows[3]["error"] == "no reply within 100 ms"
    assert [(row["node"], row["item"], row["group"]) for row in rows[:2]] == [("5", "1", "axes"), ("5", "2", "axes")]
    moment = datetime.fromisoformat(rows[0]["time"])
    assert moment.tzinfo == UTC
    assert before - 1 < moment.timestamp() < time.time() + 1


@pytest.mark.parametrize(
    ("path", "field"),
    [
        ("%Q-line.csv", "%Q"),
        ("line-%f.csv", "%f"),
        ("line-%D.csv", "%D"),
        ("line-%-%.csv", "%-%"),
        ("line-%\n.csv", "%\n"),
        ("line.csv%", "%"),
    ],
)
def test_what_is_no_field_of_a_date_is_refused(path: str, field: str) -> None:
    with pytest.raises(InvalidCommand) as refused:
        FileSettings(path=path)
    assert str(refused.value).startswith(f"{path}: {field} is not a field of a date")


def test_each_field_that_is_taken_is_one_of_this_machines_dates() -> None:
    """What strftime does not know it leaves as it is, and would be part of a file's name."""
    for field in sorted(DATE_FIELDS):
        for text in (f"%{field}", f"%-{field}"):
            name = time.strftime(FileSettings(path=text).path)
            assert "%" not in name
            assert "/" not in name
    assert time.strftime(FileSettings(path="100%%-%Y").path).startswith("100%-2")


def test_json_lines_are_cycles_and_events(tmp_path: Path) -> None:
    path = tmp_path / "x.jsonl"
    output = JsonlOutput("jsonl", FileSettings(path=str(path)))
    output.start()
    output.offer(cycle(1, 12.0, NoReply("no reply")))
    output.offer(Happening(time.time(), "winder", "winder is down, was suspect"))
    output.close(PATIENCE)
    first, second = map(json.loads, written(path))
    assert first["samples"] == {
        "5/1": {"quality": "good", "value": 12, "error": None, "late": False},
        "5/2": {"quality": "bad", "value": None, "error": "no reply", "late": False, "hint": NoReply.hint},
    }
    assert (first["group"], first["cycle"], first["missed"]) == ("axes", 1, 0)
    assert abs(first["started"] - time.time()) < PATIENCE
    assert (second["event"], second["node"]) == ("winder is down, was suspect", "winder")


def test_a_new_file_begins_when_the_date_in_its_name_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    days = iter([1, 2])
    monkeypatch.setattr(time, "strftime", lambda pattern: pattern.replace("%d", str(next(days, 2))))
    output = CsvOutput("csv", FileSettings(path=str(tmp_path / "x-%d.csv")))
    for number in (1, 2):
        output.commit([output.format(cycle(number, number)) or b""])
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
    with pytest.raises(InvalidCommand, match=r"the folder .* does not exist"):
        CsvOutput("csv", FileSettings(path=str(tmp_path / "none" / "x.csv")))


def test_a_file_that_was_moved_away_or_removed_is_begun_anew_and_that_is_told(tmp_path: Path) -> None:
    path = tmp_path / "x.jsonl"
    told: list[str] = []
    output = JsonlOutput("jsonl", FileSettings(path=str(path)), report=told.append)
    output.commit([b"first\n"])
    path.rename(tmp_path / "x.jsonl.1")
    output.commit([b"second\n"])
    path.unlink()
    output.commit([b"third\n"])
    output.shut()
    assert written(tmp_path / "x.jsonl.1") == ["first"]
    assert written(path) == ["third"]
    assert told == [f"jsonl: {path} was moved or removed; a new file was started"] * 2


def test_a_file_that_is_removed_while_it_is_written_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.csv"
    output = CsvOutput("csv", FileSettings(path=str(path)))
    output.commit([b"first\n"])
    write = os.write

    def remove_and_write(descriptor: int, data: bytes) -> int:
        if path.exists() and b"second" in bytes(data):
            monkeypatch.setattr(os, "write", write)
            path.unlink()
        return write(descriptor, data)

    monkeypatch.setattr(os, "write", remove_and_write)
    output.commit([b"second\n"])
    output.shut()
    assert written(path) == [",".join(COLUMNS), "second"]


def test_a_file_that_was_emptied_begins_with_its_head_again(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    output = CsvOutput("csv", FileSettings(path=str(path)))
    output.commit([b"first\n"])
    os.truncate(path, 0)
    output.commit([b"second\n"])
    output.shut()
    assert written(path) == [",".join(COLUMNS), "second"]


def test_a_half_line_that_a_crash_left_is_closed_off_and_that_is_told(tmp_path: Path) -> None:
    path = tmp_path / "x.jsonl"
    path.write_bytes(b'{"whole": 1}\n{"half')
    told: list[str] = []
    output = JsonlOutput("jsonl", FileSettings(path=str(path)), report=told.append)
    output.commit([b"{}\n"])
    output.shut()
    assert written(path) == ['{"whole": 1}', '{"half', "{}"]
    assert told == [f"jsonl: {path} ended with an incomplete line, which was closed"]


def test_folders_of_dated_paths_are_made_when_their_time_comes(tmp_path: Path) -> None:
    pattern = tmp_path / "%Y" / "%m" / "x-%d.csv"
    output = CsvOutput("csv", FileSettings(path=str(pattern)))
    output.commit([b"first\n"])
    output.shut()
    [path] = tmp_path.rglob("*.csv")
    assert path.parent.parent.parent == tmp_path
    with pytest.raises(InvalidCommand, match=r"the folder .* does not exist"):
        CsvOutput("csv", FileSettings(path=str(tmp_path / "none" / "%Y" / "x.csv")))


@pytest.mark.parametrize(
    ("mode", "umask", "becomes"), [(0o640, 0o022, 0o640), (0o666, 0o027, 0o640), (0o600, 0, 0o600)]
)
def test_a_new_file_has_the_mode_that_was_asked_for_narrowed_by_the_umask(
    tmp_path: Path, mode: int, umask: int, becomes: int
) -> None:
    path = tmp_path / "x.csv"
    before = os.umask(umask)
    try:
        output = CsvOutput("csv", FileSettings(path=str(path), mode=mode))
        output.commit([b"first\n"])
        output.shut()
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == becomes


@pytest.mark.parametrize("name", ["=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(1)", "\tx"])
def test_no_name_is_a_formula_to_a_spreadsheet(name: str) -> None:
    output = CsvOutput("csv", FileSettings(path="x.csv"))
    snapshot = cycle(1, -47.6, NoReply(name), group=name)
    line, bad = csv.reader((output.format(snapshot) or b"").decode().splitlines())
    assert (line[1], bad[8]) == (f"'{name}", f"'{name}")
    assert line[5] == "-47.6"


def test_what_was_written_is_synced_when_it_is_due_and_when_the_file_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", synced.append)
    for every, times in ((0.0, 3), (1e9, 1)):
        synced.clear()
        output = JsonlOutput("jsonl", FileSettings(path=str(tmp_path / f"{every}.jsonl"), sync_every=every))
        output.commit([b"{}\n"])
        output.commit([b"{}\n"])
        output.shut()
        assert len(synced) == times
