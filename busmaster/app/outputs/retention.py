"""Deletes the oldest rows of a database, in pieces, and never because the clock was set."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable

DAY = 86_400.0
EVERY = 60.0
"""Seconds between two checks for old rows, while there are none."""
AT_ONCE = 20_000
"""Rows; so that no deletion holds the file for long. Ten times what one batch brings: it keeps up with any rate."""
STEADY = DAY
"""Seconds for which a clock that was set must have run evenly before anything is deleted by it."""
WAS_SET = 60.0
"""Largest drift between two clocks from one check to the next, in seconds. A larger one means that a clock was set."""
MEGABYTE = 1_000_000


class Retention:
    """Deletes rows older than `days`, and the oldest above `megabytes`; None for no such limit.

    A clock that was set is not trusted for a day: a clock that jumps a year ahead must not delete a year of values.
    Neither is a clock by which all rows would be too old, as at a start with a wrong clock.
    """

    def __init__(
        self, days: float | None, megabytes: float | None, report: Callable[[str], None] = lambda _: None
    ) -> None:
        self._days = days
        self._bytes = None if megabytes is None else megabytes * MEGABYTE
        self._report = report
        self._next = 0.0
        self._offset: float | None = None
        self._believed_from = 0.0

    def apply(self, database: sqlite3.Connection, tables: tuple[str, ...]) -> None:
        """Delete a piece, if there is anything to be deleted; more of it goes at the next call.

        Each table has a `time`.
        """
        clock, now = time.time(), time.monotonic()
        # The size needs no clock: this limit applies while the clock is not trusted, too.
        if self._bytes is not None and used(database) > self._bytes:
            forget_oldest(database, tables)
        if self._days is None:
            return
        trusted = self._trusts(database, tables, clock, now)
        if now < self._next or not trusted:
            return
        deleted = max(delete_older(database, table, clock - self._days * DAY) for table in tables)
        # After a full piece there is more: at a high rate one piece a minute would never keep up.
        self._next = now if deleted >= AT_ONCE else now + EVERY

    def _trusts(self, database: sqlite3.Connection, tables: tuple[str, ...], clock: float, now: float) -> bool:
        """Return whether the clock can be trusted. It is checked with every batch, so that no jump is missed."""
        offset = clock - now
        if self._offset is None:
            newest = max((newest_of(database, table) for table in tables), default=None, key=lambda t: t or 0.0)
            if newest is not None and self._days is not None and clock - newest > self._days * DAY:
                self._doubt(f"by the clock all values are older than {self._days:g} days", now)
        elif abs(offset - self._offset) > WAS_SET:
            self._doubt(f"the clock was set by {offset - self._offset:+.0f} s", now)
        self._offset = offset
        return now >= self._believed_from

    def _doubt(self, why: str, now: float) -> None:
        self._believed_from = now + STEADY
        self._report(f"{why}; nothing is deleted for a day")


def delete_older(database: sqlite3.Connection, table: str, moment: float) -> int:
    """Delete a piece of the rows older than a moment, the oldest first, and return the number of rows."""
    return database.execute(
        f"delete from {table} where rowid in (select rowid from {table} where time < ? order by time limit ?)",
        (moment, AT_ONCE),
    ).rowcount


def forget_oldest(database: sqlite3.Connection, tables: tuple[str, ...]) -> None:
    """Delete a piece of the oldest tenth of the largest table, and of the rows of other tables older than its rest."""
    spans = {table: span_of(database, table) for table in tables}
    largest = max(spans, key=lambda table: len(spans[table]))
    piece = min(AT_ONCE, (len(spans[largest]) + 9) // 10)
    database.execute(f"delete from {largest} where rowid < ?", (spans[largest].start + piece,))
    [oldest] = database.execute(f"select min(time) from {largest}").fetchone()
    for table in tables if oldest is not None else ():
        if table != largest:
            delete_older(database, table, oldest)


def span_of(database: sqlite3.Connection, table: str) -> range:
    """Return the numbers of a table's rows. Few are missing, because the oldest are deleted first."""
    first, last = database.execute(f"select min(rowid), max(rowid) from {table}").fetchone()
    return range(0) if first is None else range(first, last + 1)


def newest_of(database: sqlite3.Connection, table: str) -> float | None:
    """Return the time of the newest row, in seconds since 1970; None if there is none."""
    [newest] = database.execute(f"select max(time) from {table}").fetchone()
    return None if newest is None else float(newest)


def used(database: sqlite3.Connection) -> int:
    """Return the number of used bytes of the file. Free pages are used again before the file grows."""
    [[pages], [free], [size]] = (
        database.execute(f"pragma {name}").fetchone() for name in ("page_count", "freelist_count", "page_size")
    )
    return int((pages - free) * size)
