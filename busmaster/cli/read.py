"""`busmaster read`: values of one node, now."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import click

from busmaster.cli.arguments import WHAT_ITEMS_ARE, Connection, connected, is_run, json_option, node_option, run_names
from busmaster.cli.ending import until_ended
from busmaster.cli.output import emit, emit_all, json_line, json_value, value_text
from busmaster.errors import Refused
from busmaster.handles import Handle, MentorDrive, MscController
from busmaster.points import Point


@click.command(short_help="Read values of one node.", epilog=WHAT_ITEMS_ARE)
@connected
@node_option
@click.argument("items", nargs=-1, required=True, metavar="ITEM...")
@click.option("--chain", is_flag=True, help="mentor: read a run in one exchange, where no other drive can mistake it.")
@json_option
def command(connection: Connection, node: int | None, items: tuple[str, ...], chain: bool, as_json: bool) -> None:
    """Read each ITEM of one node on PORT and print `ITEM VALUE`, a line each; for a run a line a value."""
    if chain and connection.protocol != "mentor":
        raise click.UsageError("--chain is mentor's alone")
    until_ended(read, connection, connection.one_address(node), items, chain, as_json)


async def read(connection: Connection, address: int, items: tuple[str, ...], chain: bool, as_json: bool) -> None:
    bus = connection.open_bus()
    handle = connection.open_handle(bus, address)
    points = {item: handle.point(item) for item in items}
    async with bus:
        for item in items:
            value = await read_item(handle, points[item], chain)
            if as_json:
                emit(json_line(node=connection.node_number(address), item=item, value=json_value(value)))
            else:
                emit_all(plain_lines(handle, item, value))


async def read_item(handle: Handle, point: Point[Any], chain: bool) -> Any:
    """What is best read otherwise than its point is, else the point."""
    match handle:
        case MentorDrive() if is_run(point.item) and not chain:
            parameter, _, count = point.item.partition(":")
            return await handle.read_run(parameter, int(count))
        case MscController() if point.item == "flags":
            try:
                return await point.read()
            except Refused:  # a model without RFLAGS: flag by flag
                return await handle.flags()
        case _:
            return await point.read()


def plain_lines(handle: Handle, item: str, value: Any) -> Iterator[str]:
    """A line, or for a run a line a value."""
    if not isinstance(value, tuple):
        yield f"{item} {value_text(value)}"
        return
    for name, one in zip(run_names(handle, item, len(value)), value, strict=True):
        yield f"{name} {value_text(one)}"
