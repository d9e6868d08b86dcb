"""A line that is owned and served by a process of its own: what others pay for asking through its socket.

`python -m benchmarks.owned_line` is told the port in a line of JSON, and prints the socket's address. Each further line
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
from typing import Any

from benchmarks.watch import Watch, watched
from busmaster import Bus, PollGroup, Requester, SerialPort, Service
from busmaster.bus.node import Node
from busmaster.bus.points import Point
from busmaster.protocols.modbus.codec import PROFILE, ReadRegisters

READ = ReadRegisters(7, 1)
UNIT = 1
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


class Owner:
    """What the process does with its line."""

    def __init__(self, bus: Bus, watch: Watch) -> None:
        self._bus = bus
        self._watch = watch
        self._node: Node = bus.node(PROFILE, UNIT)
        self._group: PollGroup | None = None

    async def obey(self, order: dict[str, Any]) -> Any:
        """Return the answer to an order."""
        if "reads" in order:
            return await read(self._node, order["reads"])
        if "saturate" in order:
            return await self._saturate(order["saturate"])
        if self._group is not None:
            self._group.close()
        self._group = self._polled() if order["polls"] else None
        return True

    def _polled(self) -> PollGroup:
        numbers = range(POINTS)
        points: list[Point[Any]] = [Point(self._node, str(number), ReadRegisters(number, 1)) for number in numbers]
        return self._bus.poll_group(GROUP, period=PERIOD, points=points)

    async def _saturate(self, seconds: float) -> dict[str, Any]:
        until = time.monotonic() + seconds

        async def ask() -> int:
            count = 0
            while time.monotonic() < until:
                await self._node.request(READ)
                count += 1
            return count

        holds: list[float] = []
        self._watch.each = holds
        before = self._bus.statistics().exchanges
        begun = time.monotonic()
        await asyncio.gather(*(ask() for _ in range(CALLERS)))
        took = time.monotonic() - begun
        self._watch.each = None
        return {"rate": (self._bus.statistics().exchanges - before) / took, "holds": holds}


async def serve(watch: Watch) -> int:
    order = json.loads(sys.stdin.readline())
    with tempfile.TemporaryDirectory() as folder:
        async with (
            Bus(SerialPort(order["port"], baudrate=57600, paced=False)) as bus,
            Service(bus, path=Path(folder, "line.sock")) as service,
        ):
            warnings.simplefilter("ignore")  # a pty refuses Modbus's parity
            owner = Owner(bus, watch)
            print(json.dumps(service.address), flush=True)
            while said := await asyncio.to_thread(sys.stdin.readline):
                print(json.dumps(await owner.obey(json.loads(said))), flush=True)
    return 0


if __name__ == "__main__":
    watched(serve)
