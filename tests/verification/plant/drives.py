"""The drives of a LINE.toml in their own process: `python -m tests.verification.plant.drives LINE.toml [telling]`.

They are served as `busmaster emulate` serves them, at the file's port. With `telling`, each value is said only once,
and is printed with the time at which it was said, as is each write that is taken: what the outputs hold is held
against it.
A line of input is an order:

    gone, back        the port, as when an adapter is pulled out
    off NODE, on      the wire to one node, or to all
    garble NODE       each of its replies has a flipped bit
    babble NODE       noise comes now and then, whenever it is asked
    calm              all of them answer as they should again
"""

from __future__ import annotations

import itertools
import random
import sys
import time

from busmaster.app.cli.emulate import own_port, serve
from busmaster.app.config import LineFile, emulated_line, line_settings, load
from busmaster.emulator.device import Device
from busmaster.emulator.faults import CALM, Faults
from busmaster.emulator.line import Line
from busmaster.emulator.traceable import TraceableMemory
from busmaster.registry import make_device

SPAN = 10**11
"""Values of a node begin with its address."""
RATE = 100
"""Values a second that a node never reaches: counted from the machine's clock, none comes again after a restart."""
KEPT = 10
"""From this element on what was written is held; below it each value is another one."""


def tell(*words: object) -> None:
    """Print in one write: the threads of the line tell too."""
    sys.stdout.write(f"{' '.join(map(str, words))} {time.monotonic():.6f}\n")
    sys.stdout.flush()


class TellingMemory(TraceableMemory):
    """The memory of a node that tells what it says and takes."""

    def __init__(self, name: str, address: int) -> None:
        super().__init__(address)
        self._name = name
        self._counter = itertools.count(int(time.monotonic() * RATE))
        self._held: dict[int, float] = {}

    def read(self, element: int) -> int:
        if element >= KEPT:
            return int(self._held.get(element, 0))
        value = self.node * SPAN + next(self._counter)
        tell("said", self._name, element, value)
        return value

    def write(self, element: int, value: float, slack: int = 0) -> None:
        self._held[element] = value
        tell("took", self._name, element, f"{value:g}")


class Drives:
    """The drives of one file, behind its port."""

    def __init__(self, file: LineFile, telling: bool) -> None:
        self._file = file
        self._line = telling_line(file) if telling else emulated_line(file)
        self._usual = [device.faults for device in self._line.devices]
        self._server = serve(self._line, *own_port(file.port))

    @property
    def path(self) -> str:
        return self._server.path

    def obey(self, order: str) -> None:
        word, _, name = order.partition(" ")
        match word:
            case "gone":
                self._server.close()
            case "back":
                self._server = serve(self._line, *own_port(self._file.port))
            case "off":
                device = self._device(name)
                self._server.call(lambda line, now: line.cut(now, device))
            case "on":
                self._server.call(lambda line, now: line.restore(now))
            case "garble":
                self._device(name).faults = Faults(flip=1.0)
            case "babble":
                self._device(name).faults = Faults(babble=0.3)
            case "calm":
                for device, faults in zip(self._line.devices, self._usual, strict=True):
                    device.faults = faults
            case _:
                raise ValueError(f"no such order: {order}")
        tell("obeyed", order)

    def _device(self, name: str) -> Device:
        return self._line.devices[list(self._file.nodes).index(name)]


def telling_line(file: LineFile) -> Line:
    devices = [
        make_device(node.protocol, node.address, traceable=TellingMemory(name, node.address))
        for name, node in file.nodes.items()
    ]
    for device in devices:
        device.faults = CALM
    return Line(line_settings(file), devices, chance=random.Random(1), paced=file.emulator.paced)


def main(path: str, telling: str = "") -> None:
    drives = Drives(load(path), bool(telling))
    tell("serves", drives.path)
    for order in sys.stdin:
        drives.obey(order.strip())


if __name__ == "__main__":
    main(*sys.argv[1:])
