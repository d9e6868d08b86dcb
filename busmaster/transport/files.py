"""Reading and creating files: which files are read, up to which size, and with which permissions they are created."""

from __future__ import annotations

import errno
import os
import stat

from busmaster.contract.bounds import LONGEST_FILE

MODE = 0o640
"""Mode of a new file: its owner may write, its group may read. The process's umask restricts it as usual."""
FOLDER_MODE = 0o750


def open_file(path: str, flags: int, mode: int = MODE) -> int:
    """Open a file for writing and return its descriptor. A missing file is created with this mode.

    `flags` are those of os.open. Child processes do not inherit the descriptor. Raises OSError.
    """
    return os.open(path, flags | os.O_CREAT | os.O_CLOEXEC, mode)


def read_file(path: str | os.PathLike[str], most: int = LONGEST_FILE) -> bytes:
    """Return the content of a regular file of at most `most` bytes. Never waits for another program.

    Raises OSError for a file that cannot be read or is larger, and for a FIFO or a device. Opening a FIFO would wait
    for a writer, and a device may have no end.
    """
    name = os.fspath(path)
    descriptor = os.open(name, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    try:
        # Before `open`, which would leave the descriptor of a folder open, and name its number in the error.
        check_regular(os.fstat(descriptor), name)
    except OSError:
        os.close(descriptor)
        raise
    with open(descriptor, "rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"it has more than {most} bytes, which is the bound for such a file", name)
    return data


def check_regular(found: os.stat_result, name: str) -> None:
    """Raise OSError unless it is a regular file."""
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), name)
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "it is a FIFO, a socket or a device: name a regular file", name)
