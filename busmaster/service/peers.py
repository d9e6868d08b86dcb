"""Who is at the other end of a Unix socket, as the kernel says."""

from __future__ import annotations

import asyncio
import pwd
import socket
import struct
from dataclasses import dataclass
from typing import Any

CREDENTIALS = struct.Struct("3i")

_names: dict[int, str] = {}
"""What users are called, by their numbers: whom to ask may be a server on a network, which a line does not wait for."""
_asked: dict[int, asyncio.Task[None]] = {}


@dataclass(frozen=True, slots=True)
class Peer:
    """A process of this machine."""

    pid: int
    uid: int
    program: str

    @property
    def user(self) -> str:
        """Return the user's name; the number of one without a name, and until the name is found."""
        return _names.get(self.uid, str(self.uid))

    def __str__(self) -> str:
        return f"{self.user}, {self.program} (process {self.pid})"


def peer_of(connected: Any) -> Peer:
    """Return who has connected a Unix socket, and have the user's name found."""
    pid, uid, _ = CREDENTIALS.unpack(connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size))
    find_name(uid)
    return Peer(pid, uid, program_name(pid))


def find_name(uid: int) -> asyncio.Future[None] | None:
    """Have the name of a user found, in a thread; return what ends then, or None if it is known."""
    if uid in _names:
        return None
    if uid not in _asked:
        _asked[uid] = asyncio.ensure_future(_find_name(uid))
    return _asked[uid]


async def _find_name(uid: int) -> None:
    try:
        _names[uid] = await asyncio.to_thread(user_name, uid)
    finally:
        del _asked[uid]


def user_name(uid: int) -> str:
    """Return a user's name; the number of one without a name. It may take long."""
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
