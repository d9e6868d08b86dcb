"""A program that writes to another's line until it is killed: `python -m tests.app.service.writing ADDRESS REGISTER`.

It writes 1, 2, 3 and so on to the register, a few at a time, and prints a line once the first is confirmed.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys

from busmaster import BusError, connect
from busmaster.protocols.modbus.codec import PROFILE, WriteRegisters

AT_ONCE = 8
UNIT = 1


def say(text: str) -> None:
    """Tell whoever has started this process."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


async def write(address: str, register: int) -> None:
    async with connect(address) as bus:
        node, number = bus.node(PROFILE, UNIT), 0

        async def go_on() -> None:
            nonlocal number
            while number < 65535:
                number += 1
                with contextlib.suppress(BusError):  # its record says how it ended
                    await node.request(WriteRegisters(register, (number,)))
                if number <= AT_ONCE:
                    say("writing")

        await asyncio.gather(*(go_on() for _ in range(AT_ONCE)))


if __name__ == "__main__":
    asyncio.run(write(sys.argv[1], int(sys.argv[2])))
