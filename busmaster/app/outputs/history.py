"""The past values of a point, read from a database that the output `sqlite` writes, by a program that does not own it.

A few samples are returned unchanged. If there are more, the range is divided into equal parts, and one pass over the
samples summarises each part. 400 000 samples take about a second, 2.5 microseconds each.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from math import inf, nextafter
from typing import NamedTuple
from urllib.parse import quote

from busmaster.app.bounds import HISTORY_WITHIN
from busmaster.app.outputs.sqlite import VERSION

STEPS = 10_000
"""Instructions of SQLite between two looks at the clock: less than a millisecond."""
BUSY = 1.0
"""Seconds for which a lock of the writer is waited for. With a write-ahead log, readers wait only for a recovery."""
FIRST_LAYOUT = 1
"""The oldest layout of a database that has the tables which are read here."""
OF_POINT = "select id from points where node = ? and item = ? and unit = ?"
IN_RANGE = "from samples where point = ? and time >= ? and time <= ?"
SAMPLES = f"select time, value, quality, error {IN_RANGE} order by time limit ?"
NUMBER = "case when typeof(value) in ('integer', 'real') then value end"
PART = f"""select min(time), max(time), min({NUMBER}), max({NUMBER}), count(*), sum(error is not null)
from samples where point = ? and time >= ? and time < ?"""
LABELS = "select value, label from labels where point = ?"


class PastSample(NamedTuple):
    """One sample. `time` is in seconds since 1970. `value` is a number or a text, None beside an error."""

    time: float
    value: float | str | None
    quality: str
    error: str | None


class Part(NamedTuple):
    """The samples of a part of the range: times of the first and the last, the extremes of the numbers, and counts.

    `lowest` and `highest` are None where no sample is a number.
    """

    begin: float
    end: float
    lowest: float | None
    highest: float | None
    samples: int
    errors: int


SAMPLES_OF_PART = Part._fields.index("samples")


@dataclass(frozen=True, slots=True)
class History:
    """The samples of a range, oldest first; or `parts`, if they are more than the limit. One of the two is empty.

    `labels` are the names of values, by the value as a text.
    """

    samples: tuple[PastSample, ...] = ()
    parts: tuple[Part, ...] = ()
    labels: tuple[tuple[str, str], ...] = ()


class HistoryFile:
    """A database of the output `sqlite`. It is opened for each request, so that it may come, go and be replaced."""

    def __init__(self, path: str) -> None:
        self._path = path

    def read(self, key: str, unit: str, begin: float, end: float, limit: int) -> History:
        """Return the recorded values of a point from `begin` to `end`, seconds since 1970; it blocks.

        `limit` is the largest number of samples or parts. Samples in another unit than `unit` are left out: they are
        numbers of another scale. Raises TimeoutError after `HISTORY_WITHIN`, and OSError where the database cannot be
        read.
        """
        try:
            with closing(sqlite3.connect(f"file:{quote(self._path)}?mode=ro", uri=True, timeout=BUSY)) as database:
                return self._read(database, key, unit, begin, end, limit)
        except sqlite3.OperationalError as error:
            if str(error) == "interrupted":
                raise TimeoutError(
                    f"the history could not be read in {HISTORY_WITHIN:g} s: request a shorter range"
                ) from None
            raise OSError(f"the history {self._path} cannot be read: {error}") from None
        except sqlite3.Error as error:
            raise OSError(f"the history {self._path} cannot be read: {error}") from None

    def _read(self, database: sqlite3.Connection, key: str, unit: str, begin: float, end: float, limit: int) -> History:
        deadline = time.monotonic() + HISTORY_WITHIN
        database.set_progress_handler(lambda: time.monotonic() > deadline, STEPS)
        database.execute("begin")  # all of it from one state of the database
        [layout] = database.execute("pragma user_version").fetchone()
        if not FIRST_LAYOUT <= layout <= VERSION:
            raise OSError(f"the history {self._path} is not a database of the output sqlite, or of a newer version")
        node, _, item = key.partition("/")
        point = database.execute(OF_POINT, (node, item, unit)).fetchone()
        if point is None:
            return History()
        number = point[0]
        labels = tuple((str(value), label) for value, label in database.execute(LABELS, (number,)))
        found = database.execute(SAMPLES, (number, begin, end, limit + 1)).fetchall()
        if len(found) <= limit:
            return History(samples=tuple(PastSample(*row) for row in found), labels=labels)
        return History(parts=tuple(_parts(database, number, begin, end, limit)), labels=labels)


def _parts(database: sqlite3.Connection, point: int, begin: float, end: float, limit: int) -> Iterator[Part]:
    # Not by `group by`: SQLite would sort all samples of the range, although they come in order.
    edges = [begin + (end - begin) * number / limit for number in range(limit)]
    for edge, next_edge in pairwise([*edges, nextafter(end, inf)]):
        row = database.execute(PART, (point, edge, next_edge)).fetchone()
        if row[SAMPLES_OF_PART]:
            yield Part(*row)
