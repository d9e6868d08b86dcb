"""The other end of a connection: identified by the kernel on a Unix socket, and by a token on TCP."""

from __future__ import annotations

import asyncio
import pwd
import socket
import struct
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Any, Protocol

from busmaster.app.service.permission import Access, Permission

CREDENTIALS = struct.Struct("3i")
PEER_GROUPS = 59
"""SO_PEERGROUPS, which Python does not name."""
MOST_GROUPS = 256
"""Space that Python provides; of a user with more groups, only the first counts."""


class Peer(Protocol):
    """A connected program or user. `str` returns its name in the audit log."""

    @property
    def short(self) -> str:
        """The first part of the names of its poll groups."""
        ...

    @property
    def account(self) -> Hashable:
        """A key that is equal for all connections of one user or token, which share one part of the line's time."""
        ...

    def may_stay(self, access: Access, /) -> bool:
        """Return whether it may stay connected with the present tokens."""
        ...

    def permission(self, access: Access, /) -> Permission:
        """Return its permission."""
        ...


_names: dict[int, str] = {}
"""Names of users by number. They may come from a server on a network, for which a line does not wait."""
_asked: dict[int, asyncio.Task[None]] = {}


@dataclass(frozen=True, slots=True)
class Process:
    """A process of this machine, which has connected the Unix socket."""

    pid: int
    uid: int
    gids: tuple[int, ...]
    program: str

    @property
    def user(self) -> str:
        """Return the user's name; the number if it has no name, or the name is not yet known."""
        return _names.get(self.uid, str(self.uid))

    @property
    def short(self) -> str:
        return f"{self.program} {self.pid}"

    @property
    def account(self) -> Hashable:
        return self.uid

    def may_stay(self, _: Access) -> bool:
        """Return True: the socket's mode decides which processes can connect."""
        return True

    def permission(self, access: Access) -> Permission:
        """Return the permission of its user and groups."""
        return access.of_process(self.uid, self.gids)

    def __str__(self) -> str:
        return f"{self.user}, {self.program} (process {self.pid})"


@dataclass(frozen=True, slots=True)
class Holder:
    """A client that has connected by TCP with a token; `token` is its name, "" for none."""

    token: str
    address: str
    digest: bytes | None = field(default=None, repr=False)
    """Digest of the token. Another token with the same name does not count."""

    @property
    def short(self) -> str:
        return f"{self.token} {self.address}".strip()

    @property
    def account(self) -> Hashable:
        return self.token

    def may_stay(self, access: Access) -> bool:
        """Return whether the token still holds; without one, whether none is needed."""
        return access.secrets.get(self.token) == self.digest if self.token else not access.secrets

    def permission(self, access: Access) -> Permission:
        """Return the permission of the token."""
        return access.of_token(self.token)

    def __str__(self) -> str:
        return f"{f'token {self.token}' if self.token else 'without a token'}, from {self.address}"


def process_of(connected: Any) -> Process:
    """Return the process that has connected a Unix socket, and start to look up the user's name."""
    pid, uid, gid = CREDENTIALS.unpack(connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size))
    find_name(uid)
    return Process(pid, uid, (gid, *_more_groups(connected)), program_name(pid))


def holder_of(connected: Any, token: str, digest: bytes | None) -> Holder:
    """Return the client that has connected by TCP with a token of this name and digest."""
    host, port, *_ = connected.getpeername()
    return Holder(token, f"{host}:{port}", digest)


def _more_groups(connected: Any) -> tuple[int, ...]:
    """Return the groups of a process beside its first."""
    try:
        groups: bytes = connected.getsockopt(socket.SOL_SOCKET, PEER_GROUPS, 4 * MOST_GROUPS)
    except OSError:  # an older kernel, or more groups than fit
        return ()
    return struct.unpack(f"{len(groups) // 4}I", groups)


def find_name(uid: int) -> asyncio.Future[None] | None:
    """Look up the name of a user in a thread. Return the running lookup, or None if the name is known."""
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
    """Return the kernel's name of a process's program."""
    try:
        with open(f"/proc/{pid}/comm", encoding="utf-8", errors="replace") as file:
            return file.read().strip()
    except OSError:
        return "a program"
