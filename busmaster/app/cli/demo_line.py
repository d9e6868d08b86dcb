"""The line of the demo, in a process of its own: `python -m busmaster.app.cli.demo_line`.

Eight drives on a pseudo-terminal at 57600 baud: three Mint controllers whose axes swing, and five MicroFlex drives.
One of them loses its wire for a few seconds now and then. Prints the terminal's path; ends when its input ends.
"""

from __future__ import annotations

import contextlib
import os
import random
import select
import sys

from busmaster import LineSettings
from busmaster.emulator import Delay, Line, LineServer, serve_pty
from busmaster.ext import make_device

CONTROLLERS = range(1, 4)
DRIVES = range(4, 9)
SETTINGS = LineSettings(57600)
LOSES_ITS_WIRE = 7
UP_FOR, AWAY_FOR = 15.0, 6.0
"""Seconds."""


def make_line(seed: int = 1) -> Line:
    """Make the line, not yet served."""
    delay = Delay(0.001, 0.004)
    line = Line(SETTINGS, chance=random.Random(seed))
    for address in CONTROLLERS:
        line.add(make_device("hcp2", address, delay=delay, lively=True))
    for address in DRIVES:
        line.add(make_device("microflex", address, delay=delay, ripple=0.02))
    return line


def input_ended(within: float) -> bool:
    """Wait this many seconds for the end of standard input, and return whether it was reached."""
    readable, _, _ = select.select([sys.stdin], (), (), within)
    return bool(readable) and not os.read(sys.stdin.fileno(), 1)


def unplug(server: LineServer, address: int) -> None:
    """Cut the wire of one drive."""
    server.call(lambda line, now: line.cut(now, line.device(address)))


def plug_in(server: LineServer) -> None:
    """Fix the wire that was cut."""
    server.call(lambda line, now: line.restore(now))


def main() -> None:
    """Serve the line until standard input ends. One drive loses its wire again and again."""
    with serve_pty(make_line()) as server:
        print(server.path, flush=True)
        while not input_ended(UP_FOR):
            unplug(server, LOSES_ITS_WIRE)
            if input_ended(AWAY_FOR):
                return
            plug_in(server)


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):  # who started this has ended already
        main()
