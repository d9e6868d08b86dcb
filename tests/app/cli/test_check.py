"""`busmaster check`: what it prints, and its exit status."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from busmaster.app.cli import check
from busmaster.app.cli.output import Level
from busmaster.app.config import FileError
from busmaster.app.line import Report
from tests.app.cli.conftest import Command

GOOD = """\
port = "/dev/nothing-is-there?baudrate=57600"

[nodes.winder]
protocol = "hcp2"
address = 5

[groups.axes]
period = 0.1
points = ["winder/1"]
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "line.toml"
    path.write_text(GOOD)
    return path


def test_a_file_that_is_right_ends_with_0(busmaster: Command, path: Path) -> None:
    checked = busmaster("check", str(path))
    assert (checked.status, checked.out, checked.err) == (0, f"{path}: no problems\n", "")


def test_problems_are_a_line_each_and_end_with_1(busmaster: Command, path: Path) -> None:
    path.write_text(GOOD.replace("0.1", "-1").replace("= 5", "= 500"))
    checked = busmaster("check", str(path))
    assert (checked.status, checked.err) == (1, "")
    first, second, verdict = checked.lines
    assert first.startswith(f"{path}:5: nodes.winder.address: ")
    assert second.startswith(f"{path}:8: groups.axes.period: ")
    assert verdict == f"{path}: 2 problems"


@pytest.mark.parametrize(
    ("text", "problems"),
    [
        ("title = 'x'\n", ["'port' is missing", "the file has no nodes"]),
        (GOOD.replace("0.1", "-1").replace('points = ["winder/1"]\n', ""), ["8: groups.axes.period: "]),
        (f"{GOOD}[service]\nshare = 'x'\n[emulator]\nseed = 'x'\n", ["11: service.share: ", "13: emulator.seed: "]),
    ],
)
def test_each_problem_is_reported_once_and_none_that_only_follows_from_another(
    busmaster: Command, path: Path, text: str, problems: list[str]
) -> None:
    path.write_text(text)
    *lines, _ = busmaster("check", str(path)).lines
    assert len(lines) == len(problems)
    assert all(problem in line for problem, line in zip(problems, lines, strict=True))


def test_schema_option_prints_the_published_json_schema_and_needs_no_file(busmaster: Command) -> None:
    printed = busmaster("check", "--schema")
    assert (printed.status, printed.err) == (0, "")
    assert printed.out == (Path(__file__).parents[3] / "docs" / "line.schema.json").read_text()


def test_warnings_go_to_standard_error_and_are_no_problems(busmaster: Command, path: Path) -> None:
    path.write_text(GOOD.partition("[groups")[0])
    checked = busmaster("check", str(path))
    assert (checked.status, checked.out) == (0, f"{path}: no problems\n")
    assert "warning: nothing is polled" in checked.err


def test_the_second_table_of_a_kind_is_reported_too(busmaster: Command, path: Path) -> None:
    path.write_text(
        """\
port = "/dev/nothing-is-there?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 500
[nodes.unwinder]
protocol = "hcp2"
address = 501
[nodes.cutter]
protocol = "hcp2"
address = 5
points.speed = { item = "1", precision = -1 }
points.force = { item = "2", precision = -2 }
actions.slow = { "1" = 1, odd = 2 }
actions.fast = { "1" = 2, odd = 3 }
[groups.axes]
period = -1
points = ["cutter/speed"]
[groups.forces]
period = -2
points = ["cutter/force"]
[outputs.mqtt]
buffer = -1
[outputs.csv]
buffer = -2
"""
    )
    checked = busmaster("check", str(path))
    assert checked.status == 1
    lines = {int(line.split(":")[1]) for line in checked.lines[:-1]}
    assert {4, 7, 11, 12, 16, 19, 22, 24} <= lines, checked.out


@pytest.fixture
def reported(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Level]]:
    """The lines on standard error. Each file has a problem and two warnings."""
    notes: list[tuple[str, Level]] = []
    problem = FileError("line.toml", 0, "", "the port is missing")
    monkeypatch.setattr(check, "check", lambda path: Report((problem,), ("nothing is polled", "no output")))
    monkeypatch.setattr(check, "note", lambda text, level=Level.INFO: notes.append((text, level)))
    return notes


def test_each_warning_is_a_line_with_its_level_and_one_problem_is_one(
    busmaster: Command, path: Path, reported: list[tuple[str, Level]]
) -> None:
    checked = busmaster("check", str(path))
    assert (checked.status, checked.lines[-1]) == (1, f"{path}: 1 problem")
    assert reported == [("warning: nothing is polled", Level.WARNING), ("warning: no output", Level.WARNING)]


@pytest.mark.usefixtures("reported")
def test_json_has_each_warning_and_fails_as_the_text_does(busmaster: Command, path: Path) -> None:
    checked = busmaster("check", "--json", str(path))
    assert checked.status == 1
    assert json.loads(checked.out) == {
        "file": str(path),
        "ok": False,
        "problems": [{"file": "line.toml", "line": None, "key": "", "problem": "the port is missing"}],
        "warnings": ["nothing is polled", "no output"],
    }


def test_completion_of_the_schema_option_prints_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    check.command.make_context("check", ["--schema"], resilient_parsing=True).close()
    assert capsys.readouterr().out == ""


def test_json_of_a_file_with_warnings_only_is_ok(busmaster: Command, path: Path) -> None:
    path.write_text(GOOD.partition("[groups")[0])
    checked = busmaster("check", str(path), "--json")
    found = json.loads(checked.out)
    assert (checked.status, found["ok"]) == (0, True)
    assert found["warnings"]


def test_json_has_problems_with_file_line_and_key_and_warnings(busmaster: Command, path: Path) -> None:
    path.write_text(GOOD.replace("points", "pionts"))
    checked = busmaster("check", "--json", str(path))
    assert (checked.status, checked.err) == (1, "")
    said = json.loads(checked.out)
    assert (said["file"], said["ok"], said["warnings"]) == (str(path), False, [])
    missing, unknown = said["problems"]
    assert (unknown["file"], unknown["line"], unknown["key"]) == (str(path), 9, "groups.axes.pionts")
    assert "did you mean 'points'?" in unknown["problem"]
    assert missing["key"] == "groups.axes"


def test_json_of_a_problem_of_the_whole_file_has_no_line(busmaster: Command, path: Path) -> None:
    path.write_text("\n".join(GOOD.splitlines()[1:]))
    [problem] = json.loads(busmaster("check", "--json", str(path)).out)["problems"]
    assert (problem["line"], problem["key"]) == (None, "")


def test_json_of_a_file_that_is_right_is_ok(busmaster: Command, path: Path) -> None:
    checked = busmaster("check", "--json", str(path))
    assert (checked.status, json.loads(checked.out)["ok"]) == (0, True)


def test_a_file_that_is_not_there_is_wrong_usage(busmaster: Command, tmp_path: Path) -> None:
    assert busmaster("check", str(tmp_path / "none.toml")).status == 2
