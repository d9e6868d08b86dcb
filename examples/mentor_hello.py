"""Mentor II: parameters by menu and number, with their decimals, and one that the drive does not have.

    python examples/mentor_hello.py [PORT]   such as /dev/ttyS0 or socket://10.0.0.5:4001; without one, emulated

With a PORT it writes the speed reference 1.17 of the drive at address 14: a motor that is enabled TURNS.
"""

import sys

import anyio

from busmaster import Bus, Endpoint, MemoryPort, MentorDrive, NoSuchParameter, endpoint
from busmaster.emulator.line import Line
from busmaster.registry import make_device

DECIMALS = {"1.17": 1, "3.02": 1}  # the line carries whole numbers: these have one decimal, so that values are in %


async def main(port: Endpoint) -> None:
    async with Bus(port) as bus:
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


if __name__ == "__main__":
    settings = MentorDrive.profile.line  # 9600 7E1
    emulated = MemoryPort(Line(settings, [make_device("mentor", 14)]))
    anyio.run(main, endpoint(sys.argv[1], defaults=settings) if sys.argv[1:] else emulated)
