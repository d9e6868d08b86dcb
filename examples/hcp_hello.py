"""HCP: write to the comms array of a controller, several elements at once, and read it back.

    python examples/hcp_hello.py [PORT]      such as /dev/ttyUSB0 or socket://10.0.0.5:4001; without one, emulated

With a PORT it writes Comms(10) to Comms(12) of node 2.
"""

import sys

import anyio

from busmaster import Bus, BusLike, Endpoint, HcpController, MemoryPort, endpoint
from busmaster.emulator.line import Line
from busmaster.registry import make_device

SETTINGS = HcpController.profile.line  # 57600 8N1


async def main(bus: BusLike) -> None:
    winder = HcpController(bus, 2)
    await winder.write(10, 123.456, -0.5, 1200)  # three elements in one telegram; the controller's ACK is awaited
    print("Comms(10) is", await winder.read(10))
    print("Comms(11) is", await winder.read(11))
    await winder.point("12").write(1500)  # the same, as a point: it can be read, polled and written
    print("Comms(12) is", await winder.point("12").read())


def emulated() -> MemoryPort:
    return MemoryPort(Line(SETTINGS, [make_device("hcp", 2)]))


async def on_port(port: Endpoint) -> None:
    async with Bus(port) as bus:
        await main(bus)


if __name__ == "__main__":
    anyio.run(on_port, endpoint(sys.argv[1], defaults=SETTINGS) if sys.argv[1:] else emulated())
