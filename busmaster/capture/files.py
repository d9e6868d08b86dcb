"""The files of one capture: existing files are never overwritten, and their size and number are limited."""

from __future__ import annotations

import io
import os
from collections import deque

from busmaster.transport.files import open_file

SIZE = 100_000_000
"""Bytes after which the next file is started. A busy line at 57600 baud writes about two gigabytes a day."""
COUNT = 10
"""Number of files kept per capture."""


class CaptureFiles:
    """Writes to `path`. If that exists, or after `size` bytes, to `path` with -2, -3 and so on.

    A new file is accessible to its owner and group. If there are more than `count` files of its own, the oldest is
    removed. A device or a pipe is written to as it is. Unwritten bytes are kept, so that writing continues where it
    stopped once the disk has space. Raises OSError if no file can be created.
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
        """Number of bytes not written yet."""
        return len(self._pending)

    def write(self, data: bytes) -> int:
        """Add bytes for `flush`."""
        self._pending += data
        return len(data)

    def flush(self) -> None:
        """Write the added bytes. Raises OSError if not all can be written; the rest is kept."""
        while self._pending:
            # unbuffered: a disk that becomes full writes a part, and reports how much
            written = self._file.write(self._pending) or 0
            del self._pending[:written]
            self._size += written

    def begin_next(self) -> None:
        """Continue in a new file. If that is not possible, raises OSError and continues in the old one."""
        self.flush()
        while len(self._own) >= self._count:
            self._remove(self._own.popleft())
        before, self._file = self._file, self._new()
        before.close()
        self._size = 0

    def close(self) -> None:
        """Write the rest and close the file.

        Raises OSError if not all can be written, or if the disk reports an error late.
        """
        try:
            self.flush()
        finally:
            self._file.close()

    def _new(self) -> io.FileIO:
        """Create the next file that does not exist yet."""
        while True:
            self.path = self._name()
            try:
                # exclusive: existing files are never overwritten
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
        """Remove a file of this capture. A file that was moved is left alone."""
        try:
            os.unlink(path)
        except FileNotFoundError:
            pass
