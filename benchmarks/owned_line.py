"""A line that is owned and served by a process of its own: what others pay for asking through its socket.

`python -m benchmarks.owned_line` reads the port from a line of JSON (with `"library": true`, the library reads all
frames), and prints the socket's address, and the path of a
bare one, where whatever comes is answered, after the same read, with as many bytes as an answer has. Each further line
is an order: {"reads": 100} has it read so often itself, one after the other, and print the seconds that each took;
{"polls": true} has it read a poll group ten times a second, until {"polls": false}; {"saturate": 2.5} has several
callers read for so many seconds, and prints how often they did, and each hold of its loop in milliseconds.
"""

from __future__ import annotations

import asyncio
import json
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any, cast

from benchmarks.library_frames import LibraryIncomingConnection
from benchmarks.watch import Watch, watched
from busmaster import Bus, Node, Point, PollGroup, SerialPort, Service
from busmaster.app.service import client_connection
from busmaster.ext import Request, Requester
from busmaster.protocols.modbus.codec import PROFILE, ReadRegisters

READ = ReadRegisters(7, 1)
UNIT = 1
BARE_REQUEST, BARE_ANSWER = bytes(190), bytes(45)
"""As long as those of the service."""
PAUSE = 0.01
"""Seconds between two reads: the line is idle when one is asked for, and what it costs hides behind no silence."""
CALLERS = 4
GROUP = "registers"
POINTS = 10
PERIOD = 0.1


async def read(node: Requester, count: int) -> list[float]:
    """Read so often, with a pause before each, and return the seconds that each took."""
    took = []
    for _ in range(count):
        await asyncio.sleep(PAUSE)
        begun = time.perf_counter()
        await node.request(READ)
        took.append(time.perf_counter() - begun)
    return took


class Bare(asyncio.BufferedProtocol):
    """One end of a bare socket: one read for whatever comes, without words, and nothing checked. It cannot cost less.

    It is itself what is told of the read.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._buffer = memoryview(bytearray(512))
        self._transport: asyncio.Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._buffer

    def buffer_updated(self, count: int) -> None:
        self._node._start(Request(READ), self)

    def done(self) -> bool:
        return False

    def set_result(self, value: object, /) -> None:
        self._transport.write(BARE_ANSWER)

    def set_exception(self, error: BaseException, /) -> None:
        raise error


class Owner:
    """What the process does with its line."""

    def __init__(self, bus: Bus, watch: Watch) -> None:
        self._bus = bus
        self._watch = watch
        self.node: Node = bus.node(PROFILE, UNIT)
        self._group: PollGroup | None = None

    async def obey(self, order: dict[str, Any]) -> Any:
        """Return the answer to an order."""
        if "reads" in order:
            return await read(self.node, order["reads"])
        if "saturate" in order:
            return await self._saturate(order["saturate"])
        if self._group is not None:
            self._group.close()
        self._group = self._polled() if order["polls"] else None
        return True

    def _polled(self) -> PollGroup:
        numbers = range(POINTS)
        points: list[Point[Any]] = [Point(self.node, str(number), ReadRegisters(number, 1)) for number in numbers]
        return self._bus.poll_group(GROUP, period=PERIOD, points=points)

    async def _saturate(self, seconds: float) -> dict[str, Any]:
        until = time.monotonic() + seconds

        async def ask() -> int:
            count = 0
            while time.monotonic() < until:
                await self.node.request(READ)
                count += 1
            return count

        holds: list[float] = []
        self._watch.each = holds
        before = (await self._bus.statistics()).exchanges
        begun = time.monotonic()
        await asyncio.gather(*(ask() for _ in range(CALLERS)))
        took = time.monotonic() - begun
        self._watch.each = None
        return {"rate": ((await self._bus.statistics()).exchanges - before) / took, "holds": holds}


async def serve(watch: Watch) -> int:
    order = json.loads(sys.stdin.readline())
    if order.get("library"):
        client_connection.IncomingConnection = LibraryIncomingConnection  # type: ignore[attr-defined]  # for this process
    with tempfile.TemporaryDirectory() as folder:
        async with (
            Bus(SerialPort(order["port"], baudrate=57600, paced=False)) as bus,
            Service(bus, path=Path(folder, "line.sock")) as service,
        ):
            warnings.simplefilter("ignore")  # a pty refuses Modbus's parity
            owner = Owner(bus, watch)
            bare = f"{folder}/bare.sock"
            server = await asyncio.get_running_loop().create_unix_server(lambda: Bare(owner.node), bare)
            print(json.dumps((service.address, bare)), flush=True)
            while said := await asyncio.to_thread(sys.stdin.readline):
                print(json.dumps(await owner.obey(json.loads(said))), flush=True)
            server.close()
    return 0


if __name__ == "__main__":
    watched(serve)
