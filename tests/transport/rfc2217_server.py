"""An RFC 2217 server on the loopback interface: pyserial's `PortManager` before an emulated line."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, cast

from serial.rfc2217 import SERVER_NOTIFY_LINESTATE, SERVER_NOTIFY_MODEMSTATE, PortManager

from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort


class RemotePort:
    """What PortManager sets: the attributes of a serial port. `takes` refuses values as a driver would."""

    cts = dsr = True
    ri = cd = False
    _takes: Callable[[str, Any], bool]

    def __init__(self, takes: Callable[[str, Any], bool] = lambda *_: True) -> None:
        object.__setattr__(self, "_takes", takes)
        self.baudrate, self.bytesize, self.parity, self.stopbits = 1200, 8, "N", 1
        self.rtscts = self.xonxoff = False
        self.dtr = self.rts = True

    def __setattr__(self, name: str, value: Any) -> None:
        if getattr(self, name, value) != value and not self._takes(name, value):
            raise ValueError(f"{name} cannot be {value}")
        object.__setattr__(self, name, value)


class Session(asyncio.Protocol):
    """One connection to the server; also the protocol of the line behind it."""

    def __init__(self, server: Server, line: asyncio.Transport | None = None) -> None:
        self.server = server
        self.line = line
        self.tcp: asyncio.Transport | None = None
        self.received = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.tcp = transport
        transport.write(self.server.banner)
        self.manager = PortManager(cast("Any", self.server.port), cast("Any", self))
        self.server.sessions.append(self)
        self.server.changed.set()

    def write(self, data: bytes) -> None:
        """Send bytes as they are: PortManager calls this."""
        assert self.tcp is not None
        self.tcp.write(data)

    def data_received(self, data: bytes) -> None:
        through = b"".join(self.manager.filter(data))
        self.received += through
        if self.server.line is not None and through:
            self.server.line.write(through)
        self.server.changed.set()

    def say(self, data: bytes) -> None:
        """Send data of the line."""
        self.write(b"".join(self.manager.escape(data)))

    def report(self, linestate: int) -> None:
        """Send NOTIFY-LINESTATE, if the client has not masked all of it."""
        if linestate & self.manager.linstate_mask:
            self.manager.rfc2217_send_subnegotiation(SERVER_NOTIFY_LINESTATE, bytes((linestate,)))

    def report_modem(self, state: int) -> None:
        """Send NOTIFY-MODEMSTATE."""
        self.manager.rfc2217_send_subnegotiation(SERVER_NOTIFY_MODEMSTATE, bytes((state,)))


class Behind(asyncio.Protocol):
    """Passes what the line says to the newest session; `spoil` may do so in its own way."""

    def __init__(self, server: Server) -> None:
        self.server = server

    def data_received(self, data: bytes) -> None:
        if self.server.sessions:
            self.server.spoil(self.server.sessions[-1], data)


class Server:
    """Its settings, and the sessions that it had."""

    def __init__(self, port: RemotePort | None = None, banner: bytes = b"") -> None:
        self.port = port or RemotePort()
        self.banner = banner
        self.sessions: list[Session] = []
        self.changed = asyncio.Event()
        self.line: asyncio.Transport | None = None
        self.number = 0
        self.spoil: Callable[[Session, bytes], None] = lambda session, data: session.say(data)


@asynccontextmanager
async def rfc2217_server(
    line: Line | None = None, port: RemotePort | None = None, banner: bytes = b""
) -> AsyncIterator[Server]:
    """Serve an emulated line, or none, by RFC 2217."""
    server = Server(port, banner)
    if line is not None:
        server.line = await MemoryPort(line).open(lambda: Behind(server))
    listening = await asyncio.get_running_loop().create_server(lambda: Session(server), "127.0.0.1", 0)
    server.number = listening.sockets[0].getsockname()[1]
    try:
        yield server
    finally:
        listening.close()
        for session in server.sessions:
            if session.tcp is not None:
                session.tcp.abort()
        if server.line is not None:
            server.line.abort()
        await listening.wait_closed()
