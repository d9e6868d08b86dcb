"""The embedded default."""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from busmaster.app.outputs import retention, sqlite
from busmaster.app.outputs.base import Happening
from busmaster.app.outputs.damaged import is_damaged
from busmaster.app.outputs.retention import DAY, Retention
from busmaster.app.outputs.settings import SqliteSettings
from busmaster.app.outputs.sqlite import DATED, SqliteOutput, column
from busmaster.app.service.record import Outcome, WriteRecord
from busmaster.bus.meaning import Meaning
from busmaster.bus.snapshots import Snapshot
from busmaster.errors import InvalidCommand, NoReply
from busmaster.protocols.msc.status import ProgramStatus
from tests.app.outputs.cycles import cycle, settled, until
from tests.patience import PATIENCE

REFUSED = WriteRecord(0.0, "mqtt", "line/set/x", "op", 17, "x", None, 2, Outcome.REFUSED, 900 * "x", 0.0, "")


def test_a_column_holds_whatever_a_value_is() -> None:
    values = (None, 1, 1.5, "text", True, float("nan"), ProgramStatus(65), frozenset({2, 1}), {"a": 1})
    assert [column(value) for value in values] == [None, 1, 1.5, "text", 1, None, 65, "[1, 2]", "{'a': 1}"]
    assert [column(value) for value in (2**63 - 1, 2**63, -(2**63) - 1)] == [2**63 - 1, 2.0**63, -(2.0**63)]
    assert type(column(2**63)) is float
    assert type(column(1 - 2**63)) is int, "it is exact"


@contextmanager
def recording(path: Path, keep_days: float | None = None, keep_mb: float | None = None) -> Iterator[SqliteOutput]:
    output = SqliteOutput("sqlite", SqliteSettings(path=str(path), keep_days=keep_days, keep_mb=keep_mb))
    output._retry = 0.01
    output.start()
    try:
        yield output
    finally:
        output.close(PATIENCE)


def query(path: Path, text: str) -> list[Any]:
    with closing(sqlite3.connect(path)) as database:
        return database.execute(text).fetchall()


def test_values_events_and_errors_are_there_under_their_names(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    with recording(path) as output:
        output.offer(cycle(1, 12.5, 3, (1, 2), NoReply("no reply")))
        output.offer(cycle(2, 13.5, 4, (3, 4), 5.0))
        output.offer(Happening(time.time(), "winder", "winder is down, was suspect"))
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
    with recording(path) as output:
        output.offer(Happening(time.time(), "", "the line is lost"))
    assert query(path, "select node from events where text = 'the line is lost'") == [(None,)]
    [(moment,)] = query(path, "select max(time) from samples")
    assert abs(moment - time.time()) < PATIENCE


OF_0_2 = """
create table points (
    id integer primary key, node text not null, item text not null, unit text not null, unique (node, item, unit)
);
create table samples (
    time real not null, point integer not null references points (id), value, quality text not null, error text
);
create table events (time real not null, node text, text text not null);
create table audit (
    time real not null, door text not null, by text not null, user text not null, process integer not null,
    point text not null, before, value, outcome text not null, error text, took real not null, id text
);
insert into points values (1, 'n', 'p', '');
insert into samples values (5.0, 1, 7, 'good', null);
insert into audit values (5.0, 'mqtt', 'topic', 'op', 17, 'n/p', null, 3, 'written', '', 0.01, '');
pragma user_version = 1;
"""


def test_a_database_of_0_2_is_continued_with_all_that_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    with closing(sqlite3.connect(path)) as database:
        database.executescript(OF_0_2)
    with recording(path) as output:
        output.offer(cycle(1, 1.0))
        output.offer(REFUSED)
    assert query(path, "pragma user_version") == [(sqlite.VERSION,)]
    assert query(path, "select interface, point, value, outcome from audit order by time desc") == [
        ("mqtt", "n/p", 3, "written"),
        ("mqtt", "x", 2, "refused"),
    ]
    assert query(path, "select count(*) from history") == [(2,)]


@pytest.mark.parametrize("version", [sqlite.VERSION + 1, 99])
def test_a_database_of_a_newer_version_is_left_alone_and_the_error_says_what_to_do(
    tmp_path: Path, version: int
) -> None:
    path = tmp_path / "x.db"
    with closing(sqlite3.connect(path)) as database:
        database.executescript(OF_0_2)
        database.execute(f"pragma user_version = {version}")
        before = list(database.iterdump())
    with recording(path) as output:
        output.offer(cycle(1, 1.0))
        until(lambda: f"has the layout {version}" in output.statistics().error)
        assert "upgrade if it is of a newer version, or use another path" in output.statistics().error
    with closing(sqlite3.connect(path)) as database:
        assert list(database.iterdump()) == before
    assert output.dropped == 1


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
        until(lambda: "is a database of another program" in output.statistics().error)
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


def test_a_point_that_came_first_in_a_batch_that_failed_is_there_with_the_next_try(tmp_path: Path) -> None:
    """Its number was that of a transaction which was undone, and may be another point's by now."""
    path = tmp_path / "x.db"
    on = Meaning(labels={2: "on"})
    with recording(path) as output:
        output.offer(cycle(1, 1.0))
        until(lambda: settled(output))
        with closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("create trigger full before insert on samples begin select raise(abort, 'full'); end")
            found = cycle(2, 1.5, 2)
            samples = {
                replace(point, meaning=on): sample._replace(value=on.named(sample.value))
                if sample.value == 2
                else sample
                for point, sample in found.samples.items()
            }
            output.offer(replace(found, samples=samples))
            until(lambda: output.statistics().error.endswith("full"))
            other.execute("begin immediate")
            other.execute("insert into points (node, item, unit) values ('another', 'program', '')")
            other.execute("drop trigger full")
            other.execute("commit")
    found_rows = query(path, "select node, item, value, label from history order by time, item")
    assert found_rows == [("5", "1", 1.0, None), ("5", "1", 1.5, None), ("5", "2", 2, "on")]


def test_what_is_too_old_is_deleted_from_the_oldest_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.db"
    now = time.monotonic()
    with recording(path) as output:
        for number in range(6):
            output.offer(cycle(number, number, at=now - (5 - number) * DAY))
            output.offer(Happening(time.time() - (5 - number) * DAY, "winder", f"event {number}"))
    monkeypatch.setattr(retention, "AT_ONCE", 2)
    for left in ([2, 3, 4, 5, 9], [3, 4, 5, 9, 9]):
        with recording(path, keep_days=2.5) as output:
            output.offer(cycle(9, 9))
        assert [value for (value,) in query(path, "select value from samples order by rowid")] == left
    assert query(path, "select text from events order by rowid") == [("event 3",), ("event 4",), ("event 5",)]


def test_a_database_above_its_limit_in_megabytes_forgets_the_oldest(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    with recording(path, keep_mb=0.001) as output:  # less than an empty one has
        for number in range(3):
            output.offer(cycle(number, number))
            until(lambda: settled(output))
    assert query(path, "select value from samples") == [(2,)]


def test_why_nothing_is_deleted_is_reported_by_the_output(tmp_path: Path) -> None:
    path, reported = tmp_path / "x.db", list[str]()
    with recording(path) as output:
        output.offer(cycle(1, 1.0, at=time.monotonic() - 10 * DAY))
    output = SqliteOutput("sqlite", SqliteSettings(path=str(path), keep_days=2), reported.append)
    output.start()
    output.offer(cycle(2, 2.0))
    output.close(PATIENCE)
    assert reported == ["sqlite: by the clock all values are older than 2 days; nothing is deleted for a day"]
    assert query(path, "select value from samples order by time") == [(1.0,), (2.0,)]


class Clocks:
    """Clocks that are set by hand."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wall, self.steady = 1_800_000_000.0, 5_000.0
        monkeypatch.setattr(retention, "time", self)

    def time(self) -> float:
        return self.wall

    def monotonic(self) -> float:
        return self.steady

    def run(self, seconds: float) -> None:
        self.wall += seconds
        self.steady += seconds


def database_of(*times: float) -> sqlite3.Connection:
    database = sqlite3.connect(":memory:")
    database.executescript(";".join(f"create table {table} (time real)" for table in DATED))
    database.executemany("insert into samples values (?)", [(moment,) for moment in times])
    return database


def left_in(database: sqlite3.Connection, table: str = "samples") -> int:
    [count] = database.execute(f"select count(*) from {table}").fetchone()
    return int(count)


def test_a_clock_that_was_set_ahead_deletes_nothing_for_a_day(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks, told = Clocks(monkeypatch), list[str]()
    database = database_of(*(clocks.wall - hour * 3600 for hour in range(10)))
    keeping = Retention(30, None, told.append)
    keeping.apply(database, DATED)
    clocks.wall += 365 * DAY
    for _ in range(23):
        clocks.run(3600)
        keeping.apply(database, DATED)
        assert left_in(database) == 10
    assert told == ["the clock was set by +31536000 s; nothing is deleted for a day"]
    clocks.wall -= 365 * DAY  # and back again, before anything was lost
    for _ in range(48):
        clocks.run(3600)
        keeping.apply(database, DATED)
    assert left_in(database) == 10
    clocks.run(30 * DAY)
    keeping.apply(database, DATED)
    assert left_in(database) == 0


def test_a_clock_that_was_set_back_is_reported_once_and_not_trusted_for_a_day(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks, told = Clocks(monkeypatch), list[str]()
    database = database_of(clocks.wall)
    keeping = Retention(1, None, told.append)
    keeping.apply(database, DATED)
    clocks.run(DAY)
    clocks.wall -= 3600
    for _ in range(3):
        keeping.apply(database, DATED)
        clocks.run(2 * 3600)
    assert told == ["the clock was set by -3600 s; nothing is deleted for a day"]
    assert left_in(database) == 1
    clocks.run(DAY)
    keeping.apply(database, DATED)
    assert left_in(database) == 0


def test_a_limit_in_megabytes_applies_while_the_clock_is_not_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks, told = Clocks(monkeypatch), list[str]()
    database = database_of(*(clocks.wall - 100 + number for number in range(100)))
    keeping = Retention(1, 0.5, told.append)
    monkeypatch.setattr(retention, "used", lambda _: 1_000_000)
    keeping.apply(database, DATED)
    assert left_in(database) == 90
    clocks.wall += 365 * DAY
    keeping.apply(database, DATED)
    assert told == ["the clock was set by +31536000 s; nothing is deleted for a day"]
    assert left_in(database) == 81


def test_the_clock_is_right_if_any_table_has_new_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks, told = Clocks(monkeypatch), list[str]()
    database = database_of(clocks.wall - 365 * DAY)
    database.execute("insert into events values (?)", (clocks.wall - 60,))
    Retention(30, None, told.append).apply(database, DATED)
    assert told == []
    assert (left_in(database), left_in(database, "events")) == (0, 1)


def test_while_nothing_is_too_old_it_is_looked_for_once_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks(monkeypatch)
    database = database_of(clocks.wall - DAY + 10)
    keeping = Retention(1, None)
    left = []
    for _ in range(3):
        keeping.apply(database, DATED)
        left.append(left_in(database))
        clocks.run(retention.EVERY / 2)
    assert left == [1, 1, 0]


def test_with_the_oldest_of_the_largest_table_the_older_rows_of_others_go(monkeypatch: pytest.MonkeyPatch) -> None:
    database = database_of(*range(5))
    database.executemany("insert into audit values (?)", [(moment,) for moment in range(50)])
    database.executemany("insert into events values (?)", [(4,), (5,), (6,)])
    retention.forget_oldest(database, DATED)
    assert [left_in(database, table) for table in ("audit", "samples", "events")] == [45, 0, 2]


def test_a_limit_in_megabytes_counts_the_pages_that_are_in_use() -> None:
    database = sqlite3.connect(":memory:")
    database.executescript(
        "create table samples (time real, value); create table events (time); create table audit (time)"
    )
    rows = [(number, 1000 * "x") for number in range(1_500)]
    database.executemany("insert into samples values (?, ?)", rows)
    keeping = Retention(None, 1.5)
    counts = []
    for _ in range(6):
        keeping.apply(database, DATED)
        counts.append(left_in(database))
    assert counts[0] == 1350
    assert counts[-1] == counts[-2] > 1000
    assert 1_300_000 < retention.used(database) <= 1_500_000


def test_a_start_with_a_wrong_clock_deletes_nothing_for_a_day(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks, told = Clocks(monkeypatch), list[str]()
    database = database_of(clocks.wall - 365 * DAY)
    keeping = Retention(30, None, told.append)
    keeping.apply(database, DATED)
    assert left_in(database) == 1
    assert told == ["by the clock all values are older than 30 days; nothing is deleted for a day"]
    clocks.run(DAY + 1)
    keeping.apply(database, DATED)
    assert left_in(database) == 0


def test_what_is_kept_holds_at_any_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two thousand values a batch, twenty batches a second: what is older than its limit goes as fast as it comes."""
    clocks = Clocks(monkeypatch)
    monkeypatch.setattr(retention, "AT_ONCE", 200)
    database = database_of()
    keeping = Retention(60 / DAY, None)
    for _ in range(3 * 60 * 20):
        database.executemany("insert into samples values (?)", [(clocks.wall,)] * 20)
        keeping.apply(database, DATED)
        clocks.run(0.05)
    assert left_in(database) <= 20 * (2 * 60 * 20 + 10)


@pytest.mark.parametrize("limit", [0, -1.0, float("inf"), float("nan")])
@pytest.mark.parametrize("name", ["keep_days", "keep_mb"])
def test_a_limit_of_nothing_or_without_an_end_is_refused(name: str, limit: float) -> None:
    given: dict[str, Any] = {name: limit}
    with pytest.raises(InvalidCommand, match=f"{name} must be more than 0, not {limit}"):
        SqliteSettings(path="x.db", **given)


@pytest.mark.parametrize(("rows", "gone"), [(1, 1), (5, 1), (100, 10), (3_000, 200)])
def test_at_once_a_tenth_is_forgotten_and_never_more_than_a_piece(
    monkeypatch: pytest.MonkeyPatch, rows: int, gone: int
) -> None:
    monkeypatch.setattr(retention, "AT_ONCE", 200)
    database = database_of(*range(rows))
    retention.forget_oldest(database, DATED)
    assert left_in(database) == rows - gone
    assert database.execute("select min(time) from samples").fetchone() == (gone if gone < rows else None,)


@pytest.mark.slow
def test_a_limit_in_megabytes_forgets_the_oldest_and_the_events_of_that_time(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    now = time.monotonic()
    with recording(path, keep_mb=0.5) as output:
        output.offer(Happening(time.time() - 2000, "winder", "long ago"))
        for number in range(1000):
            output.offer(cycle(number, *range(40), at=now - 1000 + number))
            if number % 40 == 0:
                until(lambda: settled(output))
    assert path.stat().st_size < 3_000_000
    [(first, last)] = query(path, "select min(time), max(time) from samples")
    assert abs(last - time.time()) < 60
    assert first > time.time() - 990
    assert query(path, "select count(*) from events") == [(0,)]


@pytest.mark.slow
def test_a_limit_in_megabytes_holds_where_hardly_anything_but_refused_commands_comes(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    with recording(path, keep_mb=0.5) as output:
        output.offer(cycle(1, 1.0))
        for number in range(5_000):
            output.offer(REFUSED._replace(id=str(number), time=time.time()))
            if number % 100 == 0:
                until(lambda: settled(output))
        until(lambda: settled(output))
        output.offer(cycle(2, 2.0))
    assert path.stat().st_size < 3_000_000
    [(kept, last)] = query(path, "select count(*), max(cast(id as integer)) from audit")
    assert kept > 50
    assert last == 4_999
    assert query(path, "select value from samples") == [(2,)]


def in_unit(value: float, unit: str) -> Snapshot:
    """A cycle of one point, as its unit is now."""
    snapshot = cycle(1, value)
    return replace(snapshot, samples={replace(point, unit=unit): sample for point, sample in snapshot.samples.items()})


def test_what_was_read_keeps_the_unit_that_it_was_read_in(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    for value, unit in ((1500, "mm"), (1.5, "m"), (1600, "mm")):
        with recording(path) as output:
            output.offer(in_unit(value, unit))
    assert query(path, "select value, unit from history order by time") == [(1500, "mm"), (1.5, "m"), (1600, "mm")]


def test_a_database_in_which_a_point_had_one_unit_goes_on_with_what_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    old = sqlite.SCHEMA.replace("unique (node, item, unit)", sqlite.ONE_ROW_A_POINT)
    with closing(sqlite3.connect(path)) as database:
        database.executescript(old)
        database.execute("pragma user_version = 1")
        database.execute("insert into points values (7, '5', '1', 'mm')")
        database.execute("insert into samples values (1, 7, 1500, 'good', null)")
        database.commit()
    with recording(path) as output:
        output.offer(in_unit(1.5, "m"))
        output.offer(in_unit(1600, "mm"))
    assert query(path, "select value, unit from history order by time") == [(1500, "mm"), (1.5, "m"), (1600, "mm")]
    assert query(path, "select count(*) from points") == [(2,)]


def test_a_new_file_is_for_its_owner_and_group(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    with recording(path) as output:
        output.offer(cycle(1, 1.0))
    assert path.stat().st_mode & 0o007 == 0


def test_a_new_database_has_the_mode_of_its_settings(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    before = os.umask(0)
    try:
        output = SqliteOutput("sqlite", SqliteSettings(path=str(path), mode=0o604))
        output.start()
        output.offer(cycle(1, 1.0))
        output.close(PATIENCE)
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o604


@pytest.mark.parametrize("endings", [("",), ("", "-wal", "-shm")])
def test_a_database_that_was_moved_keeps_what_it_has_and_another_is_begun(
    tmp_path: Path, endings: tuple[str, ...]
) -> None:
    path, aside = tmp_path / "x.db", tmp_path / "old.db"
    said: list[str] = []
    with recording(path) as output:
        output._report_event = said.append
        output.offer(cycle(1, 1.0))
        until(lambda: settled(output))
        for ending in endings:
            Path(f"{path}{ending}").rename(f"{aside}{ending}")
        output.offer(cycle(2, 2.0))
        until(lambda: settled(output))
    assert query(aside, "select value from samples") == [(1.0,)]
    assert query(path, "select value from samples") == [(2.0,)]
    assert said == [f"{path} was moved or removed; a new file was started"]


def test_a_database_that_was_removed_is_begun_anew(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    with recording(path) as output:
        output.offer(cycle(1, 1.0))
        until(lambda: settled(output))
        path.unlink()
        output.offer(cycle(2, 2.0))
        until(lambda: settled(output))
    assert query(path, "select value from samples") == [(2.0,)]
    assert query(path, "pragma integrity_check") == [("ok",)]


def test_the_log_of_a_damaged_database_that_a_reader_has_open_goes_with_it(tmp_path: Path) -> None:
    """SQLite deletes the log when the last connection closes: with a reader it stays, and belongs to the old file."""
    path = tmp_path / "x.db"
    with recording(path) as output:
        output.offer(cycle(1, 1.0))
    with closing(sqlite3.connect(path)) as reader:
        assert reader.execute("select value from samples").fetchall() == [(1.0,)]
        assert (tmp_path / "x.db-wal").exists()
        with path.open("r+b") as file:
            file.write(bytes(4096))
        with recording(path) as output:
            output.offer(cycle(2, 2.0))
            until(lambda: settled(output))
            assert (tmp_path / "x.db.damaged-wal").exists()
            assert (tmp_path / "x.db.damaged-shm").exists()
            assert query(path, "select value from samples") == [(2.0,)]


def test_a_damaged_database_is_moved_aside_and_a_new_one_begun(tmp_path: Path) -> None:
    """First where its header is not one, at the start; then in its midst, while it is written."""
    path = tmp_path / "x.db"
    said: list[str] = []
    with recording(path) as output:
        output.offer(cycle(1, 1.0))
    with path.open("r+b") as file:  # as a loss of power leaves it
        file.write(bytes(4096))
    output = SqliteOutput("sqlite", SqliteSettings(path=str(path)), said.append)
    output._retry = 0.01
    output.start()
    try:
        output.offer(cycle(2, 2.0))
        until(lambda: settled(output))
        assert (tmp_path / "x.db.damaged").read_bytes().startswith(bytes(4096))
        with closing(sqlite3.connect(path)) as database:
            database.execute("pragma wal_checkpoint(truncate)").fetchall()
        with path.open("r+b") as file:
            file.seek(4096)
            file.write(b"\xff" * (path.stat().st_size - 4096))
        output.reopen()
        output.offer(cycle(3, 3.0))
        until(lambda: len(said) == 2)
        output.offer(cycle(4, 4.0))
        until(lambda: settled(output))
    finally:
        output.close(PATIENCE)
    assert output.statistics().dropped == 0
    assert [value for (value,) in query(path, "select value from samples order by rowid")] == [3.0, 4.0]
    assert said[0].startswith(f"sqlite: {path} is damaged (file is not a database); ")
    assert said[0].endswith(f"it was moved to {path}.damaged, and a new file was started")
    assert said[1].endswith(f"it was moved to {path}.damaged-2, and a new file was started")
    assert (tmp_path / "x.db.damaged").read_bytes().startswith(bytes(4096))


@pytest.mark.parametrize(
    ("code", "damaged"),
    [
        (sqlite3.SQLITE_CORRUPT, True),
        (sqlite3.SQLITE_CORRUPT_INDEX, True),
        (sqlite3.SQLITE_NOTADB, True),
        (sqlite3.SQLITE_BUSY, False),
        (sqlite3.SQLITE_BUSY_SNAPSHOT, False),
        (sqlite3.SQLITE_FULL, False),
        (None, False),
    ],
)
def test_only_a_file_whose_content_is_wrong_is_damaged(code: int | None, damaged: bool) -> None:
    error = sqlite3.DatabaseError("x")
    if code is not None:
        error.sqlite_errorcode = code
    assert is_damaged(error) is damaged


def test_a_database_that_is_closed_leaves_no_file_open(tmp_path: Path) -> None:
    before = len(os.listdir("/proc/self/fd"))
    for number in range(3):
        with recording(tmp_path / "x.db") as output:
            output.offer(cycle(number, 1.0))
    assert len(os.listdir("/proc/self/fd")) == before


def named(number: int, label: str) -> Snapshot:
    """A cycle with one value that has a label."""
    found, means = cycle(number, 2), Meaning(labels={2: label})
    return replace(found, samples={of: sample._replace(value=means.named(2)) for of, sample in found.samples.items()})


def test_a_new_file_has_the_labels_and_the_times_of_its_values(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    with recording(path) as output:
        for number in (1, 2):
            found = named(number, "on")
            samples = {point: sample._replace(wall=5.0 + number) for point, sample in found.samples.items()}
            output.offer(replace(found, samples=samples))
            until(lambda: settled(output))
            if number == 1:
                for file in tmp_path.glob("x.db*"):
                    file.unlink()
    assert query(path, "select time, value, label from history") == [(7.0, 2, "on")]


def test_a_label_that_is_changed_is_kept_as_it_was_last(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    with recording(path) as output:
        for label in ("on", "running"):
            output.offer(named(1, label))
            until(lambda: settled(output))
    assert query(path, "select value, label from labels") == [(2, "running")]
