"""`busmaster read`: values of one node, now."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import anyio
import click

from busmaster.cli.arguments import Connection, connected, json_option, node_option
from busmaster.cli.output import emit_all, json_line, json_value, value_text
from busmaster.points import Point


@click.command(short_help="Read values of one node.")
@connected
@node_option
@click.argument("items", nargs=-1, required=True, metavar="ITEM...")
@json_option
def command(connection: Connection, node: int | None, items: tuple[str, ...], as_json: bool) -> None:
    """Read each ITEM of one node on PORT and print `ITEM VALUE`, a line each."""
    anyio.run(read, connection, connection.one_address(node), items, as_json)


async def read(connection: Connection, address: int, items: tuple[str, ...], as_json: bool) -> None:
    bus = connection.open_bus()
    handle = connection.open_handle(bus, address)
    points = [handle.point(item) for item in items]
    async with bus:
        for item, point in zip(items, points, strict=True):
            value = await point.read()
            emit_all([json_result(point, item, value)] if as_json else plain_result(handle, item, value))


def json_result(point: Point[Any], item: str, value: Any) -> str:
    node = point.node
    return json_line(node=node.address if node.profile.addressed else None, item=item, value=json_value(value))


def plain_result(handle: Any, item: str, value: Any) -> Iterator[str]:
    """A line, or for a run a line a value."""
    for name, one in zip(handle.run_items(item), value, strict=True) if isinstance(value, tuple) else [(item, value)]:
        yield f"{name} {value_text(one)}"
