"""The embedded default."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from busmaster.errors import NoReply
from busmaster.outputs import sqlite
from busmaster.outputs.base import Happening
from busmaster.outputs.settings import SqliteSettings
from busmaster.outputs.sqlite import DAY, SqliteOutput, column
from busmaster.protocols.msc.status import ProgramStatus
from tests.outputs.cycles import cycle, settled, until


def test_a_column_holds_whatever_a_value_is() -> None:
    values = (None, 1, 1.5, "text", True, float("nan"), ProgramStatus(65), frozenset({2, 1}), {"a": 1})
    assert [column(value) for value in values] == [None, 1, 1.5, "text", 1, None, 65, "[1, 2]", "{'a': 1}"]


@contextmanager
def recording(path: Path, keep_days: float | None = None) -> Iterator[SqliteOutput]:
    output = SqliteOutput("sqlite", SqliteSettings(path=str(path), keep_days=keep_days))
    output._retry = 0.01
    output.start()
    try:
        yield output
    finally:
        output.close(5)


def query(path: Path, text: str) -> list[Any]:
    with closing(sqlite3.connect(path)) as database:
        return database.execute(text).fetchall()


def test_values_events_and_errors_are_there_under_their_names(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    with recording(path) as output:
        output.offer(cycle(1, 12.5, 3, (1, 2), NoReply("no reply")))
        output.offer(cycle(2, 13.5, 4, (3, 4), 5.0))
        output.offer(Happening(time.monotonic(), "winder", "winder is down, was suspect"))
    assert output.statistics().written == 9
    history = query(path, "select node, item, value, quality, error from history order by time, item")
    assert history[:4] == [
        ("5", "1", 12.5, "good", None),
        ("5", "2", 3, "good", None),
        ("5", "3", "[1, 2]", "good", None),
        ("5", "4", None, "bad", "no reply"),
    ]
    assert len(history) == 8
    assert query(path, "select count(*) from points") == [(4,)]
    assert query(path, "select node, text from events") == [("winder", "winder is down, was suspect")]
    [(moment,)] = query(path, "select max(time) from samples")
    assert abs(moment - time.time()) < 5


def test_it_goes_on_with_a_file_of_its_own_and_leaves_another_alone(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    for number in (1, 2):
        with recording(path) as output:
            output.offer(cycle(number, 1.0))
    assert query(path, "select count(*) from samples") == [(2,)]
    other = tmp_path / "other.db"
    with closing(sqlite3.connect(other)) as database:
        database.execute("create table points (mine)")
    with recording(other) as output:
        output.offer(cycle(1, 1.0))
        until(lambda: "is a database of something else" in output.statistics().error)
    assert query(other, "select count(*) from sqlite_master") == [(1,)]
    assert output.dropped == 1


def test_what_another_program_locks_out_is_written_when_the_lock_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sqlite, "BUSY", 0.0)
    path = tmp_path / "x.db"
    with recording(path) as output:
        output.offer(cycle(1, 1.0))
        until(lambda: settled(output))
        with closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("begin exclusive")
            output.offer(cycle(2, 2.0, 3.0))
            until(lambda: "locked" in output.statistics().error)
            other.execute("rollback")
        output._retry = 0.01
    assert [value for (value,) in query(path, "select value from samples order by rowid")] == [1.0, 2.0, 3.0]
    assert output.statistics().dropped == 0


def test_what_is_too_old_is_deleted_from_the_oldest_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.db"
    now = time.monotonic()
    with recording(path) as output:
        for number in range(6):
            output.offer(cycle(number, number, at=now - (5 - number) * DAY))
    monkeypatch.setattr(sqlite, "CLEANED_AT_ONCE", 2)
    for left in ([2, 3, 4, 5, 9], [3, 4, 5, 9, 9]):
        with recording(path, keep_days=2.5) as output:
            output.offer(cycle(9, 9))
        assert [value for (value,) in query(path, "select value from samples order by rowid")] == left
