"""The files of one capture: none that is there is overwritten, each is bounded, and so is their number."""

from __future__ import annotations

import io
import os
from collections import deque

from busmaster.files import open_file

SIZE = 100_000_000
"""Bytes after which the next file is begun: a busy line at 57600 baud writes some two gigabytes a day."""
COUNT = 10
"""Files of one capture that are kept."""


class CaptureFiles:
    """Writes to `path`; where that is taken, and when `size` bytes are in it, to `path` with -2, -3 and so on.

    A new file is for its owner and group. With more than `count` files of its own it removes its oldest. A device or a
    pipe is written to as it is. What could not be written is kept, so that writing goes on where it stopped once the
    disk has room. Raises OSError if no file can be made.
    """

    def __init__(self, path: str | os.PathLike[str], *, size: int = SIZE, count: int = COUNT) -> None:
        self.path = self._wanted = os.fspath(path)
        """That which is written now."""
        self._limit = size
        self._count = count
        self._pending = bytearray()
        self._size = 0
        self._number = 1
        self._own: deque[str] = deque()
        self._is_plain = not os.path.exists(self.path) or os.path.isfile(self.path)
        self._file = self._new() if self._is_plain else io.FileIO(os.open(self.path, os.O_WRONLY), "wb")

    @property
    def full(self) -> bool:
        return self._is_plain and self._size + len(self._pending) >= self._limit

    @property
    def pending(self) -> int:
        """Bytes that are not yet written."""
        return len(self._pending)

    def write(self, data: bytes) -> int:
        """Take what `flush` is to write."""
        self._pending += data
        return len(data)

    def flush(self) -> None:
        """Write what was taken. Raises OSError where not all can be written; the rest is kept."""
        while self._pending:
            # unbuffered: a disk that fills up takes a part, and says how much
            written = self._file.write(self._pending) or 0
            del self._pending[:written]
            self._size += written

    def begin_next(self) -> None:
        """Go on in a new file. Raises OSError, the old one going on, where that is not possible."""
        self.flush()
        while len(self._own) >= self._count:
            self._remove(self._own.popleft())
        before, self._file = self._file, self._new()
        before.close()
        self._size = 0

    def close(self) -> None:
        """Write the rest and close the file.

        Raises OSError where not all can be written, or where the disk says so late.
        """
        try:
            self.flush()
        finally:
            self._file.close()

    def _new(self) -> io.FileIO:
        """Open the next file that is not there yet."""
        while True:
            self.path = self._name()
            try:
                # exclusive: what is there is never overwritten
                file = io.FileIO(open_file(self.path, os.O_WRONLY | os.O_EXCL), "wb")
            except FileExistsError:
                self._number += 1
                continue
            self._number += 1
            self._own.append(self.path)
            return file

    def _name(self) -> str:
        root, extension = os.path.splitext(self._wanted)
        return self._wanted if self._number == 1 else f"{root}-{self._number}{extension}"

    def _remove(self, path: str) -> None:
        """Remove a file of ours; one that somebody has moved away is his."""
        try:
            os.unlink(path)
        except FileNotFoundError:
            pass
