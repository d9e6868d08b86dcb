"""What becomes of a damaged SQLite file: it is moved aside, not deleted, so that values can be recovered from it."""

from __future__ import annotations

import os
import sqlite3
from itertools import count

DAMAGED = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
"""SQLite's codes for a file whose content is wrong. A file that another process has locked, or a full disk, has others:
to move that file aside would lose nothing less than the data of a healthy database."""


def is_damaged(error: sqlite3.Error) -> bool:
    """Return whether the content of the file is wrong."""
    code = getattr(error, "sqlite_errorcode", None)  # errors of Python's own module have none
    return code is not None and code & 0xFF in DAMAGED


def move_aside(path: str) -> str:
    """Move a database out of the way, with the files that SQLite keeps beside it, and return its new name.

    The name is new: a file that was moved aside earlier stays. Raises OSError.
    """
    names = (f"{path}.damaged" if number == 1 else f"{path}.damaged-{number}" for number in count(1))
    aside = next(name for name in names if not os.path.lexists(name))
    for part in ("", "-wal", "-shm"):  # what a crash left beside it must not be played into the new one
        if os.path.exists(path + part):
            os.replace(path + part, aside + part)
    return aside
