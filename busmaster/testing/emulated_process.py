"""An emulated line in a process of its own: `python -m busmaster.testing.emulated_process SPECIFICATION`.

A thread would share the interpreter with the loop that is measured. It prints the path of a pseudo-terminal, and ends
when its standard input ends.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

from busmaster.contract.profile import LineSettings
from busmaster.emulator.device import Delay
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.emulator.serve import serve_pty
from busmaster.errors import LineDown
from busmaster.ext import find, make_device


@dataclass(frozen=True, slots=True)
class EmulatedLine:
    """An emulated line of devices of one protocol, as plain values.

    `delay` is in seconds, lower and upper bound, before each reply, also within an exchange of several steps. `faults`
    are texts such as "lost=0.1", for every device. `seed`: for random delays and faults. Bytes have a duration.
    """

    protocol: str
    nodes: tuple[int, ...] = (1,)
    baudrate: int | None = None
    """The protocol's, if None."""
    delay: tuple[float, float] = (0.002, 0.002)
    faults: tuple[str, ...] = ()
    seed: int = 1

    def settings(self) -> LineSettings:
        """Return baud rate and framing."""
        own = find(self.protocol).profile.line
        return own if self.baudrate is None else replace(own, baudrate=self.baudrate)

    def line(self) -> Line:
        """Make the line. Raises InvalidCommand for nodes, delays and faults that cannot be."""
        delay = Delay(*self.delay)
        # Of a bench, which only reads: the delay of a later step counts, and how long a value is stored does not.
        others: dict[str, Any] = {
            option.name: delay for option in find(self.protocol).emulated if option.kind == "delay"
        }
        devices = [make_device(self.protocol, node, delay=delay, **others) for node in self.nodes]
        for device in devices:
            device.faults = Faults.parse(self.faults)
        return Line(self.settings(), devices, chance=random.Random(self.seed))


@contextmanager
def in_own_process(line: EmulatedLine) -> Iterator[str]:
    """Serve the line in a process of its own while the context lasts, and yield the path of its pseudo-terminal.

    Raises LineDown if it does not start.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", __name__, json.dumps(asdict(line))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,  # Ctrl-C reaches all of a terminal's group; the line is to end after its master
        text=True,
    )
    with process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            path = process.stdout.readline().strip()
            if not path:
                raise LineDown("the emulated line did not start", hint="its own message is above, on standard error")
            yield path
        finally:
            process.stdin.close()
            process.wait()  # Popen's own waits no longer than a quarter of a second for one that Ctrl-C ended


def from_json(text: str) -> EmulatedLine:
    """Return the line that `in_own_process` has written down."""
    fields: dict[str, Any] = json.loads(text)
    for name, value in fields.items():
        fields[name] = tuple(value) if isinstance(value, list) else value  # JSON has no tuples
    return EmulatedLine(**fields)


def main() -> None:
    """Serve the line of the first argument until standard input ends."""
    with serve_pty(from_json(sys.argv[1]).line()) as server:
        print(server.path, flush=True)  # noqa: T201  the parent process reads the path here
        while os.read(sys.stdin.fileno(), 1):
            pass


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):  # the process that started this has ended already
        main()


__all__ = ["EmulatedLine", "in_own_process"]
