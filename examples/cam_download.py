"""Load a CAM table into an MSC controller: in blocks of 32 values, verified, while other traffic continues.

    python examples/cam_download.py [PORT]    such as /dev/ttyS0; without one, emulated

With a PORT it OVERWRITES the data of unit 3 from address 3000 on. Load a table while no program uses it.
"""

import math
import sys

import anyio

from busmaster import Bus, BusLike, Endpoint, MemoryPort, MscController, endpoint
from busmaster.emulator.line import Line
from busmaster.registry import make_device

TABLE = [round(1000 * math.sin(2 * math.pi * step / 64)) for step in range(64)]
SETTINGS = MscController.profile.line  # 9600 8N1


def show(done: int, total: int) -> None:
    print(f"{done:4} of {total}: {'#' * (40 * done // total)}")


async def main(bus: BusLike) -> None:
    # The address step is not in the manual: it is 4 if addresses count bytes. `find_address_step` finds it.
    press = MscController(bus, 3, symbols={"cam": 3000}, address_step=4)
    await press.load_cam("cam", TABLE, progress=show)  # writes and verifications both count
    print("the first values are", await press.read("cam", 8))


def emulated() -> MemoryPort:
    return MemoryPort(Line(SETTINGS, [make_device("msc", 3)]))


async def on_port(port: Endpoint) -> None:
    async with Bus(port) as bus:
        await main(bus)


if __name__ == "__main__":
    anyio.run(on_port, endpoint(sys.argv[1], defaults=SETTINGS) if sys.argv[1:] else emulated())
