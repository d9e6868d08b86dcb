"""The sockets of lines, and their owners.

Beside each socket NAME.sock is NAME.line, which the owner has locked. It contains the process and its port. The lock,
not the socket, decides who may listen, so that only one of two simultaneous starts succeeds.
"""

from __future__ import annotations

import contextlib
import fcntl
import ipaddress
import json
import os
import re
import socket
import stat
from collections.abc import Hashable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType

from busmaster import InvalidCommand, LineDown
from busmaster.app.bounds import LONGEST_LINE_RECORD
from busmaster.ext import host_and_port, read_file

SYSTEM = Path("/run/busmaster")
"""Where the lines are that systemd runs."""
LONGEST_LINE_NAME = 60
LONGEST_PATH = 107
"""Bytes of a Unix socket's path that the kernel takes."""


@dataclass(frozen=True, slots=True)
class Owner:
    """The owner of a line: its name, port, socket and process, and the settings with which the port was opened."""

    name: str
    port: str
    socket: str
    pid: int
    baudrate: int | None = None
    framing: str | None = None
    echo: bool = False

    @property
    def address(self) -> str:
        """Return what `connect` takes."""
        return f"unix:{self.socket}"


def line_name(text: str) -> str:
    """Return the name of a line, from its file or its port: /dev/ttyUSB0 is "ttyUSB0"."""
    name = re.sub(r"[^A-Za-z0-9_.-]+", "-", os.path.basename(text.rstrip("/")) or text).strip(".-")[:LONGEST_LINE_NAME]
    return name or "line"


def checked_name(name: str) -> str:
    """Return a line's name. Raises InvalidCommand for an invalid one, because the socket has this name."""
    if name != line_name(name):
        raise InvalidCommand(f"{name!r} is not a name of a line; use letters, digits and _.-, like {line_name(name)!r}")
    return name


def runtime_folder() -> Path:
    """Return this user's folder for sockets, made if it is not there.

    Raises InvalidCommand where others may write there: they could pose as its lines.
    """
    folder = _folder()
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise InvalidCommand(f"{folder} cannot be made: {error.strerror}; set XDG_RUNTIME_DIR") from None
    if not _is_ours(folder):
        raise InvalidCommand(f"others may write in {folder}, and could pose as its lines: remove it")
    return folder


def _folder() -> Path:
    if given := os.environ.get("RUNTIME_DIRECTORY"):  # from systemd
        return Path(given.split(":")[0])
    if given := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(given, "busmaster")
    return Path("/tmp", f"busmaster-{os.getuid()}")


def _is_ours(folder: Path) -> bool:
    """Return whether a folder is this user's, or root's, and no other user may write there."""
    try:
        found = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid in (os.getuid(), 0) and not found.st_mode & 0o022


def owners() -> Iterator[Owner]:
    """Yield the lines that are served in this user's folder, and by systemd, as far as this user may see them."""
    seen: set[str] = set()
    for folder in (*filter(_is_ours, [_folder()]), SYSTEM, *_inside(SYSTEM)):
        for path in sorted(folder.glob("*.line")):
            owner = _read(path)
            if owner is not None and owner.socket not in seen and _listens(owner.socket):
                seen.add(owner.socket)
                yield owner


def find_owner(port: str) -> Owner | None:
    """Return who serves the line that has this name, or whose port this is, however the port is written.

    It may take long: a host is known by its addresses.
    """
    known = list(owners())
    by_name = next((owner for owner in known if owner.name == port), None)
    if by_name is not None:
        return by_name
    wanted = _devices(port)
    return next((owner for owner in known if wanted & _devices(owner.port)), None)


def _devices(port: str) -> set[Hashable]:
    """Return the identity of a port, independent of its spelling: a device, or the addresses of a serial server."""
    name = port.partition("?")[0].removeprefix("socket://")
    if name.startswith("/"):
        return {os.path.realpath(name)}
    try:
        return addresses_of(name)
    except (InvalidCommand, OSError):  # it is the name of a line, or of an unknown host
        return {name}


def addresses_of(name: str) -> set[Hashable]:
    """Return the addresses of `HOST:PORT`, each in the one spelling that is compared. It may take long.

    Raises InvalidCommand for any other text, OSError for an unknown host.
    """
    host, port = host_and_port(name)
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return {(plain_address(str(place[0])), place[1]) for *_, place in found}


def plain_address(text: str) -> str:
    """Return an address in the one spelling that is compared.

    The same server is at ::ffff:192.0.2.7 as at 192.0.2.7; at 0.0.0.0, :: and ::1 it is this machine's.
    """
    address = ipaddress.ip_address(text)
    address = getattr(address, "ipv4_mapped", None) or address
    is_here = address.is_unspecified or address == ipaddress.IPv6Address(1)
    return "127.0.0.1" if is_here else str(address)


def socket_path(address: str) -> str:
    """Return the socket of `unix:PATH`, or of the name of a line or port.

    Raises LineDown if there is no running line of that name. The name of a stopped line cannot be distinguished from an
    unknown name, so a caller that waits for the owner waits for the name.
    """
    if address.startswith("unix:"):
        return address.removeprefix("unix:").removeprefix("//")
    owner = find_owner(address)
    if owner is None:
        names = ", ".join(owner.name for owner in owners()) or "none"
        what = f"no running line named {address!r} (running: {names})"
        raise LineDown(what, hint="start it with: busmaster run LINE.toml; or name a running line, or unix:PATH")
    return owner.socket


class ServedSocket:
    """The listening socket of its owner's line, for `with`. Raises InvalidCommand with the process if the socket is
    already served.

    The socket of a process that has died is replaced. `mode` is the socket's; `group` is a group's number.
    """

    def __init__(self, owner: Owner, *, mode: int = 0o600, group: int | None = None) -> None:
        self.owner = owner
        self.socket: socket.socket
        self._path = Path(owner.socket)
        self._mode = mode
        self._group = group
        self._lock = -1

    def __enter__(self) -> ServedSocket:
        if len(os.fsencode(self._path)) > LONGEST_PATH:
            raise InvalidCommand(f"{self._path} has more than {LONGEST_PATH} bytes; use a shorter path for the socket")
        try:
            self._take_lock()
            try:
                self._listen()
            except BaseException:
                with contextlib.suppress(OSError):
                    self._line.unlink()
                os.close(self._lock)
                raise
        except OSError as error:
            raise InvalidCommand(f"{self._path} cannot be served: {error.strerror}") from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.socket.close()
        with contextlib.suppress(OSError):
            self._path.unlink()
        with contextlib.suppress(OSError):
            self._line.unlink()
        os.close(self._lock)  # last: until then no other process begins

    @property
    def _line(self) -> Path:
        return self._path.with_suffix(".line")

    def _take_lock(self) -> None:
        while True:
            self._lock = os.open(self._line, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # One that is just leaving has unlinked it: another might lock a new file of that name.
                if os.path.exists(self._line) and os.path.samestat(os.fstat(self._lock), os.stat(self._line)):
                    break
            except BlockingIOError:
                os.close(self._lock)
                other = _read(self._line)
                who = "another process" if other is None else f"process {other.pid}, for {other.port}"
                mend = "use it, or stop that process first"
                if other is not None and not _devices(other.port) & _devices(self.owner.port):
                    mend = "give this line another name, which is also the name of its socket"
                raise InvalidCommand(f"{self._path} is already served by {who}; {mend}") from None
            os.close(self._lock)
        os.ftruncate(self._lock, 0)
        os.write(self._lock, json.dumps(asdict(self.owner)).encode())

    def _listen(self) -> None:
        with contextlib.suppress(FileNotFoundError):
            if not stat.S_ISSOCK(self._path.lstat().st_mode):
                raise InvalidCommand(f"{self._path} is not a socket and is not replaced; use another path")
            if _listens(self._path):
                raise InvalidCommand(f"{self._path} is the socket of another program; stop it, or use another path")
            self._path.unlink()
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            self._bind()
        except BaseException:
            self.socket.close()
            raise

    def _bind(self) -> None:
        before = os.umask(0o177)
        try:
            self.socket.bind(str(self._path))
        finally:
            os.umask(before)
        try:
            if self._group is not None:
                os.chown(self._path, -1, self._group)
            os.chmod(self._path, self._mode)
            self.socket.listen()
        except BaseException:
            self._path.unlink()
            raise


def _read(path: Path) -> Owner | None:
    try:
        decoded = json.loads(read_file(path, LONGEST_LINE_RECORD))
        owner = Owner(**decoded)
        # Another program of this user may have made the file. A file with other contents is ignored.
        texts = [decoded[name] for name in ("name", "port", "socket")]
        fits = all(isinstance(text, str) and "\0" not in text for text in texts) and type(decoded["pid"]) is int
        return owner if fits else None
    except (OSError, ValueError, TypeError, RecursionError):
        return None


def _listens(path: Path | str) -> bool:
    """Return whether a process listens there; True also if this user may not connect."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:
            return True
    return True


def _inside(folder: Path) -> list[Path]:
    try:
        return sorted(entry for entry in folder.iterdir() if entry.is_dir())
    except OSError:
        return []
