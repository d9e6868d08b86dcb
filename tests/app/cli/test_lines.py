"""What the commands on a LINE.toml share: which path is one, its other port, and the audit log that is kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import anyio
import pytest

from busmaster.app.cli import lines
from busmaster.app.cli.lines import is_line_file, keep
from busmaster.app.cli.output import Level
from busmaster.app.outputs.base import OutputStatistics
from tests.app.cli.conftest import Command


def counts(kind: str = "sqlite", *, waiting: int = 0, dropped: int = 0, error: str = "") -> OutputStatistics:
    return OutputStatistics(kind, "values", 0, dropped, waiting, error)


class Outputs:
    """Outputs of a line, whose statistics are these one after another; the last ones stay."""

    def __init__(self, *statistics: list[OutputStatistics]) -> None:
        self.left = list(statistics)
        self.done: list[object] = []

    def start(self, groups: tuple[()]) -> None:
        self.done.append("started")

    def record(self, record: object) -> None:
        self.done.append(record)

    def statistics(self) -> list[OutputStatistics]:
        return self.left.pop(0) if len(self.left) > 1 else self.left[0]

    async def close(self) -> None:
        self.done.append("closed")


@pytest.fixture
def notes(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Level]]:
    """The lines on standard error. Outputs have little time."""
    found: list[tuple[str, Level]] = []
    monkeypatch.setattr(lines, "note", lambda text, level=Level.INFO: found.append((text, level)))
    monkeypatch.setattr(lines, "LOOK", 0.001)
    return found


def kept(outputs: Any, *records: Any) -> None:
    anyio.run(keep, outputs, records)


def test_records_are_stored_before_the_outputs_are_closed(notes: list[tuple[str, Level]]) -> None:
    outputs = Outputs([counts(waiting=2)], *[[counts("mqtt"), counts(waiting=1)]] * 3, [counts()])
    kept(outputs, "first", "second")
    assert outputs.done == ["started", "first", "second", "closed"]
    assert len(outputs.left) == 1, "it has waited until nothing waits"
    assert notes == []


def test_an_output_that_failed_is_not_waited_for_and_reported_with_its_reason(
    notes: list[tuple[str, Level]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lines, "PATIENCE", 60.0)
    kept(Outputs([counts("mqtt", waiting=1, dropped=1, error="connection refused"), counts()]), "first")
    assert notes == [("mqtt: the audit log is incomplete: connection refused", Level.WARNING)]


def test_an_output_that_takes_too_long_is_reported(
    notes: list[tuple[str, Level]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lines, "PATIENCE", 0.01)
    outputs = Outputs([counts("csv"), counts(waiting=1, dropped=1)])
    kept(outputs, "first")
    assert outputs.done[-1] == "closed"
    assert notes == [("sqlite: the audit log is incomplete: not written within 0.01 s", Level.WARNING)]


def test_a_line_file_is_an_existing_file_of_that_ending(tmp_path: Path) -> None:
    for name in ("line.toml", "line.txt"):
        (tmp_path / name).touch()
    (tmp_path / "folder.toml").mkdir()
    assert is_line_file(str(tmp_path / "line.toml"))
    assert not any(is_line_file(str(tmp_path / name)) for name in ("line.txt", "folder.toml", "absent.toml"))


@pytest.mark.parametrize("command", ["check", "run", "plan", "serve", "safe", "points", "migrate", "emulate"])
def test_a_folder_is_no_line_file(busmaster: Command, tmp_path: Path, command: str) -> None:
    ran = busmaster(command, str(tmp_path))
    assert ran.status == 2
    assert "is a directory" in ran.err
