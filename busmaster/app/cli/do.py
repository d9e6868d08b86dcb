"""`busmaster do`: what a drive offers beside its values: enable, disable, reset, a command of its program."""

from __future__ import annotations

import textwrap
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager
from copy import copy
from functools import partial
from typing import Any, TypeVar, Unpack

import click

from busmaster import InvalidCommand, Point, ext
from busmaster.app.cli.arguments import Connection, connected, json_option
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.late import late_nodes
from busmaster.app.cli.lines import keep
from busmaster.app.cli.output import emit, json_line, json_value, name_fields, note, value_text
from busmaster.app.cli.parsing import option_type, parse_seconds, parse_value, parsed
from busmaster.app.cli.protocols import WIDTH, NodeCommand
from busmaster.app.cli.targets import NODE_AT, Lines, Target, split
from busmaster.app.line import ConfiguredLine
from busmaster.app.service.authorisation import WriteRequest
from busmaster.app.service.record import RAW_COMMAND, WriteRecord
from busmaster.app.service.values import utc
from busmaster.ext import Action, Changing, Command, CommandOptions, Handle, HeldNode, Placed, Requester, kinds

T = TypeVar("T")
MORE = "..."


class ActionCommand(NodeCommand):
    """A command on actions: its help lists those of each kind of node."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the actions, protocol by protocol, below the help."""
        self.epilog = "\n".join(("\b", "ACTION, by protocol:", *action_lines()))
        super().format_epilog(ctx, formatter)


def action_lines() -> Iterator[str]:
    """Yield the lines that list the actions of each kind of node."""
    for kind in kinds().values():
        for name, action in ext.actions(kind.handle).items():
            usage = " ".join((name, *action.numbers))
            yield f"  {kind.name:{max(map(len, kinds())) + 1}} {usage}"
            yield from textwrap.wrap(action.about, WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6)


# a number below 0 is an argument
@click.command(cls=ActionCommand, context_settings={"ignore_unknown_options": True})
@partial(connected, or_file=True, port=False)
@click.argument("node", metavar=NODE_AT)
@click.argument("action", metavar="ACTION")
@click.argument("numbers", nargs=-1, metavar="[NUMBER]...")
@click.option(
    "--within", type=option_type(parse_seconds), metavar="S", help="Seconds in which it must be done; else an error."
)
@click.option(
    "--at-least", type=option_type(parse_seconds), metavar="S", help="Seconds that it takes at least; else an error."
)
@json_option
def command(
    connection: Callable[[str], Connection],
    node: str,
    action: str,
    numbers: tuple[str, ...],
    within: float | None,
    at_least: float | None,
    as_json: bool,
) -> None:
    """Carry out an action of a node, wait until the node reports it, and print `ACTION ok`, with its reply if there is
    one.

    NODE is the name of a node in LINE.toml, or an address on PORT. An action that the node does not have is an error
    that lists those that it has. The limits of LINE.toml hold, and its outputs keep a record of each write. Where
    another busmaster owns the line, its limits hold, and its outputs keep the record.
    """
    if unknown := [text for text in (action, *numbers) if text.startswith("--")]:
        raise click.UsageError(f"no such option {unknown[0]!r}", click.get_current_context())
    values = [parsed(parse_value, text) for text in numbers]
    name, where = split(node)
    target = Lines().target(connection(where), name)
    found = action_of(target, action)
    options = options_of(found, action, values, within, at_least)
    until_ended(carry_out, target, action, found, values, options, as_json)


def action_of(target: Target, name: str) -> Action:
    """Return an action of a node. Raises UsageError, with those that it has, for another one."""
    known = ext.actions(target.handle)
    if name in known:
        return known[name]
    kind = target.kind.name
    if not known:
        raise click.UsageError(f"{target.label}: {kind} has no actions; write its values with busmaster write")
    raise click.UsageError(f"{target.label}: no such action {name!r}; {kind} has {', '.join(known)}")


def options_of(
    action: Action, name: str, values: Sequence[float], within: float | None, at_least: float | None
) -> dict[str, float]:
    """Return the arguments of an action beside its numbers. Raises UsageError if one is missing or unknown."""
    some = bool(action.numbers) and action.numbers[-1].endswith(MORE)
    fixed = len(action.numbers) - some
    if len(values) < fixed or (len(values) > fixed and not some):
        wanted = " ".join((name, *action.numbers))
        raise click.UsageError(f"{len(values)} numbers do not fit; write: {wanted}")
    if action.needs_time and within is None:
        raise click.UsageError(f"{name} needs --within S: the longest time that it may take")
    given = {action.time: within, action.least: at_least}
    for option, argument, value in (("--within", action.time, within), ("--at-least", action.least, at_least)):
        if value is not None and not argument:
            raise click.UsageError(f"{name} takes no {option}")
    return {argument: value for argument, value in given.items() if value is not None}


async def carry_out(
    target: Target, name: str, action: Action, values: Sequence[float], options: dict[str, float], as_json: bool
) -> None:
    """Carry out an action and print that it is done. Its writes are recorded if no owner does so."""
    records: list[WriteRecord] = []
    audit, handle = None, target.handle
    if target.line is not None and not target.owned:
        audit = target.line.audit(note)  # first: nothing is written of which no record can be kept
        target.line.authorisation.record = records.append
        handle = copy(handle)
        handle.node = RecordedNode(handle.node, target.line, target.name, handle, f"busmaster do {name}")
    try:
        action.check(handle, *values)
        async with target.bus, late_nodes(target.bus, in_file=target.line is not None):
            value = await action.run(handle, *values, **options)
    finally:
        if audit is not None:
            await keep(audit, records)
    if as_json:
        node = target.name or target.handle.node.address
        reply = {} if value is None else {"value": json_value(value), **name_fields(value)}
        emit(json_line(node=node, action=name, ok=True, **reply, time=utc(time.time())))
    else:
        emit(f"{name} ok" if value is None else f"{name} ok {value_text(value)}")


class RecordedNode(HeldNode):
    """A node of a file, for one action: each of its writes passes authorisation, and is on record."""

    def __init__(self, node: Requester, line: ConfiguredLine, name: str, handle: Handle, by: str) -> None:
        super().__init__(node)
        self._line = line
        self._name = name
        self._handle = handle
        self._by = by

    def check(self, *commands: Command[Any], stop: bool | None = None) -> None:
        """Check as the node does, and record rejected writes."""
        for command in commands:
            try:
                self._node.check(command, stop=stop)
            except InvalidCommand as error:
                self._line.authorisation.refuse(self._write_request(command), str(error))
                raise

    @asynccontextmanager
    async def exclusive(self, *, max_hold: float = 0.5) -> AsyncIterator[Requester]:
        """Hold the line as the node does. The writes of the sequence are recorded too."""
        async with self._node.exclusive(max_hold=max_hold) as held:
            yield RecordedNode(held, self._line, self._name, self._handle, self._by)

    async def request(
        self,
        command: Command[T],
        /,
        *,
        touches: Command[Any] | None = None,
        stops_seen: int | None = None,
        stop: bool = False,
        **options: Unpack[CommandOptions],
    ) -> T:
        """Do as the node does. A write is on record, however it ends."""
        if not command.writes:
            return await self._node.request(command, stops_seen=stops_seen, **options)
        with self._line.authorisation.begin(self._write_request(command)):
            return await self._node.request(command, touches=touches, stops_seen=stops_seen, stop=stop, **options)

    def _write_request(self, command: Command[Any]) -> WriteRequest:
        """Return the audit entry of a write: its point and value, or the command if no point matches."""
        for item in (*self._line.file.nodes[self._name].points, *self._handle.items()):
            point = self._line.point(f"{self._name}/{item}")
            if isinstance(command, Changing) and isinstance(point.command, Placed):
                changes = command.changes(self.profile)
                if changes.keys() == set(point.command.places):
                    value = point.value_of(point.command.shown(changes))
                    return self._write_request_of(point.key, point, value)
        return self._write_request_of(f"{self._name}/{RAW_COMMAND}", None, str(command))

    def _write_request_of(self, name: str, point: Point[Any] | None, value: Any) -> WriteRequest:
        return WriteRequest(interface="command line", by=self._by, name=name, point=point, value=value)
