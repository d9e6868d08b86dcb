"""Mentor II: parameters by menu and number, with their decimals, and a missing parameter.

    python examples/mentor_hello.py [PORT]   such as /dev/ttyS0 or socket://10.0.0.5:4001; without one, emulated

With a PORT it writes the speed reference 1.17 of the drive at address 14: a motor that is enabled TURNS.
"""

import sys

import anyio

from busmaster import Bus, BusLike, Endpoint, MemoryPort, MentorDrive, NoSuchParameter, endpoint
from busmaster.emulator.line import Line
from busmaster.registry import make_device

DECIMALS = {"1.17": 1, "3.02": 1}  # the line carries whole numbers: these have one decimal, so that values are in %
SETTINGS = MentorDrive.profile.line  # 9600 7E1


async def main(bus: BusLike) -> None:
    drive = MentorDrive(bus, 14, decimals=DECIMALS)
    await drive.write("1.17", -47.6)
    print("speed reference", await drive.read("1.17"), "%")
    for _ in range(3):
        await anyio.sleep(0.1)
        print("speed feedback ", await drive.read("3.02"), "%")
    await drive.write("1.17", 0.0)
    try:
        await drive.read("17.23")
    except NoSuchParameter as error:
        print(error)


def emulated() -> MemoryPort:
    return MemoryPort(Line(SETTINGS, [make_device("mentor", 14)]))


async def on_port(port: Endpoint) -> None:
    async with Bus(port) as bus:
        await main(bus)


if __name__ == "__main__":
    anyio.run(on_port, endpoint(sys.argv[1], defaults=SETTINGS) if sys.argv[1:] else emulated())
