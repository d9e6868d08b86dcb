"""`busmaster scan`: which nodes answer."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Sequence

import anyio
import click

from busmaster import Bus, GarbledReply, NodeDown, NoReply, Priority, Refused
from busmaster.app.cli.arguments import Connection, connected, json_option, nodes_option, nodes_to_ask
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.late import late_nodes
from busmaster.app.cli.output import emit, json_line, json_value, note, value_text
from busmaster.app.cli.protocols import NodeCommand
from busmaster.app.cli.reaching import reach
from busmaster.app.service.remote import RemoteBus
from busmaster.app.service.values import utc
from busmaster.ext import Profile, Requester, protocols

SILENCE = 0.1
"""Seconds behind the last bytes after which the line knows whose they were, with time to spare."""
STRANGERS = 16
"""Maximum number of silent nodes that are tried in another protocol."""


@click.command(cls=NodeCommand)
@connected
@nodes_option
@json_option
def command(connection: Connection, nodes: tuple[int, ...] | None, as_json: bool) -> None:
    """Send one request to every node of PORT, and print a line for each that replies: `NODE` and its reply.

    All addresses of the protocol are tried unless --nodes names some. Standard error lists nodes that reply late, or in
    another protocol that may share the line.
    """
    until_ended(scan, connection, nodes_to_ask(connection.profile, nodes), as_json)


async def scan(connection: Connection, addresses: tuple[int, ...], as_json: bool) -> None:
    """Send one request to each address, and print the replies, with a progress bar."""
    from busmaster.app.cli.progress import Bar  # before the line is opened; it takes a fifth of the time of --help

    bus = reach(connection)
    nodes = [bus.node(connection.profile, address, timings=connection.timings) for address in addresses]
    silent = []
    async with bus, late_nodes(bus) as late:
        with Bar("scanning", len(nodes)) as bar:
            for node in nodes:
                answer = await ask(node)
                if answer is None:
                    silent.append(node.address)
                else:
                    value, outcome = answer
                    number = connection.node_number(node.address)
                    found = json_line(node=number, value=json_value(value), answer=outcome, time=utc(time.time()))
                    with bar.hidden():
                        emit(found if as_json else f"{node.address} {outcome}")
                bar.advance()
        if silent:
            # so long the last one's answer may still take, and the silence behind it shows whose it was
            await anyio.sleep(connection.max_reply_delay + SILENCE)
        late.print_advice()
        for line in [line async for line in in_other_protocols(bus, connection.profile, silent)]:
            note(line)


async def in_other_protocols(bus: Bus | RemoteBus, profile: Profile, silent: Sequence[int]) -> AsyncIterator[str]:
    """Yield which nodes that are silent in this protocol answer in one that may share the line with it."""
    for other in protocols():
        if other.profile.name == profile.name or not other.profile.may_share_with(profile):
            continue
        for address in [address for address in silent if address in other.profile.addresses][:STRANGERS]:
            if await ask(bus.node(other.profile, address)) is not None:
                name = other.kinds[0].name
                yield f"{other.profile.label(address)} replies in {other.profile.title}; use --protocol {name}"


async def ask(node: Requester) -> tuple[object, str] | None:
    """Send one request to a node, and return the value and the result in words; None if it is silent.

    The request is repeated if the reply was garbled, or could have been a late reply of a node before it.
    """
    outcome = await ask_once(node)
    if isinstance(outcome, GarbledReply):
        outcome = await ask_once(node)
    if isinstance(outcome, GarbledReply):
        return None, f"{node.profile.probe}: {outcome.what}; {outcome.hint}"
    return outcome


async def ask_once(node: Requester) -> tuple[object, str] | GarbledReply | None:
    """Send a request to a node, and return the value and the result in words, garbled bytes, or None for silence."""
    probe = node.profile.probe
    try:
        # after the requests of other programs: a missing node takes its whole reply window
        value = await node.request(probe, retries=0, priority=Priority.BACKGROUND)
    except (NoReply, NodeDown):
        return None
    except Refused:
        return None, f"replies; refuses to {probe}"
    except GarbledReply as error:
        return error
    return value, f"{probe}: {value_text(value)}"
