"""Which process has a serial port open or locked, and who may open it. Linux only: other systems find no process."""

from __future__ import annotations

import contextlib
import grp
import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")
WITH_VALUE = re.compile(r"-[^-cmWX]*(?P<name>[cmWX])(?P<value>.*)", re.DOTALL)
"""Short options of Python of which the last one has a value: behind it, or in the next word."""
GROUP_OPENS = stat.S_IRGRP | stat.S_IWGRP


@dataclass(frozen=True, slots=True)
class Holder:
    """A process that has the port open."""

    pid: int
    command: str

    def __str__(self) -> str:
        return "this program" if self.pid == os.getpid() else f"{self.command} (process {self.pid})"


def holders(path: str, *, proc: Path = PROC) -> tuple[Holder, ...]:
    """Return the processes that have it open, among those that this user can inspect (root: all)."""
    device = os.path.realpath(path)
    return tuple(_holder(pid, proc) for pid in _pids(proc) if _has_open(proc / str(pid), device))


def lock_owner(path: str, *, proc: Path = PROC) -> Holder | None:
    """Return the process that has locked it (flock), from the kernel's table, or None."""
    try:
        inode = os.stat(path)
        table = (proc / "locks").read_text()
    except OSError:
        return None
    place = f"{os.major(inode.st_dev):02x}:{os.minor(inode.st_dev):02x}:{inode.st_ino}"
    for line in table.splitlines():
        # One line per lock: "1: FLOCK  ADVISORY  WRITE 812 00:05:88 0 EOF" (proc_locks(5)).
        fields = line.split()
        if fields[1:2] == ["FLOCK"] and place in fields:
            pid = int(fields[4])
            return _holder(pid, proc) if pid > 0 else None  # 0 or -1: in another container
    return None


def owning_group(path: str) -> str:
    """Return the group of the port, by name if it has one."""
    # May have no name, for example in a container.
    gid = os.stat(path).st_gid
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def how_to_open(path: str) -> str:
    """Return a hint for a user without permission to open it.

    Joining the group root would grant far more than a port, and joining a group without permissions has no effect.
    """
    status = os.stat(path)
    if status.st_gid != 0 and status.st_mode & GROUP_OPENS == GROUP_OPENS:
        return f"join its group: `sudo usermod -aG {owning_group(path)} $USER`, then log in again"
    return (
        f"its group {owning_group(path)} should not be joined: set another group with a udev rule, such as "
        'SUBSYSTEM=="tty", GROUP="dialout", MODE="0660"'
    )


def _pids(proc: Path) -> list[int]:
    try:
        # Without /proc (another system) nothing is found.
        return sorted(int(entry) for entry in os.listdir(proc) if entry.isdigit())
    except OSError:
        return []


def _has_open(process: Path, device: str) -> bool:
    """Return True if the process has it open. False if it cannot be inspected or has just ended.

    An O_PATH descriptor does not count as open.
    """
    with contextlib.suppress(OSError):
        for number in os.listdir(process / "fd"):
            with contextlib.suppress(OSError):
                if (
                    os.readlink(process / "fd" / number) == device
                    and not _flags(process / "fdinfo" / number) & os.O_PATH
                ):
                    return True
    return False


def _flags(descriptor: Path) -> int:
    found = re.search(r"^flags:\s*(\d+)$", descriptor.read_text(), re.MULTILINE)
    return int(found[1], 8) if found else 0


def serves(process: Path, device: str) -> bool:
    """Return True if the process has the other end of this pseudo-terminal open: then it is the line, not a second
    master."""
    for descriptor in process.glob("fdinfo/*"):
        with contextlib.suppress(OSError):
            index = re.search(r"^tty-index:\s*(\d+)$", descriptor.read_text(), re.MULTILINE)
            # Only a master of a pseudo-terminal has this line in its fdinfo.
            if index is not None and device == f"/dev/pts/{index[1]}":
                return True
    return False


def _holder(pid: int, proc: Path) -> Holder:
    try:
        command = (proc / str(pid) / "comm").read_text().strip()
        if command.startswith("python"):  # the same for every program in Python
            command = _with_arguments(command, (proc / str(pid) / "cmdline").read_bytes())
    except OSError:
        command = "another program"
    return Holder(pid, command)


def _with_arguments(command: str, line: bytes) -> str:
    """Return the command with its options and its program: `-m` with the module and one word, a script, or `-c`.

    What follows may be long or secret.
    """
    shown: list[str] = []
    words = iter(line.decode(errors="replace").split("\0")[1:])
    for word in words:
        option = WITH_VALUE.fullmatch(word)
        name, value = (option["name"], option["value"]) if option else ("", "")
        if name == "c":
            shown.append(word.removesuffix(value))
            break
        shown.append(word)
        if (name and not value) or word == "--check-hash-based-pycs":
            shown.append(next(words, ""))
        if name == "m":
            shown.append(next(words, ""))
            break
        if not word.startswith("-") or word == "-":  # the script, or the standard input
            break
    return " ".join((command, *(repr(text)[1:-1] for text in shown if text)))
