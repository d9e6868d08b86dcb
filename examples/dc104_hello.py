"""DC104: the one drive of its line, which has no address; registers of 16 bits.

    python examples/dc104_hello.py [PORT]    such as /dev/ttyS0 or socket://10.0.0.5:4001; without one, emulated

With a PORT it writes parameter 12 with its current value.
"""

import sys

import anyio

from busmaster import Bus, BusLike, Dc104Drive, Endpoint, InvalidCommand, MemoryPort, endpoint
from busmaster.emulator.line import Line
from busmaster.registry import make_device

SETTINGS = Dc104Drive.profile.line  # 19200 8N1


async def main(bus: BusLike) -> None:
    drive = Dc104Drive(bus)
    value = await drive.read(12)
    print("parameter 12 is", value)
    await drive.write(12, value, verify=True)  # the drive acknowledges when it has stored the value: up to 0.5 s
    print("stored and read back")
    try:
        await drive.write(12, -1)
    except InvalidCommand as error:  # nothing was sent
        print(error)


def emulated() -> MemoryPort:
    return MemoryPort(Line(SETTINGS, [make_device("dc104", 0)]))


async def on_port(port: Endpoint) -> None:
    async with Bus(port) as bus:
        await main(bus)


if __name__ == "__main__":
    anyio.run(on_port, endpoint(sys.argv[1], defaults=SETTINGS) if sys.argv[1:] else emulated())
