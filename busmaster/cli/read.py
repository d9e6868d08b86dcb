"""`busmaster read`: values of one node, now."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import click

from busmaster.bus.handle import Handle
from busmaster.cli.arguments import Connection, connected, json_option, node_option
from busmaster.cli.ending import until_ended
from busmaster.cli.late import late_nodes
from busmaster.cli.output import emit, emit_all, json_line, json_value, name_fields, value_text
from busmaster.cli.protocols import ItemCommand, Offer, read_options, take_options
from busmaster.cli.reaching import reach
from busmaster.errors import NoReply
from busmaster.outputs.values import utc


class ItemsReadCommand(ItemCommand):
    """It takes what reading an item takes, too."""

    def offers(self) -> list[Offer]:
        return [*super().offers(), *read_options()]


@click.command(short_help="Read values of one node.", cls=ItemsReadCommand)
@connected
@node_option
@click.argument("items", nargs=-1, required=True, metavar="ITEM...")
@json_option
def command(connection: Connection, node: int | None, items: tuple[str, ...], as_json: bool, **options: Any) -> None:
    """Read each ITEM of one node on PORT and print `ITEM VALUE` on a line; of a run of values each on its own."""
    how = take_options(read_options(), connection.protocol, options)
    until_ended(read, connection, connection.one_address(node), items, how, as_json)


async def read(
    connection: Connection, address: int, items: tuple[str, ...], how: dict[str, Any], as_json: bool
) -> None:
    """Read the items of one node and print each; all are checked before the first is asked for."""
    bus = reach(connection)
    handle = connection.open_handle(bus, address)
    points = [handle.point(item) for item in items]
    async with bus, late_nodes(bus) as late:
        for item, point in zip(items, points, strict=True):
            try:
                value = await handle.read_item(item, **how)
            except NoReply as error:
                await late.explain(error, connection.lateness)
                raise
            if as_json:
                fields = {"value": json_value(value), **name_fields(value), "time": utc(time.time())}
                emit(json_line(node=connection.node_number(address), item=item, **fields))
            else:
                emit_all(plain_lines(handle, item, value, point.meaning.precision))


def plain_lines(handle: Handle, item: str, value: Any, precision: int | None) -> Iterator[str]:
    """Yield a line, or a line for each value of a run."""
    if not isinstance(value, tuple):
        yield f"{item} {value_text(value, precision)}"
        return
    for name, one in zip(handle.run_items(item, len(value)), value, strict=True):
        yield f"{name} {value_text(one, precision)}"
