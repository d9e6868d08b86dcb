"""What is kept of a write, in each output."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

from busmaster.app.outputs.files import CsvOutput, JsonlOutput
from busmaster.app.outputs.settings import FileSettings, SqliteSettings
from busmaster.app.outputs.sqlite import SqliteOutput
from busmaster.app.service.record import Outcome, WriteRecord
from tests.app.outputs.cycles import settled, until
from tests.patience import PATIENCE

WRITE = WriteRecord(
    1767225600.25, "screen", "key w", "op", 17, "winder/setpoint", 1.5, 2, Outcome.UNCONFIRMED, "no reply", 0.1, "a1"
)
KEPT = {
    "time": 1767225600.25,
    "interface": "screen",
    "by": "key w",
    "user": "op",
    "process": 17,
    "point": "winder/setpoint",
    "before": 1.5,
    "value": 2,
    "outcome": "unconfirmed",
    "error": "no reply",
    "took": 0.1,
    "id": "a1",
}


def test_sqlite_has_a_row_of_each_write(tmp_path: Path) -> None:
    output = SqliteOutput("sqlite", SqliteSettings(path=str(tmp_path / "line.sqlite")))
    output.start()
    output.offer(WRITE)
    until(lambda: settled(output))
    output.close(PATIENCE)
    database = sqlite3.connect(tmp_path / "line.sqlite")
    database.row_factory = sqlite3.Row
    assert [dict(row) for row in database.execute("select * from audit")] == [KEPT]


def test_json_lines_have_a_line_of_each_write_and_csv_has_values_alone(tmp_path: Path) -> None:
    for kind, output in (
        ("jsonl", JsonlOutput("jsonl", FileSettings(path=str(tmp_path / "jsonl")))),
        ("csv", CsvOutput("csv", FileSettings(path=str(tmp_path / "csv")))),
    ):
        output.start()
        output.offer(WRITE)
        until(lambda output=output: settled(output))  # type: ignore[misc]  # bound now
        output.close(PATIENCE)
        if kind == "jsonl":
            assert json.loads((tmp_path / kind).read_text()) == {"write": "winder/setpoint", **KEPT}
        else:
            assert not (tmp_path / kind).exists() or "setpoint" not in (tmp_path / kind).read_text()


def test_a_log_says_it_in_one_line() -> None:
    assert WRITE.text == (
        "winder/setpoint = 2 (before: 1.5) unconfirmed in 0.100 s by screen key w [a1], op 17: no reply"
    )
