"""MSC: data by the names of the controller's program, flags, and the program's status.

    python examples/msc_hello.py [PORT]      such as /dev/ttyS0 or socket://10.0.0.5:4001; without one, emulated

With a PORT it writes the data address 2008 and sets and clears flag 200 of unit 3.
"""

import sys

import anyio

from busmaster import Bus, BusLike, Endpoint, MemoryPort, MscController, endpoint
from busmaster.emulator.line import Line
from busmaster.protocols.msc import ProgramStatus
from busmaster.registry import make_device

SETTINGS = MscController.profile.line  # 9600 8N1


async def main(bus: BusLike) -> None:
    press = MscController(bus, 3, symbols={"count": 2000, "length": 2008}, address_step=4)
    status = await press.status()
    print("the program is", "running" if ProgramStatus.PROGRAM_RUNNING in status else "not running")
    await press.write("length", 1234)
    print("length is", await press.read("length"))
    await press.set_flag(200)
    print("flag 200 is", await press.flag(200))
    await anyio.sleep(0.3)
    print("count is", await press.read("count"))
    await press.clear_flag(200)


def emulated() -> MemoryPort:
    return MemoryPort(Line(SETTINGS, [make_device("msc", 3)]))


async def on_port(port: Endpoint) -> None:
    async with Bus(port) as bus:
        await main(bus)


if __name__ == "__main__":
    anyio.run(on_port, endpoint(sys.argv[1], defaults=SETTINGS) if sys.argv[1:] else emulated())
