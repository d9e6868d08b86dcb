"""A line that is owned and served by a process of its own: what others pay for asking through its socket.

`python -m benchmarks.owned_line` is told the port in a line of JSON, and prints the socket's address. Each further line
is an order: {"reads": 100} has it read so often itself, one after the other, and print the seconds that each took.
"""

from __future__ import annotations

import asyncio
import json
import sys
import tempfile
import time
import warnings
from pathlib import Path

from busmaster import Bus, Requester, SerialPort, Service
from busmaster.protocols.modbus.codec import PROFILE, ReadRegisters

READ = ReadRegisters(7, 1)
UNIT = 1
PAUSE = 0.01
"""Seconds between two reads: the line is idle when one is asked for, and what it costs hides behind no silence."""


async def read(node: Requester, count: int) -> list[float]:
    """Read so often, with a pause before each, and return the seconds that each took."""
    took = []
    for _ in range(count):
        await asyncio.sleep(PAUSE)
        begun = time.perf_counter()
        await node.request(READ)
        took.append(time.perf_counter() - begun)
    return took


async def serve() -> None:
    order = json.loads(sys.stdin.readline())
    with tempfile.TemporaryDirectory() as folder:
        async with (
            Bus(SerialPort(order["port"], baudrate=57600, paced=False)) as bus,
            Service(bus, path=Path(folder, "line.sock")) as service,
        ):
            warnings.simplefilter("ignore")  # a pty refuses Modbus's parity
            node = bus.node(PROFILE, UNIT)
            print(json.dumps(service.address), flush=True)
            while said := await asyncio.to_thread(sys.stdin.readline):
                print(json.dumps(await read(node, json.loads(said)["reads"])), flush=True)


if __name__ == "__main__":
    asyncio.run(serve())
