"""A line in real time, on a pseudo-terminal or on a TCP port.

A server runs its line in a thread with its own clock, because an event loop's timers are rounded up to milliseconds,
which is half a frame. A thread without work sleeps until it is woken.
"""

from __future__ import annotations

import logging
import os
import pty
import queue
import select
import socket
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future
from types import TracebackType
from typing import Any, Self, TypeVar

from busmaster.contract.profile import LineSettings
from busmaster.emulator import port_settings
from busmaster.emulator.device import NEVER
from busmaster.emulator.line import Line

T = TypeVar("T")
logger = logging.getLogger("busmaster")
SPIN = 100e-6
"""Seconds for which the thread waits without sleeping: the kernel wakes a thread some 60 microseconds late."""
CHUNK = 4096


class LineServer(ABC):
    """Runs a line in a thread until it is closed; a context manager. `path` is how a client names it.

    The line and its devices belong to that thread: change them through `call` while it runs (single attributes such
    as `delay` or a fault's rate may be set from anywhere).
    """

    path: str

    def __init__(self, line: Line) -> None:
        self.line = line
        self.dropped = 0
        """Bytes for the host that were not read in time."""
        self._actions: queue.SimpleQueue[tuple[Callable[[Line, float], Any], Future[Any]]] = queue.SimpleQueue()
        self._bell, self._button = os.pipe()
        os.set_blocking(self._button, False)
        self._closing = False
        self._closed = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=f"emulated line {self.path}", daemon=True)
        self._thread.start()

    def call(self, action: Callable[[Line, float], T]) -> T:
        """Have the thread call `action(line, now)`, and return its result or raise its exception.

        Raises RuntimeError if the line is no longer served.
        """
        result: Future[T] = Future()
        self._actions.put((action, result))
        if self._closing or not self._thread.is_alive():  # behind the put: a thread that ends empties the queue once
            raise RuntimeError(f"{self.path} is no longer served")
        os.write(self._button, b".")
        return result.result()

    def close(self) -> None:
        """Stop serving: clients lose their port. Raises the exception that ended the thread early, if any."""
        if self._closed:
            return
        self._closed = self._closing = True
        os.write(self._button, b".")
        self._thread.join()
        os.close(self._bell)
        os.close(self._button)
        if self._error is not None:
            raise self._error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    @abstractmethod
    def _sources(self) -> list[int]:
        """Return the descriptors to read from."""

    @abstractmethod
    def _read(self, source: int) -> bytes:
        """Return the bytes that the host sent there."""

    @abstractmethod
    def _deliver(self, data: bytes) -> None:
        """Pass `data` to the host, without waiting."""

    @abstractmethod
    def _shut(self) -> None: ...

    def _run(self) -> None:
        try:
            while not self._closing:
                self._step()
        except BaseException as error:
            self._error = error
        finally:
            self._shut()
            self._closing = True  # before the queue is emptied: a later put must see it
            while not self._actions.empty():
                self._actions.get()[1].set_exception(RuntimeError(f"{self.path} is no longer served"))

    def _step(self) -> None:
        now = time.monotonic()
        data = self.line.receive(now)
        if data:
            self._deliver(data)
        due = self.line.next_event()
        timeout = None
        if due != NEVER:
            timeout = due - time.monotonic() - SPIN
            if timeout <= 0:
                while time.monotonic() < due:
                    pass
                timeout = 0.0
        for source in select.select([self._bell, *self._sources()], (), (), timeout)[0]:
            if source != self._bell:
                data = self._read(source)
                if data:
                    self.line.send(data, time.monotonic())
                continue
            os.read(self._bell, CHUNK)
            while not self._actions.empty():
                self._act(*self._actions.get())

    def _act(self, action: Callable[[Line, float], Any], result: Future[Any]) -> None:
        try:
            result.set_result(action(self.line, time.monotonic()))
        except Exception as error:
            result.set_exception(error)


class PtyServer(LineServer):
    """A line on a pseudo-terminal. `path` is `link` if given, else the terminal's own.

    The terminal is raw and stays open, so that clients can connect and disconnect. It has the line's rate. If a client
    sets another rate, both sides receive wrong bytes, as from a UART. The first bytes at each other rate are reported
    once: `report` is called with a text, in the server's thread; by default the text is logged. Raises FileExistsError
    if `link` exists and is not a symbolic link, or is one to another terminal that exists.
    """

    def __init__(
        self,
        line: Line,
        link: str | os.PathLike[str] | None = None,
        report: Callable[[str], object] = logger.warning,
    ) -> None:
        self._report = report
        self._reported: set[LineSettings] = set()
        self._master, self._slave = pty.openpty()
        self._device = os.ttyname(self._slave)
        self._link = None if link is None else os.fspath(link)
        self.path = self._device
        try:
            tty.setraw(self._slave)
            port_settings.set_rate(self._slave, line.settings.baudrate)
            self._terminal = port_settings.words(self._master)
            os.set_blocking(self._master, False)
            if self._link is not None:
                if os.path.islink(self._link):
                    _check_unused(self._link, self._device)
                    os.unlink(self._link)
                os.symlink(self._device, self._link)
                self.path = self._link
        except BaseException:
            os.close(self._master)
            os.close(self._slave)
            raise
        super().__init__(line)

    def _sources(self) -> list[int]:
        return [self._master]

    def _read(self, source: int) -> bytes:
        terminal = port_settings.words(self._master)
        if terminal != self._terminal:  # the client that sent these bytes has changed it
            self._terminal = terminal
            self.line.host = port_settings.differing(terminal, self.line.settings)
        try:
            data = os.read(source, CHUNK)
        except BlockingIOError:
            return b""
        # With the bytes and not with the setting: a client may open the port first and set its rate later.
        if data and self.line.host is not None and self.line.host not in self._reported:
            self._reported.add(self.line.host)
            self._report(f"{self.path}: {port_settings.mismatch_text(self.line.host, self.line.settings)}")
        return data

    def _deliver(self, data: bytes) -> None:
        try:
            taken = os.write(self._master, data)
        except BlockingIOError:
            taken = 0
        self.dropped += len(data) - taken

    def _shut(self) -> None:
        # A server that began later may have replaced the link.
        if self._link is not None and os.path.islink(self._link) and os.readlink(self._link) == self._device:
            os.unlink(self._link)
        os.close(self._slave)
        os.close(self._master)


class TcpServer(LineServer):
    """A line on a TCP port, as on a serial server. Clients share it: each receives everything that is sent back.

    `path` is "socket://HOST:PORT"; port 0 picks a free one. Raises OSError if the port cannot be bound.
    """

    def __init__(self, line: Line, host: str = "127.0.0.1", port: int = 0) -> None:
        self._listener = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
        self._listener.setblocking(False)
        self._clients: dict[int, socket.socket] = {}
        self.host, self.port = self._listener.getsockname()[:2]
        self.path = f"socket://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"
        super().__init__(line)

    def _sources(self) -> list[int]:
        return [*self._clients, self._listener.fileno()]

    def _read(self, source: int) -> bytes:
        if source == self._listener.fileno():
            self._accept()
            return b""
        client = self._clients[source]
        try:
            data = client.recv(CHUNK)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            del self._clients[source]
            client.close()
        return data

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._clients[client.fileno()] = client

    def _deliver(self, data: bytes) -> None:
        if not self._clients:
            self.dropped += len(data)
        for client in self._clients.values():
            try:
                taken = client.send(data)
            except OSError:
                taken = 0
            self.dropped += len(data) - taken

    def _shut(self) -> None:
        self._listener.close()
        for client in self._clients.values():
            client.close()


def _check_unused(link: str, device: str) -> None:
    """Raise FileExistsError if a link leads to another pseudo-terminal that exists, and so has a server."""
    target = os.readlink(link)
    if target.startswith("/dev/pts/") and target != device and os.path.exists(target):
        raise FileExistsError(f"another emulator serves it on {target}; end that one, or delete the link")


def serve_pty(
    line: Line, link: str | os.PathLike[str] | None = None, report: Callable[[str], object] = logger.warning
) -> PtyServer:
    """Serve `line` on a pseudo-terminal, and make `link` (replacing a symbolic link) point to it until closed.

    `report` is called once for each other baud rate at which a client sends; by default it is logged as a warning.
    """
    return PtyServer(line, link, report)


def serve_tcp(line: Line, host: str = "127.0.0.1", port: int = 0) -> TcpServer:
    """Serve `line` on a TCP port until closed."""
    return TcpServer(line, host, port)


__all__ = [
    "CHUNK",
    "SPIN",
    "LineServer",
    "PtyServer",
    "TcpServer",
    "serve_pty",
    "serve_tcp",
]
