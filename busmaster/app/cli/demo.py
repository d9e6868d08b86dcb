"""`busmaster demo`: an emulated line of eight drives on a real pseudo-terminal, polled live and commanded meanwhile."""

from __future__ import annotations

import itertools
import subprocess
import sys
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack, contextmanager

import anyio
import click

from busmaster import Bus, BusError, Hcp2Controller, LineDown, MicroFlexDrive, Point, SerialPort
from busmaster.app.cli.arguments import View, plain_option, seconds_option
from busmaster.app.cli.demo_line import CONTROLLERS, DRIVES, SETTINGS
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.watching import Watch, follow

PERIOD = 0.2
COMMAND_EVERY = 2.0
MOST_TAKEN = 8
"""Terminals that other programs may have taken, as one does that waits for a lost line of that name, before it ends."""
SPEEDS = (25.0, -40.0, 60.0, 0.0, 80.0, -15.0, 40.0)
"""References in %, one drive after another; more of them than drives, so that each gets another the next time round."""


@click.command()
@seconds_option
@plain_option
def command(seconds: float | None, plain: bool) -> int:
    """Emulate a line with eight drives in a process of its own, poll it live and send commands.

    Controllers (nodes 1 to 3) move their axes. MicroFlex drives (4 to 8) get a new speed reference now and then.
    Node 7 is disconnected for some seconds. Cycles are missed for about a second, until the node is down. No port of
    this machine is used. Ctrl-C ends it.
    """
    view = View(seconds=seconds, plain=plain)
    with ExitStack() as lines:  # a terminal that is taken is kept: else the next one would be the same
        for _ in range(MOST_TAKEN):
            try:
                return until_ended(demo, lines.enter_context(emulated_line()), view)
            except LineDown as error:
                taken = error
        raise taken


@contextmanager
def emulated_line() -> Iterator[str]:
    """Serve the line in another process while the context lasts, and yield the path of its pseudo-terminal."""
    process = subprocess.Popen(
        [sys.executable, "-m", "busmaster.app.cli.demo_line"],
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
                raise click.ClickException("the emulated line did not start; its error is printed above")
            yield path
        finally:
            process.stdin.close()
            process.wait()  # Popen's own waits no longer than a quarter of a second for one that Ctrl-C ended


async def demo(path: str, view: View) -> int:
    """Poll the line at `path` and command its drives, until the view ends: return the exit status.

    Raises LineDown if that port cannot be opened.
    """
    bus = Bus(SerialPort(path, baudrate=SETTINGS.baudrate))
    drives, points = devices(bus)
    async with bus:
        watch = Watch(bus, "busmaster demo", view)
        watch.add(bus.poll_group("drives", period=PERIOD, points=points))
        return await follow(watch, lambda: command_drives(watch, drives))


def devices(bus: Bus) -> tuple[list[MicroFlexDrive], list[Point[float]]]:
    """Return the drives of the line, and the points that are polled on drives and controllers."""
    axes = [Hcp2Controller(bus, address).axis(0) for address in CONTROLLERS]
    drives = [MicroFlexDrive(bus, address) for address in DRIVES]
    points = [point for axis in axes for point in (axis.position, axis.velocity)]
    points += [point for drive in drives for point in (drive.speed_measured, drive.torque_demand)]
    return drives, points


async def command_drives(watch: Watch, drives: list[MicroFlexDrive]) -> None:
    """Enable all drives, then give them new speeds, one after another, until cancelled."""
    speeds = itertools.cycle(SPEEDS)
    for drive, percent in zip(drives, speeds, strict=False):
        await attempt(watch, drive, drive.enable)
        await attempt(watch, drive, drive.set_speed_reference, percent)
    for drive, percent in zip(itertools.cycle(drives), speeds, strict=False):
        await anyio.sleep(COMMAND_EVERY)
        if await attempt(watch, drive, drive.set_speed_reference, percent):
            watch.show(f"{drive.node.label}: speed reference {percent:g} %")


async def attempt(watch: Watch, drive: MicroFlexDrive, order: Callable[..., Awaitable[object]], *values: float) -> bool:
    """Send one command to a drive, and return whether it succeeded.

    A failed command is shown as an event; the demo continues.
    """
    try:
        await order(*values)
    except BusError as error:
        watch.show(f"{drive.node.label}: {error.what}")
        return False
    return True
