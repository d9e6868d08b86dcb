"""Start several Mentor II drives at the same moment: one telegram to all of them.

    python examples/synchronised_start.py [PORT]    such as /dev/ttyS0; without one, emulated

Drives do not reply to a broadcast, so the program reads each drive afterwards to check that it received the value.

With a PORT it gives drives 11, 12 and 13 a speed reference of 20 %: motors that are enabled TURN.
"""

import sys

import anyio

from busmaster import Bus, BusLike, Endpoint, MemoryPort, MentorDrive, endpoint
from busmaster.emulator.line import Line
from busmaster.registry import make_device

ADDRESSES = (11, 12, 13)
REFERENCE, FEEDBACK = "1.17", "3.02"
DECIMALS = {REFERENCE: 1, FEEDBACK: 1}  # both in % with one decimal
SETTINGS = MentorDrive.profile.line  # 9600 7E1


async def set_all(bus: BusLike, drives: list[MentorDrive], percent: float) -> None:
    """Write to address 0, then separately to each drive that did not receive it."""
    await MentorDrive(bus, 0, decimals=DECIMALS).write(REFERENCE, percent)
    for drive in drives:
        if await drive.read(REFERENCE) != percent:
            print(drive.node.label, "missed it")
            await drive.write(REFERENCE, percent, verify=True)


async def main(bus: BusLike) -> None:
    drives = [MentorDrive(bus, address, decimals=DECIMALS) for address in ADDRESSES]
    await set_all(bus, drives, 20.0)
    for _ in range(3):
        print([await drive.read(FEEDBACK) for drive in drives], "%")
    await set_all(bus, drives, 0.0)


def emulated() -> MemoryPort:
    return MemoryPort(Line(SETTINGS, [make_device("mentor", address) for address in ADDRESSES]))


async def on_port(port: Endpoint) -> None:
    async with Bus(port) as bus:
        await main(bus)


if __name__ == "__main__":
    anyio.run(on_port, endpoint(sys.argv[1], defaults=SETTINGS) if sys.argv[1:] else emulated())
