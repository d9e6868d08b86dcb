"""The network between `busmaster run` and its broker: it can stand still, and it can go away."""

from __future__ import annotations

import os
import select
import socket
import threading
from types import TracebackType
from typing import Self

CHUNK = 1 << 16


class Gateway:
    """Passes the bytes of each client on to a port of this machine. `port` is its own, and stays so."""

    def __init__(self, target: int) -> None:
        self._target = target
        self._listener: socket.socket | None = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._ends: dict[socket.socket, socket.socket] = {}
        self._held = False
        self._lock = threading.Lock()
        self._bell, self._button = os.pipe()
        self._over = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def hold(self) -> None:
        """Pass nothing on any more, and say nothing of it: connections stay half open."""
        self._change(held=True)

    def pass_on(self) -> None:
        self._change(held=False)

    def reset(self) -> None:
        """Break every connection off."""
        with self._lock:
            self._drop(*self._ends)
        self._ring()

    def close(self) -> None:
        """Refuse, until it is opened again, whoever comes, and break the rest off."""
        with self._lock:
            if self._listener is not None:
                self._listener.close()
                self._listener = None
            self._drop(*self._ends)
        self._ring()

    def open(self) -> None:
        with self._lock:
            if self._listener is None:
                self._listener = socket.create_server(("127.0.0.1", self.port))
        self._ring()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
        self._over = True
        self._ring()
        self._thread.join()
        os.close(self._bell)
        os.close(self._button)

    def _change(self, held: bool) -> None:
        with self._lock:
            self._held = held
        self._ring()

    def _ring(self) -> None:
        os.write(self._button, b".")

    def _run(self) -> None:
        while not self._over:
            with self._lock:
                sources: list[int | socket.socket] = [self._bell]
                if not self._held:
                    sources += [*self._ends, *([self._listener] if self._listener is not None else [])]
            try:
                ready = select.select(sources, (), ())[0]
            except (OSError, ValueError):
                continue  # one of them was closed at that moment
            for source in ready:
                if isinstance(source, int):
                    os.read(source, CHUNK)
                else:
                    with self._lock:
                        self._serve(source)

    def _serve(self, source: socket.socket) -> None:
        if source is self._listener:
            try:
                client, _ = source.accept()
                server = socket.create_connection(("127.0.0.1", self._target), 5.0)
            except OSError:
                return
            for one, other in ((client, server), (server, client)):
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._ends[one] = other
        elif source in self._ends:
            try:
                data = source.recv(CHUNK)
                self._ends[source].sendall(data)
            except OSError:
                data = b""
            if not data:
                self._drop(source)

    def _drop(self, *ends: socket.socket) -> None:
        for end in ends:
            other = self._ends.pop(end, None)
            if other is not None:
                self._ends.pop(other, None)
                end.close()
                other.close()
