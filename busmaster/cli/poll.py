"""`busmaster poll`: values of several nodes, again and again, on a fixed grid."""

from __future__ import annotations

import click

from busmaster.cli.arguments import Connection, View, connected, nodes_option, viewed
from busmaster.cli.ending import until_ended
from busmaster.cli.parsing import option_type, parse_items, parse_seconds
from busmaster.cli.protocols import ItemCommand
from busmaster.cli.watching import Watch, follow


@click.command(short_help="Read values of several nodes once a period.", cls=ItemCommand)
@connected
@nodes_option
@click.option("--items", required=True, type=option_type(parse_items), metavar="ITEM,ITEM...", help="What to read.")
@click.option(
    "--period", required=True, type=option_type(parse_seconds), metavar="S", help="Seconds from cycle to cycle."
)
@viewed
def command(
    connection: Connection, nodes: tuple[int, ...] | None, items: tuple[str, ...], period: float, view: View
) -> int:
    """Read the items of every node on PORT once a period, until Ctrl-C.

    On a terminal a live table; else, or with --plain, a line a value: seconds since the start, NODE/ITEM and the
    value, or `-` and what went wrong. A summary on standard error ends it.
    """
    return until_ended(poll, connection, connection.addresses(nodes), items, period, view)


async def poll(
    connection: Connection, addresses: tuple[int, ...], items: tuple[str, ...], period: float, view: View
) -> int:
    """Poll the items of all addresses every `period` seconds until the view ends, and return the exit status."""
    bus = connection.open_bus()
    handles = [connection.open_handle(bus, address) for address in addresses]
    points = [handle.point(item) for handle in handles for item in items]
    async with bus:
        watch = Watch(bus, "busmaster poll", view)
        watch.add(bus.poll_group("poll", period=period, points=points))
        return await follow(watch)
