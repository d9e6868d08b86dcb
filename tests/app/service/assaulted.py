"""The owner of a line that is served, as a process: `python -m tests.app.service.assaulted PORT SOCKET`.

It polls a group, and keeps a record of all writes. It prints its socket's address; each line of its input is answered
with how it is, as an object of JSON; when that ends, it ends, and prints all records.
"""

from __future__ import annotations

import asyncio
import json
import os
import resource
import sys
import warnings
from typing import Any

from benchmarks.watch import Watch, watched
from busmaster import Bus, SerialPort, Service
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.record import WriteRecord
from busmaster.bus.points import Point
from busmaster.protocols.modbus.codec import PROFILE, ReadRegisters
from tests.app.service.writing import UNIT, say

PERIOD = 0.5
POINTS = 5


async def own(watch: Watch) -> int:
    port, path = sys.argv[1:]
    async with Bus(SerialPort(port, baudrate=57600, paced=False)) as bus:
        authorisation, records = Authorisation(bus), list[WriteRecord]()
        authorisation.record = records.append
        async with Service(bus, authorisation=authorisation, path=path) as service:
            node = bus.node(PROFILE, UNIT)
            points: list[Point[Any]] = [Point(node, str(number), ReadRegisters(number, 1)) for number in range(POINTS)]
            group = bus.poll_group("registers", period=PERIOD, points=points)
            say(service.address)
            longest = 0.0
            watch.take()
            while await asyncio.to_thread(sys.stdin.readline):
                counts = group.statistics()
                longest = max(longest, watch.take().own)
                said = {
                    "cycles": counts.cycles,
                    "missed": counts.missed,
                    "bad": counts.bad,
                    "clients": len(service.clients),
                    "refused": service.refused,
                    "strangers": service.strangers,
                    "tasks": len(asyncio.all_tasks()),
                    "descriptors": len(os.listdir("/proc/self/fd")),
                    "kilobytes": _resident(),
                    "backlog": (await bus.statistics()).backlog,
                    "longest hold, ms": round(longest, 3),
                }
                say(json.dumps(said))
    say(json.dumps([(record.value, record.outcome.value) for record in records]))
    return 0


def _resident() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() // 1024


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # a pty refuses Modbus's parity
    watched(own)
