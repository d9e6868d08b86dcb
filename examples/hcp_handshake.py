"""The command handshake of AN00110: data in Comms(2) to (4), then the command in Comms(1), then wait for zero.

    python examples/hcp_handshake.py [PORT]    such as /dev/ttyUSB0; without one, emulated

That note's Mint program clears Comms(1) whether it has seen a command or not: one that is written between its look
and its clearing is lost, although the host sees zero. So the effect is checked, and the command is given again: one
that may be repeated, a move to an absolute position.

With a PORT it MOVES axis 1 of node 2, if that runs that program and keeps POS(1) in Comms(10).
"""

import sys
from collections.abc import Generator

import anyio

from busmaster import Bus, BusLike, Endpoint, HcpController, MemoryPort, endpoint
from busmaster.emulator.line import Line
from busmaster.protocols._comms.device import HCP
from busmaster.protocols._comms.mint import EmulatedMint, command_handshake

MOVE_ABSOLUTE = 1
ATTEMPTS = 100
SETTINGS = HcpController.profile.line


async def move_to(controller: HcpController, target: float, speed: float) -> int:
    """Returns after how many attempts the axis is there."""
    for attempt in range(1, ATTEMPTS + 1):
        await controller.execute(MOVE_ABSOLUTE, speed, target, 0, finish_within=10)
        if abs(await controller.read(10) - target) < 0.001:
            return attempt
    raise TimeoutError(f"the axis is not at {target} after {ATTEMPTS} commands: does the program run?")


async def main(bus: BusLike) -> None:
    controller = HcpController(bus, 2)
    for target in (10.0, 25.0, 0.0):
        attempts = await move_to(controller, target, speed=200.0)
        lost = f", after {attempts - 1} lost in the race" if attempts > 1 else ""
        print(f"moved to {target}{lost}")


def program(mint: EmulatedMint) -> Generator[int, None, None]:
    """The note's, with one more line: Comms(10) = POS(1)."""
    for line in command_handshake(mint):
        mint.comms[10] = mint.axes[1].position(mint.now)
        yield line


def emulated() -> MemoryPort:
    return MemoryPort(Line(SETTINGS, [EmulatedMint(2, HCP, program=program)]))


async def on_port(port: Endpoint) -> None:
    async with Bus(port) as bus:
        await main(bus)


if __name__ == "__main__":
    anyio.run(on_port, endpoint(sys.argv[1], defaults=SETTINGS) if sys.argv[1:] else emulated())
