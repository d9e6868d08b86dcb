"""Who is at the other end of a Unix socket, as the kernel says."""

from __future__ import annotations

import pwd
import socket
import struct
from dataclasses import dataclass
from typing import Any

CREDENTIALS = struct.Struct("3i")


@dataclass(frozen=True, slots=True)
class Peer:
    """A process of this machine."""

    pid: int
    user: str
    program: str

    def __str__(self) -> str:
        return f"{self.user}, {self.program} (process {self.pid})"


def peer_of(connected: Any) -> Peer:
    """Return who has connected a Unix socket."""
    pid, uid, _ = CREDENTIALS.unpack(connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size))
    return Peer(pid, user_name(uid), program_name(pid))


def user_name(uid: int) -> str:
    """Return a user's name; the number of one without a name."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def program_name(pid: int) -> str:
    """Return what the kernel calls a process's program."""
    try:
        with open(f"/proc/{pid}/comm", encoding="utf-8", errors="replace") as file:
            return file.read().strip()
    except OSError:
        return "a program"
