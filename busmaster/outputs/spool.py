"""Messages that wait on disk for whoever is away: the oldest first, bounded, and there again after a restart.

One SQLite file, held by one process. What was put in survives the end of the process at once; a loss of power may take
the last seconds of it, and nothing else.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterable
from typing import NamedTuple

from busmaster.errors import InvalidCommand
from busmaster.outputs.base import check_folder

PIECE = 1_000
"""Messages that are forgotten at once."""


class Record(NamedTuple):
    """One message, and how many values it holds."""

    topic: str
    payload: str
    retain: bool
    values: int


class Spool:
    """Holds at most `most` values. Raises InvalidCommand where it cannot be made, or where another process has it.

    `say` is told when a file was there that is none of ours: it is moved aside, not deleted.
    """

    def __init__(self, path: str, most: int, say: Callable[[str], None] = lambda _: None) -> None:
        check_folder(path)
        self.path = path
        self._most = most
        try:
            try:
                self._database = _opened(path)
            except sqlite3.OperationalError:
                raise
            except sqlite3.DatabaseError as error:
                aside = f"{path}.damaged"
                os.replace(path, aside)
                say(f"{path}: {error}: it is kept as {aside}, and begun anew")
                self._database = _opened(path)
            self.values: int = self._database.execute("select coalesce(sum(count), 0) from waiting").fetchone()[0]
        except (sqlite3.Error, OSError) as error:
            raise InvalidCommand(f"{path}: {error}; does another process use it?") from None

    def put(self, records: Iterable[Record]) -> int:
        """Add to the end, all or none, and return how many of the oldest values had to go. Raises sqlite3.Error."""
        rows = list(records)
        values = self.values + sum(record.values for record in rows)
        lost = 0
        with self._database as database:
            database.executemany("insert into waiting (topic, payload, retain, count) values (?, ?, ?, ?)", rows)
            while values - lost > self._most:
                lost += self._forget(values - lost - self._most)
        self.values = values - lost
        return lost

    def oldest(self, messages: int) -> tuple[int, list[Record]]:
        """Return the oldest messages, and up to where `remove` forgets them. Raises sqlite3.Error."""
        rows = self._database.execute(
            "select topic, payload, retain, count, id from waiting order by id limit ?", (messages,)
        ).fetchall()
        return (rows[-1][4] if rows else 0), [Record(topic, text, bool(keep), n) for topic, text, keep, n, _ in rows]

    def remove(self, up_to: int, values: int) -> None:
        """Forget what has arrived. Raises sqlite3.Error."""
        with self._database as database:
            database.execute("delete from waiting where id <= ?", (up_to,))
        self.values -= values

    def close(self) -> None:
        """Close the file; what it holds stays there."""
        self._database.close()

    def _forget(self, values: int) -> int:
        """Remove the oldest messages that hold at least so many values, or a PIECE of them."""
        gone, up_to = 0, 0
        query = "select id, count from waiting order by id limit ?"
        for number, count in self._database.execute(query, (PIECE,)).fetchall():
            gone, up_to = gone + count, number
            if gone >= values:
                break
        self._database.execute("delete from waiting where id <= ?", (up_to,))
        return gone


def _opened(path: str) -> sqlite3.Connection:
    os.close(os.open(path, os.O_CREAT | os.O_RDWR, 0o640))
    database = sqlite3.connect(path, timeout=0.0, check_same_thread=False)
    try:
        for setting in ("locking_mode = exclusive", "journal_mode = wal", "synchronous = normal"):
            database.execute(f"pragma {setting}").fetchall()
        with database:
            database.execute(
                "create table if not exists waiting"
                " (id integer primary key autoincrement, topic text, payload text, retain integer, count integer)"
            )
    except BaseException:
        database.close()
        raise
    return database
