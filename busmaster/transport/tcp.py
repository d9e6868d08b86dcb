"""A serial server in raw TCP mode."""

from __future__ import annotations

import asyncio
import errno
import math
import os
import socket
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Annotated

from busmaster.contract.arguments import Between
from busmaster.contract.profile import LineSettings
from busmaster.errors import InvalidCommand, LineDown
from busmaster.transport.identity import Identity

CONNECT_DEADLINE = 5.0
"""Seconds, including name resolution."""

READ_AT_ONCE = 65536
"""Bytes. More than a line sends in a second. After a standstill of the process it can take several reads."""

# A server without power or network is detected within about 10 s, whether or not requests are sent.
KEEP_ALIVE = {"TCP_KEEPIDLE": 4, "TCP_KEEPINTVL": 2, "TCP_KEEPCNT": 3, "TCP_USER_TIMEOUT": 10_000}


@dataclass(frozen=True, slots=True)
class TcpPort:
    """A serial line behind a serial server that passes raw bytes (ser2net, Moxa and similar).

    Raises InvalidCommand for values out of range.
    """

    host: str
    """The name or address of the serial server."""
    port: Annotated[int, Between(1, 65535, self_checked=True)]
    """Its TCP port, on which it passes raw bytes."""
    _: KW_ONLY
    baudrate: Annotated[int | None, Between(1, self_checked=True)] = None
    """The baud rate behind it: reply windows then run from the end of the request on the wire, else from the write."""
    receive_latency: Annotated[float, Between(0, unit="s", self_checked=True)] = 0.0
    """How long the server may hold bytes back (ser2net: 0.0033 unless `chardelay: false`)."""
    echo: bool = False
    """Whether sent bytes are received too, as on some two-wire adapters. They are compared byte for byte."""
    paced: bool = False
    """Whether the server replies no sooner than the baud rate allows."""

    def __post_init__(self) -> None:
        if not self.host:
            raise InvalidCommand("a TCP port needs a host name or address")
        number: object = self.port
        if not isinstance(number, int) or not 1 <= number <= 65535:
            raise InvalidCommand(f"a TCP port number is 1 to 65535, not {number!r}")
        if not (math.isfinite(self.receive_latency) and self.receive_latency >= 0):
            raise InvalidCommand(f"receive_latency must be at least 0 s, not {self.receive_latency}")
        # R4 needs the wire time of the request.
        if self.paced and self.baudrate is None:
            raise InvalidCommand("a paced TCP port needs the baud rate that it is paced by")
        if self.baudrate is not None:
            LineSettings(self.baudrate)

    @property
    def name(self) -> str:
        """Return its name in messages: HOST:PORT."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"

    @property
    def settings(self) -> LineSettings | None:
        """Return the settings from which tau is calculated. The server sets the framing."""
        return None if self.baudrate is None else LineSettings(self.baudrate)

    def presence(self) -> None:
        """Return None: whether a server is back can only be determined by connecting."""
        return None

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: Identity | None = None
    ) -> asyncio.Transport:
        """Connect. A server's only identity is its address. Raises LineDown, after CONNECT_DEADLINE at the latest."""
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(CONNECT_DEADLINE):
                transport, _protocol = await loop.create_connection(
                    lambda: _OneBuffer(protocol_factory()), self.host, self.port
                )
        except TimeoutError:  # before OSError, its base class
            raise LineDown(
                f"{self.name} did not answer within {CONNECT_DEADLINE:g} s", hint="check its address, power and network"
            ) from None
        except OSError as error:
            raise self._refusal(error) from None
        _find_out_a_dead_server(transport.get_extra_info("socket"))
        transport.set_write_buffer_limits(high=0)  # R2: buffered bytes have not left, so any of them pauses the pump
        return transport

    def _refusal(self, error: OSError) -> LineDown:
        # If it tries several addresses, asyncio raises one plain OSError that contains all errors.
        if isinstance(error, ConnectionRefusedError) or f"[Errno {errno.ECONNREFUSED}]" in str(error):
            return LineDown(
                f"{self.name} refused the connection", hint="check that the server runs, and its port number"
            )
        if isinstance(error, socket.gaierror):
            return LineDown(f"no such host: {self.host}", hint="check the name, or use the address")
        why = os.strerror(error.errno) if error.errno else str(error)
        return LineDown(f"cannot connect to {self.name}: {why}", hint="check its address and the network")


class _OneBuffer(asyncio.BufferedProtocol):
    """Receives for `protocol` into one buffer.

    For an `asyncio.Protocol` each read gets 256 KiB of new memory. That can cost three system calls and two page
    faults: a fifth of a transaction.
    """

    def __init__(self, protocol: asyncio.Protocol) -> None:
        self._buffer = memoryview(bytearray(READ_AT_ONCE))
        self._received = protocol.data_received
        self.connection_made = protocol.connection_made  # type: ignore[method-assign]
        self.connection_lost = protocol.connection_lost  # type: ignore[method-assign]
        self.eof_received = protocol.eof_received  # type: ignore[method-assign]
        self.pause_writing = protocol.pause_writing  # type: ignore[method-assign]
        self.resume_writing = protocol.resume_writing  # type: ignore[method-assign]

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        self._received(bytes(self._buffer[:nbytes]))


def _find_out_a_dead_server(sock: socket.socket) -> None:
    """Enable keepalive so that the kernel detects a dead server. TCP_NODELAY is asyncio's default."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in KEEP_ALIVE.items():
        if hasattr(socket, option):  # not every system has all of them
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
