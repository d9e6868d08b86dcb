"""`busmaster write`: values of one node, or points of a file, acknowledged."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import click

from busmaster import InvalidCommand, Point, Priority, ext
from busmaster.app.cli.arguments import Connection, connected, json_option, node_option
from busmaster.app.cli.capturing import capturing
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.late import late_nodes
from busmaster.app.cli.lines import is_line_file, keep, load
from busmaster.app.cli.output import emit, json_line, note
from busmaster.app.cli.parsing import Assignment, Whole, parse_assignment, parsed
from busmaster.app.cli.protocols import ItemCommand
from busmaster.app.cli.reaching import owner_to_use, reach
from busmaster.app.line import ConfiguredLine
from busmaster.app.service.authorisation import WriteRequest
from busmaster.app.service.record import WriteRecord
from busmaster.app.service.remote import RemoteBus, connect
from busmaster.app.service.values import utc
from busmaster.ext import Handle, Send, WriteOptions, find

Pairs = Sequence[Assignment]
"""The writes in their order: items, or points of a file, and their values."""


@click.command(cls=ItemCommand)
@partial(connected, or_file=True)
@node_option
@click.argument("assignments", nargs=-1, required=True, metavar="ITEM=VALUE[,VALUE...]|ITEM=@FILE...")
@click.option("--verify", is_flag=True, help="Read each value back and compare.")
@click.option(
    "--decimals",
    type=Whole(min=0),
    metavar="N",
    help="Number of decimals, for a protocol without a decimal point on the line: 1 for 1.17=-47.6.",
)
@json_option
def command(
    connection: Connection,
    node: int | None,
    assignments: tuple[str, ...],
    verify: bool,
    decimals: int | None,
    as_json: bool,
) -> None:
    """Write to one node on PORT, in the order given, and print `ITEM ok` for each.

    Several values go to ITEM and the items after it. @FILE is a text file with the values, such as a cam table:
    numbers, separated by commas, spaces or line ends. They are written in the background of other traffic. All values
    are checked before the first is sent. The first that fails ends the command; those before it stay written.

    With a LINE.toml, ITEM is a point of it, as NODE/ITEM, and its value is in the point's unit. The file's limits
    apply, and its outputs record each write, or why it was rejected. If another busmaster owns the line, its limits
    apply, and its outputs keep the record.
    """
    pairs = [parsed(parse_assignment, text) for text in assignments]
    if not is_line_file(connection.port):
        if decimals is not None and not find(connection.protocol).takes_decimals:
            raise click.UsageError(f"{connection.protocol} sends the decimal point itself; leave out --decimals")
        until_ended(write, connection, connection.one_address(node), pairs, verify, as_json, decimals)
        return
    file = load(connection.port)
    if (owner := owner_to_use(file.port, connection.capture)) is not None:
        until_ended(write_points_through, ConfiguredLine(file, outputs=False), owner.address, pairs, verify, as_json)
        return
    with capturing(connection.capture, port=file.port.name, echo=file.port.echo) as recorder:
        until_ended(write_points, ConfiguredLine(file, outputs=False, tap=recorder), pairs, verify, as_json)


async def write(
    connection: Connection, address: int, pairs: Pairs, verify: bool, as_json: bool, decimals: int | None
) -> None:
    """Write the pairs to one node, one after another, and print each; all are checked before the first is sent."""
    bus = reach(connection)
    handle = connection.open_handle(bus, address)
    if decimals is not None:
        items = (
            name for item, values, _ in pairs for name in ext.run_items(handle, item.partition(":")[0], len(values))
        )
        with_decimals = {**connection.options, "decimals": dict.fromkeys(items, decimals)}
        handle = replace(connection, options=with_decimals).open_handle(bus, address)
    prepared = [
        (one, ext.prepare_write(handle, checked(handle, one, one.item), one.values, **options_of(one, verify)))
        for one in pairs
    ]
    async with bus, late_nodes(bus):
        for one, sends in prepared:
            for send in sends:
                await send()
            written = items_of(handle, one)
            if as_json:
                more = {"items": written} if len(written) > 1 else {}
                print_written(one.item, as_json, node=connection.node_number(address), item=one.item, **more)
            else:
                # Each of several: the comma of 10=2,5 may have been meant as a decimal point.
                for item in written:
                    print_written(item, as_json)


def items_of(handle: Handle, one: Assignment) -> list[str]:
    """Return the items that an assignment writes: the named one and those after it."""
    if len(one.values) == 1 or ":" in one.item:  # the item has the number of values
        return [one.item]
    return list(ext.run_items(handle, one.item, len(one.values)))


async def write_points(line: ConfiguredLine, pairs: Pairs, verify: bool, as_json: bool) -> None:
    """Write the pairs to points of a line, as `write` does, and have its outputs keep a record of each."""
    audit = line.audit(note)  # first: nothing is written of which no record can be kept
    records: list[WriteRecord] = []
    line.authorisation.record = records.append
    try:
        prepared = [prepare(line, one, verify) for one in pairs]
        async with line.bus, late_nodes(line.bus, in_file=True):
            for request, send in prepared:
                await pass_on(line, request, send)
                print_written(request.name, as_json, point=request.name)
    finally:
        await keep(audit, records)


async def write_points_through(line: ConfiguredLine, address: str, pairs: Pairs, verify: bool, as_json: bool) -> None:
    """Write the pairs to points of a line that another program owns, which holds its limits and keeps the record."""
    remote = connect(address)
    prepared = [(one.item, prepare_point(line, one, verify, remote)) for one in pairs]
    async with remote, late_nodes(remote, in_file=True):
        for name, send in prepared:
            await send()
            print_written(name, as_json, point=name)


def print_written(name: str, as_json: bool, **fields: Any) -> None:
    """Print that `name` has been written, as a line or as JSON with these fields."""
    emit(json_line(**fields, ok=True, time=utc(time.time())) if as_json else f"{name} ok")


async def pass_on(line: ConfiguredLine, request: WriteRequest, send: Send) -> None:
    """Write one point, of which a record is kept."""
    with line.authorisation.begin(request):
        await send()


def write_request_of(name: str, values: Sequence[float], point: Point[Any] | None = None) -> WriteRequest:
    """Return the user's write request; without a point if the target is not a point of the line."""
    value = values[0] if len(values) == 1 else tuple(values)
    return WriteRequest(interface="command line", by="busmaster write", name=name, point=point, value=value)


def prepare(line: ConfiguredLine, one: Assignment, verify: bool) -> tuple[WriteRequest, Send]:
    """Return what a person wants, and what writes it.

    Raises InvalidCommand, of which a record is kept, for what may not be written, and for no point of the line.
    """
    request = write_request_of(one.item, one.values)
    try:
        request = write_request_of(one.item, one.values, line.point(one.item))
        return request, prepare_point(line, one, verify)
    except InvalidCommand as error:
        line.authorisation.refuse(request, str(error))
        raise


def prepare_point(line: ConfiguredLine, one: Assignment, verify: bool, bus: RemoteBus | None = None) -> Send:
    """Return what writes a point of a line, over `bus` if it is another than the line's own. Raises InvalidCommand."""
    point = line.point(one.item)
    checked(line.nodes[point.where], one, point.source.item)
    return line.prepare_write(one.item, one.values, bus=bus, **options_of(one, verify))


def checked(handle: Handle, one: Assignment, item: str) -> str:
    """Return the item of a node. Raises InvalidCommand if it has a count and there are not so many values."""
    if (names := ext.counted_items(handle, item)) != (item,):
        one.check_count(len(names))
    return item


def options_of(one: Assignment, verify: bool) -> WriteOptions:
    """Return the options of a write. A table from a file takes many exchanges, and is in the background."""
    return {"verify": verify, "priority": Priority.BACKGROUND} if one.path else {"verify": verify}
