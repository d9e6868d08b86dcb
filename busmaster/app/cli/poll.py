"""`busmaster poll`: values of several nodes, again and again, on a fixed grid."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from statistics import fmean
from typing import Any

import anyio
import click

from busmaster import Node, Point, Snapshot
from busmaster.app.cli.app import FAILED, OK
from busmaster.app.cli.arguments import Connection, View, connected, nodes_option, viewed
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.late import late_nodes
from busmaster.app.cli.output import Level, emit_all, note
from busmaster.app.cli.parsing import option_type, parse_items, parse_seconds
from busmaster.app.cli.protocols import ItemCommand
from busmaster.app.cli.reaching import reach
from busmaster.app.cli.watching import Watch, follow, json_cycle, p99_of, plain_cycle, wants_screen
from busmaster.app.service.remote import RemoteBus
from busmaster.app.service.remote_group import RemoteGroup

KEPT = 1_001
"""Maximum number of cycles whose periods are in the summary."""


@click.command(cls=ItemCommand)
@connected
@nodes_option
@click.option("--items", required=True, type=option_type(parse_items), metavar="ITEM,ITEM...", help="Items to read.")
@click.option(
    "--period", required=True, type=option_type(parse_seconds), metavar="S", help="Period of the cycles, in seconds."
)
@viewed
def command(
    connection: Connection, nodes: tuple[int, ...] | None, items: tuple[str, ...], period: float, view: View
) -> int:
    """Read the items of every node on PORT once a period, until Ctrl-C.

    On a terminal a live table; else, or with --plain, a line for each value: the time in UTC, NODE/ITEM and the value,
    or `-` and what went wrong. A summary on standard error ends it.
    """
    return until_ended(poll, connection, connection.addresses(nodes), items, period, view)


async def poll(
    connection: Connection, addresses: tuple[int, ...], items: tuple[str, ...], period: float, view: View
) -> int:
    """Poll the items of all addresses every `period` seconds until the view ends, and return the exit status."""
    bus = reach(connection)
    handles = [connection.open_handle(bus, address) for address in addresses]
    points = [handle.point(item) for handle in handles for item in items]
    if isinstance(bus, RemoteBus):
        return await poll_served(bus, points, period, view)
    async with bus:
        watch = Watch(bus, "busmaster poll", view)
        watch.add(bus.poll_group("poll", period=period, points=points))
        status = await follow(watch)
        return status or ended(any(handle.node.statistics().ok for handle in handles if isinstance(handle.node, Node)))


def ended(values: bool) -> int:
    """Return the exit status of a finished poll, and report if no value was received."""
    if not values:
        note("no value was received; check the port, the protocol and the nodes", Level.ERROR)
    return OK if values else FAILED


class Cycles:
    """The cycles of a group of a served line: printed, and counted for the summary."""

    def __init__(self, remote: RemoteBus, view: View) -> None:
        self.start = remote.now()
        self._view = view
        self._last: Snapshot | None = None
        self.values = False
        """Whether there were any."""
        self._started: deque[float] = deque(maxlen=KEPT)

    def since(self, time: float) -> float:
        """Return a time of the line in seconds since the start."""
        return round(time - self.start, 6)

    async def show(self, group: RemoteGroup) -> None:
        """Print every cycle, in a thread: a reader that is slow loses cycles of its own."""
        async for snapshot in group:
            self._last = snapshot
            self.values = self.values or any(sample.error is None for sample in snapshot.samples.values())
            if snapshot.started is not None:
                self._started.append(snapshot.started)
            lines = [json_cycle(self, snapshot)] if self._view.as_json else list(plain_cycle(snapshot))
            await anyio.to_thread.run_sync(emit_all, lines, abandon_on_cancel=True)

    def summarise(self) -> None:
        """Print the summary on standard error. Statistics of nodes and line are those of the line's owner."""
        if self._last is None:
            note("nothing was polled")
            return
        text = f"poll: {self._last.cycle} cycles, {self._last.missed} missed"
        periods = [later - earlier for earlier, later in pairwise(self._started)]
        if periods:
            text += f", period {fmean(periods) * 1000:.2f} ms mean, {p99_of(periods) * 1000:.2f} ms p99"
        note(text)


async def poll_served(remote: RemoteBus, points: Sequence[Point[Any]], period: float, view: View) -> int:
    """Poll through the program that owns the line, and print the values, until the view ends. Raises LineDown."""
    if wants_screen(view):
        note("no live view of another program's line here, showing plain lines; use busmaster top")
    cycles = Cycles(remote, view)
    try:
        async with remote, late_nodes(remote):
            with anyio.move_on_after(view.seconds):
                await cycles.show(remote.poll_group("poll", period=period, points=points))
                remote.link.check()  # the stream ended by itself: raises the reason
    finally:
        cycles.summarise()
    return ended(cycles.values)
