"""A small disk that is really full."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


class SmallDisk:
    """A file system of its own, of a few kilobytes, in `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._ballast = folder / "ballast"

    def fill(self) -> None:
        """Until not one byte more goes on it."""
        with self._ballast.open("ab", buffering=0) as file:
            for size in (4096, 1):
                try:
                    while True:
                        file.write(bytes(size))
                except OSError:
                    pass

    def clear(self) -> None:
        self._ballast.unlink()


@contextmanager
def small_disk(kilobytes: int, *, read_only: bool = False) -> Iterator[SmallDisk]:
    """Skips the test where nobody may mount one."""
    if os.name != "posix" or os.geteuid() != 0:
        pytest.skip("mounting a small file system needs root")
    # Not in pytest's folders: a killed run leaves its disk mounted, and the next run could not remove the folder.
    folder = Path(tempfile.mkdtemp(prefix="busmaster-disk-"))
    options = f"size={kilobytes}k{',ro' if read_only else ''}"
    mounting = ["mount", "-t", "tmpfs", "-o", options, "none", str(folder)]
    done = subprocess.run(mounting, capture_output=True, text=True, check=False)
    if done.returncode:
        folder.rmdir()
        pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")
    try:
        yield SmallDisk(folder)
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)
        folder.rmdir()
