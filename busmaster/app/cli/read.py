"""`busmaster read`: values of one node, or points of a file, now."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import click

from busmaster import Bus, Node, NoReply, ext
from busmaster.app.cli.arguments import Connection, connected, json_option, node_option
from busmaster.app.cli.capturing import capturing
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.late import late_nodes
from busmaster.app.cli.lines import is_line_file, load
from busmaster.app.cli.output import emit, emit_all, json_line, json_value, name_fields, value_text
from busmaster.app.cli.protocols import ItemCommand, Offer, read_options, take_options
from busmaster.app.cli.reaching import owner_to_use, reach
from busmaster.app.line import ConfiguredLine
from busmaster.app.service.remote import RemoteBus, connect
from busmaster.app.service.values import utc
from busmaster.ext import Handle


class ItemsReadCommand(ItemCommand):
    """It takes what reading an item takes, too."""

    def offers(self) -> list[Offer]:
        return [*super().offers(), *read_options()]


@click.command(cls=ItemsReadCommand)
@partial(connected, or_file=True)
@node_option
@click.argument("items", nargs=-1, required=True, metavar="ITEM...")
@json_option
def command(connection: Connection, node: int | None, items: tuple[str, ...], as_json: bool, **options: Any) -> None:
    """Read each ITEM of one node on PORT and print `ITEM VALUE` on a line; of a run of values each on its own.

    With a LINE.toml, ITEM is a point of it, as NODE/ITEM, and its value is in the point's unit; the values of a run are
    on one line, with commas. Where another busmaster owns the line, the read goes through it.
    """
    if is_line_file(connection.port):
        read_of_file(connection, items, as_json)
        return
    how = take_options(read_options(), connection.protocol, options)
    until_ended(read, connection, connection.one_address(node), items, how, as_json)


async def read(
    connection: Connection, address: int, items: tuple[str, ...], how: dict[str, Any], as_json: bool
) -> None:
    """Read the items of one node and print each. All are checked before the first request."""
    bus = reach(connection)
    handle = connection.open_handle(bus, address)
    points = [handle.point(item) for item in items]
    async with bus, late_nodes(bus) as late:
        for item, point in zip(items, points, strict=True):
            try:
                value = await ext.read_item(handle, item, **how)
            except NoReply as error:
                await late.explain(error, connection.max_reply_delay)
                raise
            if as_json:
                fields = {"value": json_value(value), **name_fields(value), "time": utc(time.time())}
                emit(json_line(node=connection.node_number(address), item=item, **fields))
            else:
                emit_all(plain_lines(handle, item, value, point.meaning.precision))


def read_of_file(connection: Connection, names: tuple[str, ...], as_json: bool) -> None:
    """Read points of a LINE.toml, through the program that owns its line if there is one."""
    file = load(connection.port)
    if (owner := owner_to_use(file.port, connection.capture)) is not None:
        until_ended(read_points, ConfiguredLine(file, outputs=False), connect(owner.address), names, as_json)
        return
    with capturing(connection.capture, port=file.port.name, echo=file.port.echo) as recorder:
        line = ConfiguredLine(file, outputs=False, tap=recorder)
        until_ended(read_points, line, line.bus, names, as_json)


async def read_points(line: ConfiguredLine, bus: Bus | RemoteBus, names: tuple[str, ...], as_json: bool) -> None:
    """Read points of a line over `bus` and print each. All are checked before the first request."""
    points = [line.point(name) for name in names]
    other = None if bus is line.bus else bus
    handles = {point.where: line.handle(point.where, other) for point in points}
    async with bus, late_nodes(bus, in_file=True) as late:
        for name, point in zip(names, points, strict=True):
            try:
                value = point.value_of(await handles[point.where].node.request(point.command))
            except NoReply as error:
                await late.explain(error, Node.of(point).timings.read.max_reply_delay)
                raise
            if as_json:
                fields = {"value": json_value(value), **name_fields(value), "unit": point.unit}
                emit(json_line(point=name, **fields, time=utc(time.time())))
            else:
                several = value if isinstance(value, tuple) else (value,)
                emit(f"{name} {','.join(value_text(one, point.meaning.precision) for one in several)}")


def plain_lines(handle: Handle, item: str, value: Any, precision: int | None) -> Iterator[str]:
    """Yield a line, or a line for each value of a run."""
    if not isinstance(value, tuple):
        yield f"{item} {value_text(value, precision)}"
        return
    for name, one in zip(ext.run_items(handle, item, len(value)), value, strict=True):
        yield f"{name} {value_text(one, precision)}"
