"""CT-ANSI (Unidrive, Commander): parameters by menu and number, with the drive's decimal points.

    python examples/ct_ansi_hello.py [PORT]  such as /dev/ttyUSB0 or socket://10.0.0.5:4001; without one, emulated

With a PORT it writes the preset reference 01.21 of drive 12.
"""

import sys

import anyio

from busmaster import Bus, BusLike, CtAnsiDrive, Endpoint, MemoryPort, NoSuchParameter, endpoint
from busmaster.emulator.line import Line
from busmaster.registry import make_device

SETTINGS = CtAnsiDrive.profile.line  # 9600 7E1


async def main(bus: BusLike) -> None:
    drive = CtAnsiDrive(bus, 12, decimals={"1.21": 1})  # values written to 01.21 are rounded to one decimal
    await drive.write("1.21", -47.64, verify=True)
    print("01.21 is", await drive.read("1.21"))
    print("01.21 to 01.23 are", await drive.read("1.21", 3))
    try:
        await drive.read("17.23")
    except NoSuchParameter as error:
        print(error)


def emulated() -> MemoryPort:
    return MemoryPort(Line(SETTINGS, [make_device("ct-ansi", 12)]))


async def on_port(port: Endpoint) -> None:
    async with Bus(port) as bus:
        await main(bus)


if __name__ == "__main__":
    anyio.run(on_port, endpoint(sys.argv[1], defaults=SETTINGS) if sys.argv[1:] else emulated())
