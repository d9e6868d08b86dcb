"""Values as they are printed: shortest exact, words with their names, sets by their numbers."""

from __future__ import annotations

import enum
import errno
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
from busmaster.app.cli.output import SteadyOutput, emit, json_line, json_value, note, number_text, value_text


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
