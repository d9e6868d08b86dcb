"""The files that busmaster makes: who may read them is said here, and nowhere else."""

from __future__ import annotations

import os

MODE = 0o640
"""Of a new file: its owner may write, its group may read. The process's umask narrows it, as it does every mode."""
FOLDER_MODE = 0o750


def open_file(path: str, flags: int, mode: int = MODE) -> int:
    """Open a file for writing and return its descriptor; one that is not there is made, with this mode.

    `flags` are those of os.open. Programs that are started do not inherit the descriptor. Raises OSError.
    """
    return os.open(path, flags | os.O_CREAT | os.O_CLOEXEC, mode)
