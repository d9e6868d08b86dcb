"""The masters that are compared: ours, and what one would write without it.

All ask the same questions in the same order and check every answer. `Bare` is the yardstick: an asyncio.Protocol
that writes the next request from within `data_received`, on our own transport, with no timeouts, no codec and nobody
waiting for a value. `Streams` is what most people write: a lock, a reader and a writer, `wait_for` around it.
`Blocking` is pyserial in a plain loop.
"""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import serial
import serial_asyncio

from benchmarks.lines import SocketPort
from busmaster import Bus, Endpoint, SerialPort, TcpPort
from busmaster.ext import Command, Profile
from busmaster.transport.alarm import KernelTimer, kernel_timer

REPLY_DEADLINE = 1.0
"""Seconds. Long: a machine that is busy with something else must not end a benchmark."""
PATIENCE = 50
"""Attempts at the first read, while the responder's process may still be starting."""


@dataclass(frozen=True)
class Question:
    """One question: our command, the node, its bytes on the wire both ways, and the value that is right."""

    command: Command[Any]
    address: int
    request: bytes
    reply: tuple[bytes, ...]
    value: Any
    closing: bytes = b""


class Master(Protocol):
    """`run` carries out so many transactions and returns how many values were wrong."""

    name: str

    async def open(self, endpoint: Endpoint) -> None: ...
    async def run(self, transactions: int) -> int: ...
    async def close(self) -> None: ...


class Ours:
    """A bus, with `callers` tasks that each ask one thing after another: the backlog is never empty from two up."""

    def __init__(self, profile: Profile, questions: Sequence[Question], callers: int = 4) -> None:
        self.name = "busmaster" if callers > 1 else "busmaster, one caller"
        self._profile = profile
        self._asks = questions
        self._callers = callers
        self.bus: Bus | None = None

    async def open(self, endpoint: Endpoint) -> None:
        self.bus = Bus(endpoint)
        await self.bus.__aenter__()
        for ask in self._asks:
            await self.bus.node(self._profile, ask.address).request(ask.command, retries=PATIENCE)

    async def run(self, transactions: int) -> int:
        share, left = divmod(transactions, self._callers)
        return sum(await asyncio.gather(*(self._call(n, share + (n < left)) for n in range(self._callers))))

    async def _call(self, number: int, transactions: int) -> int:
        assert self.bus is not None
        questions = [(self.bus.node(self._profile, ask.address), ask.command, ask.value) for ask in self._asks]
        questions = questions[number % len(questions) :] + questions[: number % len(questions)]
        wrong = 0
        for n in range(transactions):
            node, command, value = questions[n % len(questions)]
            wrong += await node.request(command) != value
        return wrong

    async def close(self) -> None:
        assert self.bus is not None
        await self.bus.__aexit__(None, None, None)


class Bare(asyncio.Protocol):
    """The least that a master can be. It keeps `silence` seconds between a reply and the next request, by a timer of
    the kernel's of its own."""

    name = "bare asyncio.Protocol"

    def __init__(self, questions: Sequence[Question], silence: float = 0.0) -> None:
        self._silence = silence
        self._timer: KernelTimer | None = None
        self._sends = [ask.request for ask in questions]
        self._replies = [b"".join(ask.reply) for ask in questions]
        self._closings = [ask.closing for ask in questions]
        self._buffer = b""
        self._left = 0
        self._next = 0
        self._wrong = 0
        self._done: asyncio.Future[int] | None = None
        self._transport: asyncio.Transport | None = None

    async def open(self, endpoint: Endpoint) -> None:
        self._transport = await endpoint.open(lambda: self)
        if self._silence:
            self._timer = kernel_timer(asyncio.get_running_loop(), self._on_silence)

    def _on_silence(self) -> None:
        assert self._timer is not None
        assert self._transport is not None
        if self._timer.has_expired():
            self._transport.write(self._sends[self._next])

    def data_received(self, data: bytes) -> None:
        buffer = self._buffer = self._buffer + data
        reply = self._replies[self._next]
        if len(buffer) < len(reply):
            return
        self._buffer = b""
        if buffer != reply:
            self._wrong += 1
        send = self._closings[self._next]
        self._next = (self._next + 1) % len(self._sends)
        self._left -= 1
        if self._left and self._timer is not None:
            self._timer.set(time.monotonic() + self._silence)
        elif self._left:
            send += self._sends[self._next]
        if send:
            self._transport.write(send)  # type: ignore[union-attr]  # it is open: bytes came
        if not self._left and self._done is not None:
            self._done.set_result(self._wrong)

    async def run(self, transactions: int) -> int:
        assert self._transport is not None
        self._left = transactions
        self._wrong = 0
        self._done = asyncio.get_running_loop().create_future()
        self._transport.write(self._sends[self._next])
        return await self._done

    async def close(self) -> None:
        assert self._transport is not None
        if self._timer is not None:
            asyncio.get_running_loop().remove_reader(self._timer.descriptor)
            self._timer.close()
        self._transport.close()
        await asyncio.sleep(0)


class Streams:
    """A lock, a StreamReader and a StreamWriter, `callers` tasks at it."""

    def __init__(self, questions: Sequence[Question], callers: int = 4) -> None:
        self.name = "lock and streams" if callers > 1 else "lock and streams, one caller"
        self._asks = questions
        self._callers = callers
        self._lock = asyncio.Lock()
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None

    async def open(self, endpoint: Endpoint) -> None:
        if isinstance(endpoint, SerialPort):
            opened = await serial_asyncio.open_serial_connection(url=endpoint.path, baudrate=endpoint.baudrate)
        elif isinstance(endpoint, TcpPort):
            opened = await asyncio.open_connection(endpoint.host, endpoint.port)
        else:
            assert isinstance(endpoint, SocketPort)
            opened = await asyncio.open_connection(sock=endpoint.sock)
        self._reader, self._writer = opened

    async def run(self, transactions: int) -> int:
        share, left = divmod(transactions, self._callers)
        return sum(await asyncio.gather(*(self._call(n, share + (n < left)) for n in range(self._callers))))

    async def _call(self, number: int, transactions: int) -> int:
        wrong = 0
        for n in range(transactions):
            ask = self._asks[(number + n) % len(self._asks)]
            wrong += await self._ask(ask) != ask.value
        return wrong

    async def _ask(self, ask: Question) -> float:
        assert self._reader is not None
        assert self._writer is not None
        async with self._lock:
            self._writer.write(ask.request)
            await self._writer.drain()
            async with asyncio.timeout(REPLY_DEADLINE):
                reply = await self._reader.readuntil(b"\x03") + await self._reader.readexactly(1)
        return float(reply[3:-2])

    async def close(self) -> None:
        assert self._writer is not None
        self._writer.close()
        await asyncio.sleep(0)


class Blocking:
    """pyserial, or a plain socket, in a loop of its own."""

    name = "blocking pyserial"

    def __init__(self, questions: Sequence[Question]) -> None:
        self._asks = questions
        self._write: Callable[[bytes], Any] | None = None
        self._read: Callable[[], bytes] | None = None
        self._port: serial.Serial | socket.socket | None = None

    async def open(self, endpoint: Endpoint) -> None:
        assert isinstance(endpoint, SerialPort)
        port = serial.Serial(endpoint.path, endpoint.baudrate, timeout=REPLY_DEADLINE)
        self._port = port
        self._write = port.write
        self._read = lambda: bytes(port.read_until(b"\x03") + port.read(1))

    async def run(self, transactions: int) -> int:
        assert self._write is not None
        assert self._read is not None
        wrong = 0
        for n in range(transactions):
            ask = self._asks[n % len(self._asks)]
            self._write(ask.request)
            wrong += float(self._read()[3:-2]) != ask.value
        return wrong

    async def close(self) -> None:
        assert self._port is not None
        self._port.close()
