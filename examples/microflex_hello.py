"""MicroFlex: enable a drive, turn its motor for a moment, and always disable it.

    python examples/microflex_hello.py [PORT]    such as /dev/ttyUSB0 or socket://10.0.0.5:4001; without one, emulated

With a PORT it TURNS THE MOTOR of node 7 at 10 % of its maximum speed.
"""

import sys

import anyio

from busmaster import Bus, BusLike, Endpoint, MemoryPort, MicroFlexDrive, endpoint
from busmaster.emulator.line import Line
from busmaster.registry import make_device

SETTINGS = MicroFlexDrive.profile.line  # 57600 8N1


async def main(bus: BusLike) -> None:
    drive = MicroFlexDrive(bus, 7)
    print("firmware build", await drive.check_firmware())
    try:
        status = await drive.enable()  # returns when the drive's status word confirms it
        print("status:", status.name)
        await drive.set_speed_reference(10.0)
        for _ in range(4):
            await anyio.sleep(0.05)
            print(f"{await drive.speed_measured.read():.2f} %")
    finally:
        with anyio.CancelScope(shield=True):  # the motor stops even if this task is cancelled
            status = await drive.disable()  # before anything else on the line, and verified
        print("status:", status.name)


def emulated() -> MemoryPort:
    return MemoryPort(Line(SETTINGS, [make_device("microflex", 7)]))


async def on_port(port: Endpoint) -> None:
    async with Bus(port) as bus:
        await main(bus)


if __name__ == "__main__":
    anyio.run(on_port, endpoint(sys.argv[1], defaults=SETTINGS) if sys.argv[1:] else emulated())
