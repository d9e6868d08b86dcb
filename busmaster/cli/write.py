"""`busmaster write`: values of one node, acknowledged."""

from __future__ import annotations

import click

from busmaster.cli.arguments import Connection, connected, json_option, node_option
from busmaster.cli.ending import until_ended
from busmaster.cli.output import emit, json_line
from busmaster.cli.parsing import parse_assignment, parsed
from busmaster.cli.protocols import ItemCommand


@click.command(short_help="Write values of one node.", cls=ItemCommand)
@connected
@node_option
@click.argument("assignments", nargs=-1, required=True, metavar="ITEM=VALUE[,VALUE...]...")
@click.option("--verify", is_flag=True, help="Read back and compare.")
@json_option
def command(
    connection: Connection, node: int | None, assignments: tuple[str, ...], verify: bool, as_json: bool
) -> None:
    """Write to one node on PORT, in the order given, and print `ITEM ok` for each.

    Several values go to ITEM and those after it. All values are checked before the first is sent; the first that
    fails ends it, with those before it written.
    """
    pairs = [parsed(parse_assignment, text) for text in assignments]
    until_ended(write, connection, connection.one_address(node), pairs, verify, as_json)


async def write(
    connection: Connection, address: int, pairs: list[tuple[str, tuple[float, ...]]], verify: bool, as_json: bool
) -> None:
    """Write the pairs to one node, one after another, and print each; all are checked before the first is sent."""
    bus = connection.open_bus()
    handle = connection.open_handle(bus, address)
    prepared = [(item, handle.prepare_write(item, values, verify=verify)) for item, values in pairs]
    async with bus:
        for item, sends in prepared:
            for send in sends:
                await send()
            emit(json_line(node=connection.node_number(address), item=item, ok=True) if as_json else f"{item} ok")
