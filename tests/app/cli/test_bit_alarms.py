"""A drive that trips is reported by `run` with the shipped template: on standard error and as an event."""

from __future__ import annotations

import random
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from busmaster.contract.profile import LineSettings
from busmaster.emulator.line import Line
from busmaster.emulator.serve import serve_pty
from busmaster.registry import make_device
from tests.app.cli.conftest import ended_once

TEXT = """
port = "{port}?baudrate=57600"
[nodes.drive]
protocol = "microflex"
address = 3
template = "microflex"
[groups.state]
period = 0.1
points = "drive/status_word"
[outputs.sqlite]
path = "{folder}/line.sqlite"
"""
ALARM = "drive/status_word.ASYNCHRONOUS_ERROR is set"


@pytest.mark.slow
def test_a_trip_is_reported_on_standard_error_and_as_an_event(tmp_path: Path) -> None:
    drive = make_device("microflex", 3, axis_error=2)
    path = tmp_path / "line.toml"
    with serve_pty(Line(LineSettings(57600), [drive], chance=random.Random(1), paced=False)) as server:
        path.write_text(TEXT.format(port=server.path, folder=tmp_path))
        run = ended_once(lambda lines: len(lines) >= 3, "run", str(path), "--json")
    assert run.err.count(f"busmaster: {ALARM}\n") == 1, run.err
    with closing(sqlite3.connect(tmp_path / "line.sqlite")) as database:
        assert (ALARM,) in database.execute("select text from events").fetchall()
