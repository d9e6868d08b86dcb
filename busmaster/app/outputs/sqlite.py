"""SQLite: the embedded default. Points, samples and events in one file that any tool reads while it grows.

select * from history where node = 'winder' and item = 'position' and time > unixepoch('now', '-1 hour')
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeAlias

from busmaster import InvalidCommand
from busmaster.app.outputs.base import Happening, Item, OutputKind, check_folder
from busmaster.app.outputs.batches import BatchOutput
from busmaster.app.outputs.damaged import is_damaged, move_aside
from busmaster.app.outputs.growing_file import is_at
from busmaster.app.outputs.retention import Retention
from busmaster.app.outputs.settings import SqliteSettings
from busmaster.app.service.record import WriteRecord
from busmaster.app.service.values import json_value, micros, write_fields
from busmaster.ext import Named, open_file

VERSION = 2
"""The layout of a database, which is stored in it (`user_version`). In 1, of 0.2, `interface` was `door`."""
SCHEMA = """
create table if not exists points (
    id integer primary key, node text not null, item text not null, unit text not null, unique (node, item, unit)
);
create table if not exists labels (
    point integer not null references points (id), value integer not null, label text not null,
    primary key (point, value)
);
create table if not exists samples (
    time real not null,       -- seconds since 1970
    point integer not null references points (id),
    value,                    -- a number; JSON for several; null where there is an error
    quality text not null,    -- good, late, overheard, stale or bad
    error text
);
create index if not exists samples_of_point on samples (point, time);
create index if not exists samples_by_time on samples (time);
create table if not exists events (time real not null, node text, text text not null);
create index if not exists events_by_time on events (time);
create table if not exists audit (
    time real not null,       -- seconds since 1970
    interface text not null,  -- mqtt, screen, ...
    by text not null,         -- the topic, the key
    user text not null, process integer not null,
    point text not null,
    before,                   -- null where it was not known
    value,
    outcome text not null,    -- written, refused, not started or unconfirmed
    error text,
    took real not null,       -- seconds
    id text                   -- the command's own
);
create index if not exists audit_by_time on audit (time);
create view if not exists history as
    select time, node, item, samples.value, unit, quality, error, label
    from samples join points on points.id = samples.point
    left join labels on labels.point = samples.point and labels.value = samples.value;
"""
ONE_ROW_A_POINT = "unique (node, item)"
"""Constraint of older databases, in which the present unit of a point applied to all earlier values too."""
REMADE = """
begin immediate;
drop view if exists history;
create table points_of_units (
    id integer primary key, node text not null, item text not null, unit text not null, unique (node, item, unit)
);
insert into points_of_units select id, node, item, unit from points;
drop table points;
alter table points_of_units rename to points;
commit;
"""
BUSY = 1.0
"""Seconds to wait for a lock of another program, before the batch is kept for later."""
DATED = ("samples", "events", "audit")
"""Tables whose rows are forgotten when they are too old."""

SampleRow: TypeAlias = tuple[float, int, Any, str, str | None]


class Rows(NamedTuple):
    """Of one cycle, one event, or one write.

    The number of a point is not known yet: a sample has its key and unit; and last the label of its value, "" for none.
    """

    samples: list[tuple[float, str, str, Any, str, str | None, str]]
    event: tuple[float, str | None, str] | None = None
    write: tuple[Any, ...] | None = None


class SqliteOutput(BatchOutput[Rows]):
    """A transaction a batch."""

    def __init__(
        self,
        kind: str,
        settings: SqliteSettings,
        report: Callable[[str], None] = lambda _: None,
    ) -> None:
        super().__init__(kind, settings, report)
        check_folder(settings.path)
        self._path = settings.path
        self._report_event: Callable[[str], None] = lambda text: report(f"{kind}: {text}")
        self._retention = Retention(settings.keep_days, settings.keep_mb, self._report_event)
        self._database: sqlite3.Connection | None = None
        self._file: int | None = None
        """The database's file, to see whether it is still where it was. Closed after it: closing gives up all locks."""
        self._numbers: dict[tuple[str, str], int] = {}
        """Of the rows of points, by the point's key and unit."""
        self._labels: dict[tuple[int, Any], str] = {}

    def format(self, item: Item) -> Rows:
        """Return the rows of one cycle or one event."""
        if isinstance(item, Happening):
            return Rows([], (item.time, item.node or None, item.text))
        if isinstance(item, WriteRecord):
            return Rows([], write=tuple(column(value) for value in write_fields(item).values()))
        samples = [
            (
                micros(sample.wall),
                point.key,
                point.unit,
                column(sample.value),
                sample.quality.value,
                sample.error.what if sample.error else None,
                sample.value.label if isinstance(sample.value, Named) else "",
            )
            for point, sample in self.unhurried(item)
        ]
        return Rows(samples)

    def commit(self, batch: list[Rows]) -> None:
        try:
            self._write(batch)
        except sqlite3.DatabaseError as error:
            if not is_damaged(error):
                raise
            self.shut()
            aside = move_aside(self._path)
            self._report_event(
                f"{self._path} is damaged ({error}); it was moved to {aside}, and a new file was started"
            )
            self._write(batch)

    def _write(self, batch: list[Rows]) -> None:
        if self._file is not None and not is_at(self._path, self._file):
            self._report_event(f"{self._path} was moved or removed; a new file was started")
            self._leave()
        database = self._open()
        # With "full" the log is on the disk when a transaction ends; with "normal", some time after that.
        database.execute(f"pragma synchronous = {'full' if self.must_sync else 'normal'}")
        with database:
            self._retention.apply(database, DATED)
            samples = list(self._samples(database, batch))
            database.executemany("insert into samples values (?, ?, ?, ?, ?)", samples)
            events = [rows.event for rows in batch if rows.event is not None]
            database.executemany("insert into events values (?, ?, ?)", events)
            writes = [rows.write for rows in batch if rows.write is not None]
            database.executemany(f"insert into audit values ({', '.join(12 * '?')})", writes)

    def pack(self, formatted: Rows) -> str:
        return json.dumps(formatted)

    def unpack(self, text: str) -> Rows:
        return Rows(*json.loads(text))

    def shut(self) -> None:
        if self._database is not None:
            self._database.close()
            self._database = None
        if self._file is not None:
            os.close(self._file)
            self._file = None
        self._numbers.clear()  # of a transaction that was undone, perhaps
        self._labels.clear()

    def _leave(self) -> None:
        """Let go of a database that is not here any more, with all that it was given in its one file."""
        try:
            if self._database is not None:
                self._database.execute("pragma wal_checkpoint(truncate)").fetchall()
        except sqlite3.Error:
            pass  # the disk is full: the rest stays in its log
        self.shut()

    def _samples(self, database: sqlite3.Connection, batch: list[Rows]) -> Iterator[SampleRow]:
        numbers = self._numbers
        for rows in batch:
            for moment, key, unit, value, quality, error, label in rows.samples:
                number = numbers.get((key, unit))
                if number is None:
                    number = numbers[key, unit] = number_of(database, key, unit)
                if label and self._labels.get((number, value)) != label:
                    self._labels[number, value] = label
                    database.execute("insert or replace into labels values (?, ?, ?)", (number, value, label))
                yield moment, number, value, quality, error

    def _open(self) -> sqlite3.Connection:
        if self._database is None:
            # SQLite would make the file with a mode of its own.
            self._file = open_file(self._path, os.O_RDWR, self._mode)
            database = self._database = sqlite3.connect(self._path, timeout=BUSY)
            [version] = database.execute("pragma user_version").fetchone()
            [tables] = database.execute("select count(*) from sqlite_master").fetchone()
            if tables and version > VERSION:
                raise InvalidCommand(
                    f"{self._path} has the layout {version}, but this version of busmaster writes {VERSION}; "
                    "upgrade if it is of a newer version, or use another path"
                )
            if tables and version < 1:  # an empty file has version 0 as well, and may be filled
                raise InvalidCommand(f"{self._path} is a database of another program; use another path")
            database.execute("pragma journal_mode = wal")  # others may read while it grows
            history = database.execute("select sql from sqlite_master where name = 'history'").fetchone()
            if history is not None and "label" not in history[0]:
                database.execute("drop view history")  # of a version before labels
            points = database.execute("select sql from sqlite_master where name = 'points'").fetchone()
            if points is not None and ONE_ROW_A_POINT in points[0]:
                database.executescript(REMADE)
            audit = database.execute("select name from pragma_table_info('audit') where name = 'door'").fetchone()
            if audit is not None:
                database.execute("alter table audit rename column door to interface")
            database.executescript(SCHEMA)
            database.execute(f"pragma user_version = {VERSION}")
        return self._database


def number_of(database: sqlite3.Connection, key: str, unit: str) -> int:
    """Return the number of a point's row, which is made if there is none. With another unit it is another row."""
    node, _, item = key.partition("/")
    row = database.execute(
        "insert into points (node, item, unit) values (?, ?, ?)"
        " on conflict (node, item, unit) do update set unit = excluded.unit returning id",
        (node, item, unit),
    ).fetchone()
    return int(row[0])


HIGHEST = 2**63 - 1
"""The highest whole number of SQLite."""


def column(value: Any) -> Any:
    """Return a value as SQLite can hold it: a number, a text or None; several values are JSON."""
    plain = json_value(value)
    if isinstance(plain, list):
        return json.dumps(plain)
    if isinstance(plain, int) and not -HIGHEST <= plain <= HIGHEST:
        return float(plain)  # sqlite3 raises OverflowError for it
    return plain if plain is None or isinstance(plain, int | float | str) else str(plain)


SQLITE = OutputKind(
    name="sqlite",
    settings=SqliteSettings,
    make=lambda settings, line: SqliteOutput("sqlite", settings, line.report),
    about="Values and events in a database: the tables points, samples and events, and the view history.",
    keeps_audit=True,
)
