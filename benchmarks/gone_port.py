"""What does a serial port cost while its USB adapter is gone, and how soon is it open again when that is back?

On a made /sys tree of 68 ttys, of which 7 are ports of USB adapters, each a pseudo-terminal. The port is named by its
path and by its serial number in turn. An adapter comes back in two steps, as with udev: the kernel describes it, and a
moment later its node is there. The return is measured from the node on, with the loop and both cores free.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.harness import Claim, Options, Outcome, Table
from busmaster import SerialPort
from busmaster.ext import identity
from busmaster.transport.reconnect import Connection

TTYS, BOARD_UARTS, ADAPTERS = 68, 32, 7
GONE = 6.0
"""Seconds for which the processor time is measured."""
AWAY = ((0.35, 0.1), (0.9, 0.3), (1.7, 0.05), (2.6, 0.7), (3.3, 0.2), (2.1, 1.2))
"""Of each return that is measured: seconds until the kernel describes the adapter again, and from there until it has a
node that can be opened. On a busy machine udev takes its time."""
MOST_CPU, MOST_TIMES_THE_PATH = 0.01, 1.5
PATIENCE = 30.0


class Machine:
    """A made /sys and /dev. `plug` and `unplug` act on the adapter that is measured, the last one."""

    def __init__(self, root: Path) -> None:
        self.sys, self.dev = root / "sys", root / "dev"
        for folder in (self.sys / "class/tty", self.sys / "dev/char", self.sys / "devices", self.dev):
            folder.mkdir(parents=True)
        for number in range(TTYS - BOARD_UARTS - ADAPTERS):
            self._describe(f"tty{number}", "virtual/tty", device=False)
        for number in range(BOARD_UARTS):
            self._describe(f"ttyS{number}", "platform/serial8250/tty", device=True)
        self._far = -1
        for number in range(ADAPTERS):
            self.number = number
            self.describe()
            self.make_node()

    @property
    def path(self) -> Path:
        return self.dev / f"ttyUSB{self.number}"

    @property
    def serial(self) -> str:
        return f"A500{self.number}"

    def describe(self) -> None:
        """Describe an adapter as the kernel does when it is plugged in."""
        self._far, near = os.openpty()
        self._pty, self._node = os.ttyname(near), os.fstat(near).st_rdev
        os.close(near)
        place = f"1-{self.number}"
        port = self.sys / f"devices/pci0000:00/0000:00:14.0/usb1/{place}/{place}:1.0/ttyUSB{self.number}"
        tty = port / "tty" / self.path.name
        if not tty.exists():
            tty.mkdir(parents=True)
            adapter = {"idVendor": "0403", "idProduct": "6001", "manufacturer": "FTDI", "serial": self.serial}
            for attribute, text in adapter.items():
                (port.parents[1] / attribute).write_text(f"{text}\n")
            (port.parent / "bInterfaceNumber").write_text("00\n")
            (port / "port_number").write_text("0\n")
            (tty / "device").symlink_to("../../../" + port.name)
        name = self.path.name if hasattr(identity, "DEV") else f"..{self.path}"
        (tty / "uevent").write_text(f"MAJOR={os.major(self._node)}\nMINOR={os.minor(self._node)}\nDEVNAME={name}\n")
        self._entries = (
            self.sys / "class/tty" / tty.name,
            self.sys / f"dev/char/{os.major(self._node)}:{os.minor(self._node)}",
        )
        for entry in self._entries:
            entry.symlink_to(tty)

    def make_node(self) -> None:
        self.path.symlink_to(self._pty)

    def unplug(self) -> None:
        for gone in (*self._entries, self.path):
            gone.unlink()
        os.close(self._far)

    def _describe(self, name: str, where: str, *, device: bool) -> None:
        tty = self.sys / "devices" / where / name
        tty.mkdir(parents=True)
        (tty / "uevent").write_text(f"MAJOR=4\nMINOR=0\nDEVNAME={name}\n")
        if device:
            (tty / "device").symlink_to("../..")
        (self.sys / "class/tty" / name).symlink_to(tty)


@contextlib.contextmanager
def machine() -> Iterator[Machine]:
    """A made machine, which is looked at in place of this one."""
    with tempfile.TemporaryDirectory() as folder:
        made = Machine(Path(folder))
        places: dict[str, Any] = {"SYS": made.sys, "DEV": made.dev, "LINKS": made.dev / "serial"}
        before = {name: getattr(identity, name) for name in places if hasattr(identity, name)}
        for name in before:
            setattr(identity, name, places[name])
        try:
            yield made
        finally:
            for name, place in before.items():
                setattr(identity, name, place)


class Line(asyncio.Protocol):
    """Notes when it is connected."""

    def __init__(self) -> None:
        self.up = asyncio.Event()
        self.lost = asyncio.Event()
        self.connected_at = 0.0

    def connection_made(self, _transport: asyncio.BaseTransport) -> None:
        self.connected_at = time.perf_counter()
        self.up.set()

    def connection_lost(self, _cause: Exception | None) -> None:
        self.up.clear()
        self.lost.set()


async def cost(made: Machine, name: str) -> float:
    """Return the processor time a second, in seconds, from the loss of the port on."""
    async with _kept(made, name):
        begun = time.process_time()
        made.unplug()
        await asyncio.sleep(GONE)
        spent = time.process_time() - begun
        made.describe()
        made.make_node()
    return spent / GONE


async def returns(made: Machine, name: str, away: float, node_after: float) -> float:
    """Return the seconds from the moment at which the node is there again until the port is open."""
    async with _kept(made, name) as line:
        made.unplug()
        await line.lost.wait()
        await asyncio.sleep(away)
        made.describe()
        await asyncio.sleep(node_after)
        begun = time.perf_counter()
        made.make_node()
        async with asyncio.timeout(PATIENCE):
            await line.up.wait()
        connected: float = line.connected_at
        return connected - begun


@contextlib.asynccontextmanager
async def _kept(made: Machine, name: str) -> Any:
    line = Line()
    port = SerialPort(name, baudrate=57600)
    connection = Connection(port, line)
    await connection.open()
    running = asyncio.ensure_future(connection.run())
    try:
        yield line
    finally:
        await connection.close()
        await running


def run(options: Options) -> Outcome:
    outcome = Outcome()
    table = Table(
        f"a port that is gone, on {TTYS} ttys and {ADAPTERS} adapters",
        ("named by", f"CPU over {GONE:g} s", "return: median ms", "longest ms"),
    )
    found: dict[str, tuple[float, list[float]]] = {}
    with machine() as made:
        for kind, name in (("path", str(made.path)), ("serial number", f"usb:{made.serial}")):
            share = asyncio.run(cost(made, name))
            times = [asyncio.run(returns(made, name, *away)) for away in AWAY[: options.pick(len(AWAY), 1)]]
            found[kind] = share, times
            table.row(kind, f"{share:.2%}", median(times) * 1000, max(times) * 1000)
            outcome.series[kind] = times
    outcome.tables.append(table)
    share, times = found["serial number"]
    outcome.claims.append(Claim("processor time of usb:SERIAL while it is gone, share of a core", share, MOST_CPU))
    ratio = median(times) / median(found["path"][1])
    outcome.claims.append(Claim("its return, against that by path", ratio, MOST_TIMES_THE_PATH))
    return outcome
