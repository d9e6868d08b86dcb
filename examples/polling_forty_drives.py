"""Poll forty drives on one line, one of them dead: the others do not wait for it.

    python examples/polling_forty_drives.py [PORT]    such as /dev/ttyUSB0; without one, emulated

It writes nothing.
"""

import logging
import sys

import anyio

from busmaster import Bus, BusLike, Endpoint, MemoryPort, MicroFlexDrive, endpoint
from busmaster.emulator.line import Line
from busmaster.registry import make_device

NODES = range(1, 41)
CYCLES = 4


async def main(bus: BusLike) -> None:
    drives = [MicroFlexDrive(bus, node) for node in NODES]
    group = bus.poll_group("speeds", period=0.4, points=[drive.speed_measured for drive in drives])
    async for snapshot in group:  # a snapshot a cycle; `group.latest` has the last one without waiting
        speeds = [sample.value for sample in snapshot.values() if sample.error is None]
        took = snapshot.finished - snapshot.due
        print(f"cycle {snapshot.cycle}: {len(speeds)} of {len(snapshot)} drives in {took * 1000:.0f} ms")
        if snapshot.cycle == CYCLES:
            break
    group.close()
    print({drive.node.label: sample.value for drive, sample in zip(drives[:4], snapshot.values(), strict=False)})
    print(f"{snapshot.missed} cycles missed, line {(await bus.statistics()).utilisation:.0%} in use")


def emulated() -> MemoryPort:
    line = Line(MicroFlexDrive.profile.line, [make_device("microflex", node, lively=True) for node in NODES])
    line.device(13).faults.dead = 1.0
    return MemoryPort(line)


async def on_port(port: Endpoint) -> None:
    async with Bus(port) as bus:
        await main(bus)


if __name__ == "__main__":
    logging.basicConfig(stream=sys.stdout, format="log: %(message)s")  # speaks when a node goes or comes back
    anyio.run(on_port, endpoint(sys.argv[1], defaults=MicroFlexDrive.profile.line) if sys.argv[1:] else emulated())
