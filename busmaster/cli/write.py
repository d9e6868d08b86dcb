"""`busmaster write`: values of one node, acknowledged."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

import click

from busmaster.cli.arguments import (
    WHAT_ITEMS_ARE,
    Connection,
    connected,
    is_decimal,
    json_option,
    node_option,
    parse_assignment,
    parsed,
    run_names,
)
from busmaster.cli.ending import until_ended
from busmaster.cli.output import emit, json_line, value_text
from busmaster.errors import InvalidCommand, VerifyFailed
from busmaster.exchange import Command
from busmaster.handles import Dc104Drive, Handle, MentorDrive, MscController
from busmaster.handles.comms import CommsHandle
from busmaster.handles.msc_blocks import writes
from busmaster.points import Point

Write = Callable[[], Awaitable[None]]


@click.command(short_help="Write values of one node.", epilog=WHAT_ITEMS_ARE)
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
    bus = connection.open_bus()
    handle = connection.open_handle(bus, address)
    prepared = [(item, prepare(handle, item, values, verify)) for item, values in pairs]
    async with bus:
        for item, sends in prepared:
            for send in sends:
                await send()
            emit(json_line(node=connection.node_number(address), item=item, ok=True) if as_json else f"{item} ok")


def prepare(handle: Handle, item: str, values: tuple[float, ...], verify: bool) -> list[Write]:
    """The writes, once it is sure that all of them can be sent. Raises InvalidCommand."""
    if isinstance(handle, CommsHandle):
        return [comms_write(handle, item, values, verify)]
    if isinstance(handle, MscController) and len(values) > 1:
        return [block_write(handle, item, values, verify)]
    names = run_names(handle, item, len(values)) if len(values) > 1 else (item,)
    return [single_write(handle, name, value, verify) for name, value in zip(names, values, strict=True)]


def comms_write(handle: CommsHandle, item: str, values: tuple[float, ...], verify: bool) -> Write:
    """Consecutive elements, in as many telegrams as it takes."""
    element = int(item) if is_decimal(item) else item
    handle.writes(element, values)
    return lambda: handle.write(element, *values, verify=verify)


def block_write(handle: MscController, item: str, values: tuple[Any, ...], verify: bool) -> Write:
    """Consecutive data addresses, in blocks and one by one."""
    name, _, count = item.partition(":")
    if count and count != str(len(values)):
        raise InvalidCommand(f"{item} takes {count} values, not {len(values)}")
    writable(handle.point(name))
    writes(handle.address_of(name), values, handle.address_step)
    return lambda: handle.write_block(name, values, verify=verify)


def single_write(handle: Handle, item: str, value: Any, verify: bool) -> Write:
    point = handle.point(item)
    writable(point)(value)
    match handle:
        case MentorDrive():
            parameter, _, kind = item.partition(":")
            return lambda: handle.write(
                parameter, value, wide=kind == "wide", high_resolution=kind == "hires", verify=verify
            )
        case Dc104Drive():
            return lambda: handle.write(int(item), value, verify=verify)
        case _:
            return lambda: write_point(point, value, verify)


def writable(point: Point[Any]) -> Callable[[Any], Command[None]]:
    """Raises InvalidCommand for a point that is read-only."""
    if point.encode is None:
        raise InvalidCommand(f"{point.node.label}: {point.item} is read-only")
    return point.encode


async def write_point(point: Point[Any], value: Any, verify: bool) -> None:
    await point.write(value)
    if verify:
        found = await point.read()
        if found != value:
            raise VerifyFailed(
                f"{point.item} reads {value_text(found)} after {value_text(value)} was written", node=point.node.label
            )
