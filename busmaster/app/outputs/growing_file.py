"""A file that grows by whole lines, independent of changes from outside.

Another program can rotate the file, remove it or truncate it, and a crash can leave half a line. Each is noticed at the
next write, and no data goes to a file that no program reads.

Written data survives the end of this process at once, and a loss of power from the next sync on.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

from busmaster.ext import FOLDER_MODE, MODE, open_file


class GrowingFile:
    """`pattern` may contain fields of a date, also in its folders, which are created. The umask narrows `mode`.

    An empty file begins with `head`. `report` is called with a sentence about changes by other programs.
    """

    def __init__(
        self,
        pattern: str,
        *,
        mode: int = MODE,
        sync_every: float = 10.0,
        head: bytes = b"",
        report: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._pattern = pattern
        self._mode = mode
        self._sync_every = sync_every
        self._head = head
        self._report = report
        self._path = ""
        self._descriptor: int | None = None
        self._synced = time.monotonic()
        self._is_named = False
        """Whether the file's name is on the disk, as far as that was ever made sure of."""

    def append(self, lines: bytes, *, sync: bool = False) -> None:
        """Write whole lines, all of them or none; with `sync` they are on the disk then.

        Raises OSError where that fails. Lines that could not be brought to the disk may come again.
        """
        while True:
            descriptor = self._current()
            self._write(descriptor, lines)
            if os.fstat(descriptor).st_nlink:
                break
            self.close()  # it was removed while it was written: no program will ever read that
        if sync and not self._is_named:
            sync_folder(os.path.dirname(self._path) or ".")  # a new file is lost with the power if its name is
            self._is_named = True
        if sync or time.monotonic() - self._synced >= self._sync_every:
            os.fsync(descriptor)
            self._synced = time.monotonic()

    def close(self) -> None:
        """Let go of the file. It never raises."""
        if self._descriptor is not None:
            descriptor, self._descriptor = self._descriptor, None
            try:
                os.fsync(descriptor)
            except OSError:
                pass  # a full or a lost disk was reported when it was written to
            os.close(descriptor)

    def _current(self) -> int:
        """Return the descriptor of today's file, which is opened if it is not yet."""
        path = time.strftime(self._pattern)
        if path != self._path:
            self.close()
            self._path = path
        if self._descriptor is not None and not is_at(path, self._descriptor):
            self._report(f"{path} was moved or removed; a new file was started")
            self.close()
        if self._descriptor is None:
            self._descriptor = self._opened(path)
        return self._descriptor

    def _opened(self, path: str) -> int:
        folder = os.path.dirname(path)
        # No other folder is made: one that is missing was refused at the start, as it may be mistyped.
        if folder and "%" in os.path.dirname(self._pattern):
            os.makedirs(folder, FOLDER_MODE, exist_ok=True)
        descriptor = open_file(path, os.O_WRONLY | os.O_APPEND, self._mode)
        self._is_named = False
        if ends_in_a_half_line(path):
            os.write(descriptor, b"\n")  # else the first new line would continue the half one
            self._report(f"{path} ended with an incomplete line, which was closed")
        return descriptor

    def _write(self, descriptor: int, lines: bytes) -> None:
        """Write the lines whole. What the disk has no room for is cut off again. Raises OSError then."""
        end = os.lseek(descriptor, 0, os.SEEK_END)  # looked at each time: one that was emptied needs its head again
        rest = memoryview(lines if end else self._head + lines)
        try:
            while rest:
                rest = rest[os.write(descriptor, rest) :]
        except OSError:
            # the same lines come again when there is room, and must not follow a half one
            os.ftruncate(descriptor, end)
            raise


def sync_folder(path: str) -> None:
    """Bring the names in a folder to the disk, where its file system can do that."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    except OSError:
        pass  # of another file system, which brings them there by itself or not at all
    finally:
        os.close(descriptor)


def is_at(path: str, descriptor: int) -> bool:
    """Return whether the open file is still what the path leads to."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def ends_in_a_half_line(path: str) -> bool:
    """Return whether the file ends with an incomplete line. False if the file must not be read."""
    try:
        with open(path, "rb") as file:
            end = file.seek(0, os.SEEK_END)
            return bool(end) and (file.seek(end - 1), file.read(1))[1] != b"\n"
    except PermissionError:
        return False
