"""Items on disk for a destination that is down: the oldest first, bounded, and kept over a restart.

One SQLite file, held by one process, opened and used by one thread of it. Items survive the end of the process at once.
A loss of power can lose the last seconds, and nothing else.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterable
from typing import NamedTuple

from busmaster import InvalidCommand
from busmaster.app.outputs.damaged import is_damaged, move_aside
from busmaster.ext import MODE, open_file

PIECE = 1_000
"""Records that are forgotten at once."""


class Record(NamedTuple):
    """The text of one message or batch, and the number of its values."""

    content: str
    values: int


class Spool:
    """Holds at most `most` values for one kind of output.

    Raises InvalidCommand if it cannot be created, if another process has it, and for a file with other contents.
    `report` is called if an existing file is damaged, which is moved aside and not deleted. With `strict`, items
    survive a loss of power at once.
    """

    def __init__(
        self,
        path: str,
        most: int,
        kind: str,
        report: Callable[[str], None] = lambda _: None,
        *,
        mode: int = MODE,
        strict: bool = False,
    ) -> None:
        self.path = path
        self._most = most
        try:
            try:
                self._database = _opened(path, kind, mode, strict)
            except sqlite3.DatabaseError as error:
                if not is_damaged(error):  # for example held by another process
                    raise
                aside = move_aside(path)
                report(f"{path}: {error}: it is kept as {aside}, and begun anew")
                self._database = _opened(path, kind, mode, strict)
            self.values: int = self._database.execute("select coalesce(sum(count), 0) from waiting").fetchone()[0]
        except sqlite3.OperationalError as error:
            hint = "; does another process use it?" if "locked" in str(error) else ""
            raise InvalidCommand(f"{path}: {error}{hint}") from None
        except (sqlite3.Error, OSError) as error:
            raise InvalidCommand(f"{path}: {error}") from None

    def put(self, records: Iterable[Record]) -> int:
        """Add to the end, all or none, and return how many of the oldest values had to go. Raises sqlite3.Error."""
        rows = list(records)
        values = self.values + sum(record.values for record in rows)
        lost = 0
        with self._database as database:
            database.executemany("insert into waiting (content, count) values (?, ?)", rows)
            while values - lost > self._most:
                lost += self._forget(values - lost - self._most)
        self.values = values - lost
        return lost

    def oldest(self, records: int) -> tuple[int, list[Record]]:
        """Return the oldest records, and up to where `remove` forgets them. Raises sqlite3.Error."""
        query = "select content, count, id from waiting order by id limit ?"
        rows = self._database.execute(query, (records,)).fetchall()
        return (rows[-1][2] if rows else 0), [Record(content, count) for content, count, _ in rows]

    def remove(self, up_to: int, values: int) -> None:
        """Delete delivered items. Raises sqlite3.Error."""
        with self._database as database:
            database.execute("delete from waiting where id <= ?", (up_to,))
        self.values -= values

    def close(self) -> None:
        """Close the file; its items stay there."""
        self._database.close()

    def _forget(self, values: int) -> int:
        """Remove the oldest records that hold at least so many values, or a PIECE of them."""
        gone, up_to = 0, 0
        query = "select id, count from waiting order by id limit ?"
        for number, count in self._database.execute(query, (PIECE,)).fetchall():
            gone, up_to = gone + count, number
            if gone >= values:
                break
        self._database.execute("delete from waiting where id <= ?", (up_to,))
        return gone


def _opened(path: str, kind: str, mode: int, strict: bool) -> sqlite3.Connection:
    os.close(open_file(path, os.O_RDWR, mode))  # SQLite would make it with a mode of its own
    database = sqlite3.connect(path, timeout=0.0)  # nothing to wait for: who has it keeps it
    try:
        _check_kind(path, database, kind)
        synchronous = f"synchronous = {'full' if strict else 'normal'}"
        for setting in ("locking_mode = exclusive", "journal_mode = wal", synchronous):
            database.execute(f"pragma {setting}").fetchall()
        with database:
            database.execute("create table if not exists spool (kind text)")
            database.execute("insert into spool select ? where not exists (select * from spool)", (kind,))
            database.execute(
                "create table if not exists waiting (id integer primary key autoincrement, content text, count integer)"
            )
    except BaseException:
        database.close()
        raise
    return database


def _check_kind(path: str, database: sqlite3.Connection, kind: str) -> None:
    """Raise InvalidCommand for a file that is not empty and no spool of this kind of output."""
    tables = {name for [name] in database.execute("select name from sqlite_master where type = 'table'")}
    if tables and "spool" not in tables:
        raise InvalidCommand(f"{path} is a database of another program; use a separate file for stored values")
    row = database.execute("select kind from spool").fetchone() if tables else None
    if row is not None and row[0] != kind:
        raise InvalidCommand(f"{path} contains the stored values of {row[0]}; use another file for {kind}")
