"""`busmaster migrate`: what it prints and writes, and its exit status."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from tests.app.cli.conftest import Command

OLD = """\
port = "/dev/none?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 5
timing = { lateness = 0.3 }  # lateness: by a scope
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "line.toml"
    path.write_text(OLD)
    return path


def test_without_write_the_changes_are_shown_and_the_file_stays(busmaster: Command, path: Path) -> None:
    shown = busmaster("migrate", str(path))
    assert (shown.status, shown.err) == (1, "")
    assert "-timing = { lateness = 0.3 }  # lateness: by a scope" in shown.lines
    assert "+timing = { max_reply_delay = 0.3 }  # lateness: by a scope" in shown.lines
    assert path.read_text() == OLD


def test_with_write_the_file_is_changed_keeps_its_mode_and_is_right(busmaster: Command, path: Path) -> None:
    path.chmod(0o640)
    wrote = busmaster("migrate", str(path), "--write")
    assert (wrote.status, wrote.out, wrote.err) == (0, f"{path}: 1 line changed\n", "")
    assert path.read_text() == OLD.replace("{ lateness", "{ max_reply_delay")
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    again = busmaster("migrate", str(path))
    assert (again.status, again.out) == (0, f"{path}: nothing to change\n")
    assert busmaster("check", str(path)).status == 0
    assert os.listdir(path.parent) == [path.name]


def test_only_the_lines_that_change_are_counted(busmaster: Command, path: Path) -> None:
    text = OLD.partition("[nodes.winder]")[2]
    path.write_text(f"{OLD}[nodes.other]{text.replace('address = 5', 'address = 6')}")
    wrote = busmaster("migrate", str(path), "--write")
    assert (wrote.status, wrote.out) == (0, f"{path}: 2 lines changed\n")
    assert path.read_text().count("max_reply_delay = 0.3") == 2


@pytest.mark.parametrize("text", ["[nodes", "\xff"])
def test_what_is_no_toml_is_an_error_with_its_line(busmaster: Command, path: Path, text: str) -> None:
    path.write_bytes(text.encode("latin-1"))
    refused = busmaster("migrate", str(path), "--write")
    assert refused.status == 2
    assert f"{path}:1: not valid TOML" in refused.err
    assert path.read_bytes() == text.encode("latin-1")
