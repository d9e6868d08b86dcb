"""Values as they are printed: shortest exact, words with their names, sets by their numbers."""

from __future__ import annotations

import enum
import errno
import io
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster.app.cli.app import complain, show_warning
from busmaster.app.cli.output import (
    Level,
    SteadyOutput,
    columns,
    emit,
    is_journal,
    json_line,
    json_value,
    note,
    number_text,
    value_text,
)
from busmaster.app.cli.terminal import made_printable


class Status(enum.IntFlag):
    PROGRAM_RUNNING = 1
    ERROR = 2
    AUTO_START_ENABLED = 64


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (12.5, "12.5"),
        (-0.0001, "-0.0001"),
        (1234.0, "1234"),
        (1234, "1234"),
        (-0.0, "0"),
        (0.1 + 0.2, "0.30000000000000004"),
        (1e22, "10000000000000000000000"),
        (1e-7, "0.0000001"),
        (True, "1"),
        (Status(65), "65 PROGRAM_RUNNING|AUTO_START_ENABLED"),
        (Status(0), "0"),
        (Status(1 | 128), "129 PROGRAM_RUNNING|0x80"),
        (frozenset({31, 0, 5}), "0,5,31"),
        (frozenset(), "none"),
        ((1.5, 2.0), "1.5,2"),
        (None, "-"),
    ],
)
def test_a_value_is_printed_shortest_and_exact(value: Any, text: str) -> None:
    assert value_text(value) == text


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_printed_number_reads_back_as_itself_and_has_no_exponent(number: float) -> None:
    text = number_text(number)
    assert float(text) == number
    assert "e" not in text
    assert "." not in text or not text.endswith(("0", "."))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (12.5, "12.5"),
        (3.0, "3"),
        (2.0**53 - 1, "9007199254740991"),
        (1e17, "1e+17"),
        (float("nan"), "null"),
        (None, "null"),
        (Status(65), "65"),
        (frozenset({31, 0, 5}), "[0, 5, 31]"),
        ((1.0, -2.5), "[1, -2.5]"),
    ],
)
def test_json_has_words_as_numbers_and_sets_and_runs_as_lists(value: Any, text: str) -> None:
    assert json.dumps(json_value(value)) == text


EVIL = "winder\x1b]0;owned\x07\x1b[2J\x9b31m\x7f\u202e\r\n"


def test_escape_sequences_never_reach_a_terminal_raw(capfd: pytest.CaptureFixture[str]) -> None:
    """Neither on standard output nor on standard error; what stands in JSON is the same text still."""
    emit(f"a name {EVIL}", json_line(node=EVIL))
    note(EVIL)
    complain(f"{EVIL} is down", 1)
    show_warning(UserWarning(EVIL), UserWarning, "", 0)
    said = capfd.readouterr()
    assert all(line.isprintable() for line in (said.out + said.err).split("\n"))
    assert len(said.out.splitlines()) == 2
    assert json.loads(said.out.splitlines()[1]) == {"node": EVIL}
    assert said.err.startswith(r"busmaster: winder\u001b]0;owned\u0007\u001b[2J")


def test_what_comes_from_an_owner_is_made_printable_in_every_part() -> None:
    said = {"texts": [EVIL, {"deep": EVIL}], "number": 1.5, "none": None, "infinite": {"float": "inf"}}
    shown = made_printable(said)
    first, second = shown["texts"]
    assert first.isprintable()
    assert second == {"deep": first}
    assert (shown["number"], shown["none"], shown["infinite"]) == (1.5, None, float("inf"))


def test_letters_of_any_language_and_spaces_of_any_width_are_printed_as_they_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    emit("Wickler №\u202f2  Ø 12\u00a0mm")
    assert capsys.readouterr().out == "Wickler №\u202f2  Ø 12\u00a0mm\n"


def test_a_standard_error_that_nobody_reads_any_more_ends_nothing() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    code = "from busmaster.app.cli.output import note; note('lost'); print('it goes on')"
    try:
        run = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=writer, text=True, check=True)
    finally:
        os.close(writer)
    assert run.stdout == "it goes on\n"


@pytest.mark.parametrize("level", list(Level))
def test_the_journal_gets_the_level_of_each_line(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, level: Level
) -> None:
    status = os.fstat(sys.stderr.fileno())
    monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
    note("it happened", level)
    assert capfd.readouterr().err == f"<{level.value}>busmaster: it happened\n"
    # inherited from a service whose standard error was another file of the same device
    monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino + 1}")
    note("it happened", level)
    monkeypatch.setenv("JOURNAL_STREAM", "")
    note("it happened", level)
    assert capfd.readouterr().err == "busmaster: it happened\n" * 2


def test_a_program_within_another_prints_where_that_wants_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    note("it happened", Level.ERROR)
    assert stream.getvalue() == "busmaster: it happened\n"
    closed = (tmp_path / "closed").open("w")
    closed.close()
    assert not is_journal(closed, "1:2")


def test_what_other_code_has_printed_on_standard_error_comes_before_a_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with (tmp_path / "err").open("w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        stream.write("first\n")
        note("second")
    assert (tmp_path / "err").read_text() == "first\nbusmaster: second\n"


def test_lines_are_flushed_as_they_are_printed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with (tmp_path / "out").open("w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        emit("a", "b")
        assert (tmp_path / "out").read_text() == "a\nb\n"


def test_a_table_has_columns_as_wide_as_their_widest_cell_and_no_spaces_at_the_end() -> None:
    rows = [("NAME", "N", "UNIT"), ("a", "100", ""), ("longer", "7", "mm")]
    assert list(columns(rows, right=(1,))) == ["NAME      N  UNIT", "a       100", "longer    7  mm"]
    assert list(columns(rows)) == ["NAME    N    UNIT", "a       100", "longer  7    mm"]


def test_a_row_whose_first_cell_is_empty_or_flush_right_is_indented() -> None:
    rows = [("AT", "STATE"), ("120", "on"), ("7", "off"), ("", "unknown"), ("", "")]
    assert list(columns(rows, right=(0,))) == [" AT  STATE", "120  on", "  7  off", "     unknown", ""]
    assert list(columns(rows)) == ["AT   STATE", "120  on", "7    off", "     unknown", ""]


class Disk:
    """Standard output on a disk that takes so many bytes at each attempt; -1 for an error."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.takes: list[int] = []
        self.error: OSError = OSError(errno.ENOSPC, "No space left on device")
        self.data = b""
        self.reported: list[tuple[str, Level]] = []
        self.output = SteadyOutput(lambda text, level: self.reported.append((text, level)))
        monkeypatch.setattr(os, "write", self._write)

    def _write(self, _: int, data: bytes) -> int:
        count = self.takes.pop(0) if self.takes else len(data)
        if count < 0:
            raise self.error
        self.data += data[:count]
        return min(count, len(data))


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


def test_a_failure_of_standard_output_is_reported_when_it_begins_changes_and_ends(disk: Disk) -> None:
    for number in range(2):
        disk.takes = [-1, -1]
        disk.output.print(["a", "b"])
        disk.output.print(["c"])
        assert disk.output.lost == 3 + 4 * number
        disk.error = OSError(errno.EIO, "Input/output error")
        disk.takes = [-1]
        disk.output.print(["d"])
        disk.output.print(["e"])
        disk.output.print(["f"])
        disk.error = OSError(errno.ENOSPC, "No space left on device")
    full = "standard output failed: No space left on device; polling continues, these lines are lost"
    failed = "standard output failed: Input/output error; polling continues, these lines are lost"
    assert disk.reported == [
        (full, Level.WARNING),
        (failed, Level.WARNING),
        ("standard output works again; 4 lines were lost", Level.NOTICE),
        (full, Level.WARNING),
        (failed, Level.WARNING),
        ("standard output works again; 8 lines were lost", Level.NOTICE),
    ]
    assert disk.data == b"e\nf\ne\nf\n"


def test_lines_that_are_taken_in_parts_are_whole_and_only_those_behind_a_failure_are_lost(disk: Disk) -> None:
    disk.takes = [2, 1, 3]
    disk.output.print(["abc", "def"])
    assert disk.data == b"abc\ndef\n"
    disk.takes = [4, 6, -1]
    disk.output.print(["one", "two", "three", "four"])
    assert disk.output.lost == 2  # three was cut off
    disk.output.print(["next"])
    disk.output.print(["last"])
    assert disk.data == b"abc\ndef\none\ntwo\nth\nnext\nlast\n"


def test_a_reader_that_has_left_ends_the_command(disk: Disk) -> None:
    disk.takes = [-1]
    disk.error = BrokenPipeError()
    with pytest.raises(BrokenPipeError):
        disk.output.print(["a"])
    assert disk.reported == []


def test_a_line_that_was_cut_off_stays_apart_from_later_ones_though_attempts_in_between_write_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    takes = [3, 0, 100]
    file = (tmp_path / "out").open("wb")

    def write(_: int, data: bytes) -> int:
        space = takes[0]
        if not space:
            takes.pop(0)
            raise OSError(errno.ENOSPC, "No space left on device")
        takes[0] = space - len(data[:space]) if space < 100 else space
        file.write(data[:space])
        return len(data[:space])

    monkeypatch.setattr(os, "write", write)
    reported: list[str] = []
    output = SteadyOutput(lambda what, level: reported.append(what))
    for line in ("first", "second", "third"):
        output.print([line])
    file.close()
    assert (tmp_path / "out").read_bytes() == b"fir\nthird\n"
    assert output.lost == 2
    assert len(reported) == 2
