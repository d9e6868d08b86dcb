"""The master, in a process of its own: `python -m tests.real_wire.master PROTOCOL PATH`; PATH `memory` for no port.

Keeps the line saturated with equal reads of all nodes, writes now and then, also to a node that does not exist, and
prints a line for each outcome: what, node, element, value, when it was asked and when it ended. After a line of input,
`stop`, it stops itself where it hurts most: between the arbiter's word and the bytes leaving. Ends with its input.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any

from busmaster import Bus, BusError, SerialPort, TcpPort
from busmaster.emulator.memory import MemoryPort
from busmaster.transport.endpoints import Endpoint
from tests.real_wire.kinds import KINDS, Kind, make_line
from tests.real_wire.slaves import tell
from tests.verification.campaigns.kinds import elements_of

READS, WRITES = 60, 20
"""How many of each in a row: all callers read at a time, and write at a time, so that answers are alike."""
BREATH = 0.01
"""Seconds that a caller waits after an error."""
ABSENT_EVERY = 1.0
"""Seconds between writes to a node that does not exist."""


class Caller:
    """What is asked of one line. Numbers that are written are never written twice, as far as they go."""

    def __init__(self, kind: Kind, bus: Bus) -> None:
        self._kind = kind
        self._bus = bus
        self._numbers: Iterator[int] = count(1)

    async def ask(self, address: int) -> None:
        """One node, without end."""
        for number in count():
            if number % (READS + WRITES) < READS:
                await self._read(address)
            else:
                await self.write(address)

    async def disturb(self) -> None:
        """Write to nobody, without end."""
        while self._kind.absent is not None:
            await self.write(self._kind.absent)
            await asyncio.sleep(ABSENT_EVERY)

    async def _read(self, address: int) -> None:
        node, read = self._bus.node(self._kind.profile, address), self._kind.read
        asked = time.monotonic()
        try:
            value = int(await node.request(read))
        except BusError as error:
            _print("failed", address, type(error).__name__, 0, asked)
            await asyncio.sleep(BREATH)
        else:
            _print("value", address, elements_of(read)[0], value, asked)

    async def write(self, address: int) -> None:
        number = next(self._numbers) % (self._kind.modulus // 10)
        command = self._kind.write(number)
        asked = time.monotonic()
        try:
            await self._bus.node(self._kind.profile, address).request(command)
        except BusError as error:
            _print("unwritten", address, type(error).__name__, number, asked)
            await asyncio.sleep(BREATH)
        else:
            _print("written", address, elements_of(command)[0], number, asked)


def _print(what: str, node: int, of: object, value: int, asked: float) -> None:
    sys.stdout.write(f"{what} {node} {of} {value} {asked:.6f} {time.monotonic():.6f}\n")


class StoppingPort:
    """An endpoint whose next write, once `armed`, is preceded by a standstill of the whole process."""

    def __init__(self, port: Endpoint) -> None:
        self.armed = False
        self._port = port

    def __getattr__(self, name: str) -> Any:
        return getattr(self._port, name)

    async def open(self, protocol_factory: Callable[[], asyncio.Protocol], *whose: Any) -> asyncio.Transport:
        transport = await self._port.open(protocol_factory, *whose)
        write = transport.write

        def stop_and_write(data: bytes) -> None:
            if self.armed:
                self.armed = False
                os.kill(os.getpid(), signal.SIGSTOP)
            write(data)

        transport.write = stop_and_write  # type: ignore[method-assign, assignment]  # of this one
        return transport


def endpoint(protocol: str, path: str) -> Endpoint:
    if path == "memory":
        return MemoryPort(make_line(protocol, tell))
    if path.startswith("socket://"):
        host, port = path.removeprefix("socket://").rsplit(":", 1)
        return TcpPort(host, int(port))
    line = KINDS[protocol].profile.line
    return SerialPort(path, baudrate=line.baudrate, bytesize=line.bytesize, parity=line.parity)


async def run(protocol: str, path: str) -> None:
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]  # a pipe is a TextIOWrapper
    kind = KINDS[protocol]
    port = StoppingPort(endpoint(protocol, path))
    ended = asyncio.Event()

    def obey() -> None:
        if sys.stdin.readline():
            port.armed = True
        else:
            asyncio.get_running_loop().remove_reader(sys.stdin.fileno())
            ended.set()

    async with Bus(port, seed=1) as bus:
        caller = Caller(kind, bus)
        tasks = [asyncio.ensure_future(caller.ask(address)) for address in kind.addresses]
        tasks.append(asyncio.ensure_future(caller.disturb()))
        asyncio.get_running_loop().add_reader(sys.stdin.fileno(), obey)
        await ended.wait()
        for task in tasks:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task


if __name__ == "__main__":
    asyncio.run(run(*sys.argv[1:]))
