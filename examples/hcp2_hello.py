"""HCP2: elements by number, the extended comms array by name, a verified value, and a refused one.

    python examples/hcp2_hello.py [PORT]     such as /dev/ttyUSB0 or socket://10.0.0.5:4001; without one, emulated

With a PORT it writes Comms(1) of node 5.
"""

import sys

import anyio

from busmaster import Bus, BusLike, Endpoint, Hcp2Controller, MemoryPort, Refused, endpoint
from busmaster.emulator.line import Line
from busmaster.registry import make_device

SETTINGS = Hcp2Controller.profile.line  # 57600 8N1


async def main(bus: BusLike) -> None:
    controller = Hcp2Controller(bus, 5)
    await controller.write(1, 123.456, verify=True)  # acknowledged, read back and compared
    print("Comms(1) is", await controller.read(1))
    position = controller.axis(0).position  # a point: it can be read, polled, and written if the map allows it
    print(f"{position.item} is {await position.read():.1f}")
    try:
        await controller.write(100, 0.0)
    except Refused as error:
        print(error)


def emulated() -> MemoryPort:
    return MemoryPort(Line(SETTINGS, [make_device("hcp2", 5, lively=True)]))


async def on_port(port: Endpoint) -> None:
    async with Bus(port) as bus:
        await main(bus)


if __name__ == "__main__":
    anyio.run(on_port, endpoint(sys.argv[1], defaults=SETTINGS) if sys.argv[1:] else emulated())
