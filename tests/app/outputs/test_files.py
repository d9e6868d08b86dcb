"""CSV and JSON lines."""

from __future__ import annotations

import csv
import errno
import json
import os
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from busmaster import Point, Sample
from busmaster.app.config.keys import keys_of
from busmaster.app.config.points import NamedPoint, Scale
from busmaster.app.outputs import growing_file
from busmaster.app.outputs.base import Happening, OutputKind
from busmaster.app.outputs.cells import csv_lines, no_formula, text_cell, text_of
from busmaster.app.outputs.files import COLUMNS, CsvOutput, JsonlOutput
from busmaster.app.outputs.growing_file import GrowingFile
from busmaster.app.outputs.kinds import kinds
from busmaster.app.outputs.settings import (
    DATE_FIELDS,
    FileSettings,
    MetricsSettings,
    MqttSettings,
    Settings,
    SqliteSettings,
    file_mode,
)
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


def test_the_time_of_a_value_is_that_of_its_own_reply(tmp_path: Path) -> None:
    output = CsvOutput("csv", FileSettings(path=str(tmp_path / "x.csv")))
    found = cycle(1, 1, 2)
    samples = {point: sample._replace(wall=1e9 + sample.value) for point, sample in found.samples.items()}
    output.commit([output.format(replace(found, samples=samples)) or b""])
    output.shut()
    times = [row["time"] for row in csv.DictReader(written(tmp_path / "x.csv"))]
    assert times == ["2001-09-09T01:46:41.000Z", "2001-09-09T01:46:42.000Z"]


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
    output.offer(Happening(1.5, "", "the line is lost"))
    output.close(PATIENCE)
    first, second, third = map(json.loads, written(path))
    assert first["samples"] == {
        "5/1": {"quality": "good", "value": 12, "error": None, "late": False},
        "5/2": {"quality": "bad", "value": None, "error": "no reply", "late": False, "hint": NoReply.hint},
    }
    assert (first["group"], first["cycle"], first["missed"]) == ("axes", 1, 0)
    assert abs(first["started"] - time.time()) < PATIENCE
    assert (second["event"], second["node"]) == ("winder is down, was suspect", "winder")
    assert third == {"event": "the line is lost", "node": None, "time": 1.5}


def test_a_new_file_begins_when_the_date_in_its_name_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    days = iter([1, 2])
    monkeypatch.setattr(time, "strftime", lambda pattern: pattern.replace("%d", str(next(days, 2))))
    reported: list[str] = []
    output = CsvOutput("csv", FileSettings(path=str(tmp_path / "x-%d.csv")), reported.append)
    for number in (1, 2):
        output.commit([output.format(cycle(number, number)) or b""])
    output.shut()
    assert reported == []
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


@pytest.mark.parametrize("before", ['{"whole": 1}\n{"half', "{"])
def test_a_half_line_that_a_crash_left_is_closed_off_and_that_is_told(tmp_path: Path, before: str) -> None:
    path = tmp_path / "x.jsonl"
    path.write_text(before)
    told: list[str] = []
    output = JsonlOutput("jsonl", FileSettings(path=str(path)), report=told.append)
    output.commit([b"{}\n"])
    output.shut()
    assert written(path) == [*before.splitlines(), "{}"]
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
    named = {replace(point, unit=name, item=name): sample for point, sample in snapshot.samples.items()}
    [row] = csv.reader((output.format(replace(snapshot, samples=named)) or b"").decode().splitlines()[:1])
    assert (row[4], row[6]) == (f"'{name}", f"'{name}")


@pytest.mark.parametrize("name", ["=1+1", "+1+1", "-2+3", "@SUM(1)"])
def test_no_node_and_no_text_is_a_formula_to_a_spreadsheet(name: str) -> None:
    output = CsvOutput("csv", FileSettings(path="x.csv"))
    snapshot = cycle(1, name)
    named: dict[Point[Any], Sample[Any]] = {
        NamedPoint.of(point, where=name, name="force", unit="", scale=Scale.of()): sample
        for point, sample in snapshot.samples.items()
    }
    [row] = csv.reader((output.format(replace(snapshot, samples=named)) or b"").decode().splitlines())
    assert (row[3], row[4], row[5]) == (f"'{name}", "force", f"'{name}")


def test_a_line_end_at_the_beginning_is_a_formula_to_a_spreadsheet_too() -> None:
    assert no_formula("\r=1+1") == "'\r=1+1"


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


def test_after_a_sync_the_next_one_is_due_after_the_whole_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    clock = [100.0]
    monkeypatch.setattr(os, "fsync", synced.append)
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    file = GrowingFile(str(tmp_path / "x"), sync_every=10.0)
    times = []
    for clock[0] in (105.0, 111.0, 112.0, 120.0, 121.0):
        file.append(b"line\n")
        times.append(len(synced))
    assert times == [0, 1, 1, 1, 2]
    file.close()


def open_in(folder: Path) -> list[str]:
    """The files of a folder, and the folder itself, that this process has open."""
    found = []
    for descriptor in os.listdir("/proc/self/fd"):
        try:
            name = os.readlink(f"/proc/self/fd/{descriptor}")
        except OSError:  # the one by which the folder was listed
            continue
        if name.startswith(str(folder)):
            found.append(name)
    return found


def test_files_that_are_left_are_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "one"
    monkeypatch.setattr(time, "strftime", lambda _: str(tmp_path / name))
    file = GrowingFile("%d")
    for name in ("one", "two"):
        file.append(b"line\n", sync=True)
        assert open_in(tmp_path) == [str(tmp_path / name)]
    (tmp_path / "two").unlink()
    file.append(b"line\n")
    assert open_in(tmp_path) == [str(tmp_path / "two")]
    file.close()
    assert open_in(tmp_path) == []
    file.close()


def test_the_name_of_each_new_file_is_synced_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append(os.readlink(f"/proc/self/fd/{descriptor}")))
    monkeypatch.chdir(tmp_path)
    file = GrowingFile("x")  # a path without a folder
    for moved in (False, False, True, False):
        if moved:
            (tmp_path / "x").rename(tmp_path / "old")
        file.append(b"line\n", sync=True)
    file.close()
    assert synced.count(str(tmp_path)) == 2
    assert synced.count(str(tmp_path / "x")) == 5


def test_a_disk_that_is_lost_at_the_close_and_a_folder_that_cannot_be_synced_are_no_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(descriptor: int) -> None:
        if closing or os.path.isdir(f"/proc/self/fd/{descriptor}"):
            raise OSError(errno.EIO, "Input/output error")

    closing = False
    monkeypatch.setattr(os, "fsync", fails)
    file = GrowingFile(str(tmp_path / "x"))
    file.append(b"line\n", sync=True)
    closing = True
    file.close()
    assert open_in(tmp_path) == []


def test_a_folder_that_has_gone_is_not_made_and_a_dated_one_is_for_its_owner_and_group(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        GrowingFile(str(tmp_path / "gone" / "x-%d")).append(b"line\n")
    before = os.umask(0)
    try:
        file = GrowingFile(str(tmp_path / "in-%Y" / "x"))
        file.append(b"line\n")
        file.close()
    finally:
        os.umask(before)
    [folder] = tmp_path.iterdir()
    assert folder.stat().st_mode & 0o007 == 0


def test_several_files_of_a_dated_folder_are_in_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    days = iter((1, 2))
    monkeypatch.setattr(time, "strftime", lambda pattern: pattern.replace("%Y", "2026").replace("%d", str(next(days))))
    file = GrowingFile(str(tmp_path / "in-%Y" / "x-%d"))
    for _ in range(2):
        file.append(b"line\n")
    file.close()
    assert sorted(path.name for path in (tmp_path / "in-2026").iterdir()) == ["x-1", "x-2"]


def test_a_file_that_must_not_be_read_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    (tmp_path / "x").write_bytes(b"first\n")
    monkeypatch.setattr(growing_file, "open", refused, raising=False)
    file = GrowingFile(str(tmp_path / "x"))
    file.append(b"second\n")
    file.close()
    assert (tmp_path / "x").read_bytes() == b"first\nsecond\n"


@pytest.mark.parametrize(
    ("text", "cell"),
    [
        ("", "'"),
        ("winder", "winder"),
        ("0", "0"),
        ("15", "15"),
        (15 * "9", 15 * "9"),
        (16 * "9", "'" + 16 * "9"),  # a spreadsheet keeps 15 digits
        ("01", "'01"),
        ("1.20", "'1.20"),
        ("4-8", "'4-8"),
        (",5", "',5"),
        (".5", "'.5"),
        (" 5", "' 5"),
        ("'5", "''5"),
        ("=1+1", "'=1+1"),
        ("-5", "'-5"),
        ("two\nlines", "two\nlines"),
    ],
)
def test_a_text_that_a_spreadsheet_would_change_is_behind_an_apostrophe(text: str, cell: str) -> None:
    assert text_cell(text) == cell
    assert text_of(cell) == text


def test_a_line_of_csv_keeps_the_spaces_at_its_end_and_quotes_line_ends() -> None:
    assert csv_lines([["a", "b  "], ["c\r\nd", 'say "x"'], ["e", "f\r"]]) == (b'a,b  \n"c\r\nd","say ""x"""\ne,"f\r"\n')


@pytest.mark.parametrize("text", ["640", "0640", "0777", "000"])
def test_a_mode_is_octal(text: str) -> None:
    assert file_mode(text) == int(text, 8)


@pytest.mark.parametrize("text", ["", "40", "00640", "0o640", "0680", "1777", "rw-", "-640"])
def test_a_mode_of_something_else_is_refused(text: str) -> None:
    with pytest.raises(InvalidCommand, match="octal"):
        file_mode(text)


@pytest.mark.parametrize(
    ("settings", "destination"),
    [
        (FileSettings(path="x.csv"), "x.csv"),
        (SqliteSettings(path="x.db"), "x.db"),
        (MqttSettings(host="broker", port=1884), "broker:1884"),
        (MetricsSettings(host="192.0.2.7", port=9465), "192.0.2.7:9465"),
        (Settings(), ""),
    ],
)
def test_messages_name_the_file_or_the_address_of_an_output(settings: Settings, destination: str) -> None:
    assert settings.destination == destination


@pytest.mark.parametrize("kind", kinds(), ids=lambda kind: str(kind.name))
def test_a_buffer_holds_one_value_at_least(kind: OutputKind) -> None:
    required: dict[str, Any] = {key.field: "x" for key in keys_of(kind.settings) if key.required}
    assert kind.settings(**required, buffer=1).buffer == 1
    with pytest.raises(InvalidCommand, match="at least one value, not 0"):
        kind.settings(**required, buffer=0)
