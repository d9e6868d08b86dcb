"""`busmaster scan`: which nodes answer."""

from __future__ import annotations

import click

from busmaster.bus.requester import Priority, Requester
from busmaster.cli.arguments import Connection, connected, json_option, nodes_option, nodes_to_ask
from busmaster.cli.ending import until_ended
from busmaster.cli.output import emit, json_line, json_value, value_text
from busmaster.cli.protocols import NodeCommand
from busmaster.cli.reaching import reach
from busmaster.errors import GarbledReply, NodeDown, NoReply, Refused


@click.command(short_help="Find the nodes that answer.", cls=NodeCommand)
@connected
@nodes_option
@json_option
def command(connection: Connection, nodes: tuple[int, ...] | None, as_json: bool) -> None:
    """Ask every node of PORT once and print a line for each that answers: `NODE` and what it answered.

    All addresses of the protocol are asked unless --nodes names some.
    """
    until_ended(scan, connection, nodes_to_ask(connection.profile, nodes), as_json)


async def scan(connection: Connection, addresses: tuple[int, ...], as_json: bool) -> None:
    """Ask each address once, and print what answers, behind a bar of the progress."""
    from busmaster.cli.progress import Bar  # before the line is opened; it takes a fifth of the time of --help

    bus = reach(connection)
    nodes = [bus.node(connection.profile, address, timings=connection.timings) for address in addresses]
    async with bus:
        with Bar("scanning", len(nodes)) as bar:
            for node in nodes:
                answer = await ask(node)
                if answer is not None:
                    value, outcome = answer
                    number = connection.node_number(node.address)
                    found = json_line(node=number, value=json_value(value), answer=outcome)
                    with bar.hidden():
                        emit(found if as_json else f"{node.address} {outcome}")
                bar.advance()


async def ask(node: Requester) -> tuple[object, str] | None:
    """Ask a node once, and return the value and what happened in words; None if nothing was heard of it."""
    probe = node.profile.probe
    try:
        # behind all that other programs ask of the line: a node that is not there takes its whole reply window
        value = await node.request(probe, retries=0, priority=Priority.BACKGROUND)
    except (NoReply, NodeDown):
        return None
    except Refused:
        return None, f"{probe}: refused"
    except GarbledReply as error:
        return None, f"{probe}: {error.what}"
    return value, f"{probe}: {value_text(value)}"
