"""Lines to measure on: ptys, TCP connections or socket pairs, with the responder at their other end."""

from __future__ import annotations

import asyncio
import os
import socket
import tty
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from types import TracebackType

from benchmarks.apart import Apart
from busmaster import Endpoint, LineSettings, SerialPort, TcpPort
from busmaster.ext import identity

FREE_BAUDRATE = 57600
"""Said of a line that is not paced: windows follow it, the bytes do not."""
SPIN = 500e-6
"""Longer than a sleeping core takes to wake up, where one line has the responder to itself."""


class Kind(Enum):
    PTY = "pty"
    TCP = "TCP"
    SOCKETPAIR = "socketpair"


@dataclass(frozen=True)
class SocketPort:
    """An endpoint on a socket that is connected already: it can be opened once."""

    sock: socket.socket
    settings: LineSettings | None = None
    name: str = "socketpair"
    echo: bool = False
    receive_latency: float = 0.0
    paced: bool | None = None

    def presence(self) -> None:
        return None

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: identity.Identity | None = None
    ) -> asyncio.Transport:
        transport, _ = await asyncio.get_running_loop().create_connection(protocol_factory, sock=self.sock)
        return transport


class Lines:
    """`count` lines of one kind, all served by one responder process. Use it in `with`; `ports` are the near ends.

    `table` maps each request to the parts of its reply. `baudrate` None: the line is not paced. `delay` is the
    device's reply time in seconds. A `swallow` that a request begins with is taken off (the host's ACK in MSC). For
    `spin` seconds before a reply is due the responder watches the clock, awake.
    """

    def __init__(
        self,
        count: int,
        table: Mapping[bytes, Sequence[bytes]],
        *,
        kind: Kind = Kind.PTY,
        settings: LineSettings | None = None,
        delay: float = 0.0,
        swallow: bytes = b"",
        spin: float = SPIN,
    ) -> None:
        self.ports: list[Endpoint] = []
        self._kept: list[int] = []
        self._table = table
        self._settings = settings
        self._far = [self._pair(kind) for _ in range(count)]
        self._order = {
            "table": {ask.hex(): [part.hex() for part in say] for ask, say in table.items()},
            "swallow": swallow.hex(),
            "spin": spin,
            "lines": [
                {
                    "fd": fd,
                    "tau": settings.byte_time if settings is not None else 0.0,
                    "delay": delay,
                    "listen": kind is Kind.TCP,
                }
                for fd in self._far
            ],
        }
        self._responder: Apart

    def _pair(self, kind: Kind) -> int:
        settings = self._settings or LineSettings(FREE_BAUDRATE)
        if kind is Kind.PTY:
            far, near = os.openpty()
            tty.setraw(near)
            self._kept.append(near)  # while somebody holds it, the far end reads no hang-up between two masters
            self.ports.append(SerialPort(os.ttyname(near), baudrate=settings.baudrate))
            return far
        if kind is Kind.TCP:
            server = socket.create_server(("127.0.0.1", 0))
            self.ports.append(TcpPort("127.0.0.1", server.getsockname()[1], baudrate=settings.baudrate))
            return server.detach()
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        self.ports.append(SocketPort(ours, settings))
        return theirs.detach()

    def __enter__(self) -> Lines:
        self._responder = Apart("benchmarks.responder", paced=self._settings is not None, pass_fds=self._far)
        for fd in self._far:
            os.close(fd)
        self._responder.ask(self._order)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._responder.close()
        for fd in self._kept:
            os.close(fd)

    def dead_times(self) -> list[list[float]]:
        """Seconds between each reply and the next request, line by line, since this was asked last."""
        return [line["dead"] for line in self._responder.ask("report")]
