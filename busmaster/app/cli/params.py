"""`busmaster params`: the parameters of a node saved to a file, compared, and written to a node."""

from __future__ import annotations

import asyncio
import os
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AsyncExitStack, contextmanager
from datetime import UTC, datetime
from functools import partial

import click

from busmaster import BusError, InvalidCommand, Priority, ext
from busmaster.app.cli.app import FAILED, OK, bus_error_text
from busmaster.app.cli.arguments import Connection, connected, json_option
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.late import late_nodes
from busmaster.app.cli.lines import keep
from busmaster.app.cli.output import Level, columns, emit, json_line, note, value_text
from busmaster.app.cli.parsing import option_type, parse_items
from busmaster.app.cli.protocols import ItemCommand, NodeCommand
from busmaster.app.cli.targets import AT, NODE_AT, Lines, Target, split
from busmaster.app.line.parameter_sets import (
    PART,
    PartFile,
    SetFile,
    check_new,
    in_unit,
    line_parameters,
    read_set,
    write_set,
)
from busmaster.app.service.authorisation import WriteRequest
from busmaster.app.service.record import WriteRecord, this_user
from busmaster.ext import (
    Change,
    Found,
    Left,
    NodeKind,
    Outcome,
    Parameter,
    ParameterLoad,
    ParameterSet,
    Result,
    Send,
    Value,
    empty_set,
    meant,
    walk,
)

DIFFERENT = 1
items_option = click.option(
    "--items",
    type=option_type(parse_items),
    metavar="ITEM,ITEM...",
    help="Only these items; 1.17:20 is 20 from 1.17 on. By default all in the protocol's document and LINE.toml.",
)


class Subcommands(click.Group):
    """A group that suggests the nearest command."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that the arguments name. Raises UsageError with the nearest name for an unknown one."""
        if args and not args[0].startswith("-") and args[0] not in self.commands:
            raise click.UsageError(f"no such command {args[0]!r}; {meant(args[0], self.commands)}", ctx)
        return super().resolve_command(ctx, args)


@click.group(cls=Subcommands)
def command() -> None:
    """Save the parameters of a node to a file, compare files and nodes, and write a file to a node.

    Each command has its own --help.
    """


# the parameters of a node


def parameters_of(target: Target, items: Sequence[str] | None = None) -> tuple[Parameter, ...]:
    """Return the parameters of a node, or those of `items`. Raises InvalidCommand if there are none."""
    if target.line is None:
        return target.handle.parameters(items or ())
    return line_parameters(target.line, target.name, target.handle, items or ())


def parameter_count(count: int) -> str:
    """Return a number of parameters in words."""
    return f"{count} parameter{'' if count == 1 else 's'}"


def known_parameters(target: Target) -> tuple[Parameter, ...]:
    """Return the parameters of a node, none if there is no list."""
    try:
        return parameters_of(target)
    except InvalidCommand:
        return ()


def prepare_change(target: Target, wanted: SetFile, change: Change, item: str) -> Send:
    """Return what writes a value, in the background. Raises InvalidCommand for one beyond a limit of LINE.toml or the
    range in the set."""
    wanted.check_range(change.parameter.item)
    if target.line is not None and target.owned:
        own = ext.plain_handle(target.line.nodes[target.name])
        ext.prepare_write(own, item, [change.value])  # its owner has limits too
    [send] = ext.prepare_write(target.handle, item, [change.value], priority=Priority.BACKGROUND)
    return send


@contextmanager
def recorded(target: Target, change: Change) -> Iterator[None]:
    """Keep a record of a write, where no owner does."""
    if target.line is None or target.owned:
        yield
        return
    parameter = change.parameter
    name = parameter.name if parameter.name in target.line.file.nodes[target.name].points else parameter.item
    request = WriteRequest(
        interface="command line",
        by="busmaster params load",
        name=f"{target.name}/{name}",
        point=target.line.point(f"{target.name}/{name}"),
        value=in_unit(parameter, change.value, target.kind),
    )
    with target.line.authorisation.begin(request):
        yield


def me() -> str:
    """Return who saves."""
    return f"{this_user()}@{platform.node()}"


def text_of(parameter: Parameter, value: Value | None, kind: NodeKind) -> str:
    """Return a value in its unit; "-" for none."""
    return "-" if value is None else value_text(in_unit(parameter, value, kind))


def called(parameter: Parameter) -> str:
    """Return item and name of a parameter."""
    return f"{parameter.item} ({parameter.name})" if parameter.name else parameter.item


# saving


@command.command("save", short_help="Save the parameters of a node to a file.", cls=ItemCommand)
@partial(connected, or_file=True)
@click.argument("node", required=False, metavar="[NODE]")
@click.option("-o", "--output", required=True, metavar="FILE.toml", help="The file to write.")
@items_option
def save_command(connection: Connection, node: str | None, output: str, items: tuple[str, ...] | None) -> int:
    """Read all parameters of a node and write them to a file: the node, and item, name, value, unit and range of each.

    NODE is the name of a node in LINE.toml, or an address on PORT. Leave it out if the protocol has no addresses.
    The reads have the lowest priority. Parameters that the node does not have are left out.

    Values are stored in FILE.toml.part: if the command is interrupted, the same command continues from there. FILE.toml
    is written at the end, as a whole. If another busmaster owns the line, the reads go through it.
    """
    parsed_output(output)
    target = Lines().target(connection, node or "")
    return until_ended(save, target, parameters_of(target, items), output)


def parsed_output(path: str) -> None:
    """Raise UsageError for a file that exists."""
    try:
        check_new(path)
    except InvalidCommand as error:
        raise click.UsageError(str(error)) from None


async def save(target: Target, parameters: Sequence[Parameter], path: str) -> int:
    """Read the parameters and write the file. Raises BusError if the node does not reply. Values are kept."""
    from busmaster.app.cli.progress import Bar  # it takes a fifth of the time of --help

    read = 0
    try:
        async with target.bus, late_nodes(target.bus, in_file=target.line is not None):
            empty = await empty_set(target.handle, me())
            with PartFile(path, empty, parameters, target.kind) as part, Bar(target.label, len(parameters)) as bar:
                read = len(parameters) - len(part.missing)
                if read:
                    note(f"{path}{PART}: {read} of {len(parameters)} were read before; continuing")
                bar.advance(read)
                async for found in walk(target.handle, part.missing):
                    part.add(found)
                    read += 1
                    bar.advance()
    except BaseException:
        if read:
            note(f"{read} of {len(parameters)} are in {path}{PART}; the same command continues there", Level.NOTICE)
        raise
    done = part.finish()
    gaps = sum(one.gap for one in part.gaps.values())
    note(f"{path}: {parameter_count(len(done.entries))} of {target.label}; without {gaps} that the node does not have")
    unread = [one for one in part.gaps.values() if not one.gap]
    for one in unread:
        note(f"{called(one.parameter)} could not be read: {one.why}", Level.WARNING)
    return FAILED if unread else OK


# comparing


@command.command("diff", short_help="Compare two files, or a file and a node.", cls=NodeCommand)
@partial(connected, or_file=True, port=False)
@click.argument("one", metavar=f"FILE.toml|{NODE_AT}")
@click.argument("other", metavar=f"FILE.toml|{NODE_AT}")
@items_option
@json_option
def diff_command(
    connection: Callable[[str], Connection], one: str, other: str, items: tuple[str, ...] | None, as_json: bool
) -> int:
    """Print the parameters that differ between two files, two nodes, or a file and a node, a line each.

    The exit status is 0 if all are equal, 1 if some differ, and 2 if they could not be compared. Of a node that is
    compared with a file, the parameters of the file are read.
    """
    lines = Lines()
    try:
        sides = [side(lines, connection, text) for text in (one, other)]
    except OSError as error:  # status 1 would mean that they differ
        raise click.ClickException(f"{error.filename}: {error.strerror}") from error
    kinds = [each.kind for each in sides]
    if kinds[0] is not kinds[1]:
        raise click.UsageError(f"{one} belongs to a {kinds[0].name}, {other} to a {kinds[1].name}; their items differ")
    try:
        return until_ended(diff, lines, sides, items, as_json)
    except BusError as error:
        raise click.ClickException(bus_error_text(error)) from error


def side(lines: Lines, connection: Callable[[str], Connection], text: str) -> SetFile | Target:
    """Return a file that was read, or a node."""
    if os.path.isfile(text) or AT not in text:
        return read_set(text)
    node, where = split(text)
    return lines.target(connection(where), node)


async def diff(lines: Lines, sides: Sequence[SetFile | Target], items: Sequence[str] | None, as_json: bool) -> int:
    """Print the differences and return the exit status."""
    files = [each.set for each in sides if isinstance(each, SetFile)]
    async with AsyncExitStack() as opened:
        for where, bus in lines.buses.items():
            await opened.enter_async_context(bus)
            await opened.enter_async_context(late_nodes(bus, in_file=where in lines.files))
        one, other = [each.set if isinstance(each, SetFile) else await read(each, files, items) for each in sides]
    kind = sides[0].kind
    wanted: set[str] | None = None
    if items is not None:
        wanted = {
            parameter.item for each in sides if isinstance(each, Target) for parameter in parameters_of(each, items)
        }
        wanted = wanted or named_items(files, items)
    found = [each for each in kind.handle.differences(one, other) if wanted is None or each.parameter.item in wanted]
    for item in one.identity.keys() & other.identity.keys():
        if one.identity[item] != other.identity[item]:
            note(f"{item} is {value_text(one.identity[item])} and {value_text(other.identity[item])}", Level.WARNING)
    rows = [
        (
            each.parameter.item,
            each.parameter.name,
            text_of(each.parameter, each.one, kind),
            text_of(each.parameter, each.other, kind),
            each.parameter.unit,
        )
        for each in found
    ]
    if as_json:
        for each in found:
            values = [None if v is None else in_unit(each.parameter, v, kind) for v in (each.one, each.other)]
            fields = {"item": each.parameter.item, "name": each.parameter.name or None, "unit": each.parameter.unit}
            emit(json_line(**fields, one=values[0], other=values[1]))
    elif rows:
        emit(*columns([("ITEM", "NAME", "ONE", "OTHER", "UNIT"), *rows], right=(2, 3)))
    return DIFFERENT if found else OK


def named_items(files: Sequence[ParameterSet], items: Sequence[str]) -> set[str]:
    """Return the items of two files that the user wants, each named by its item or its name.

    Raises UsageError for one that neither file has: the files would be called equal without a comparison.
    """
    parameters = [entry.parameter for one in files for entry in one.entries.values()]
    known = {one.name: one.item for one in parameters if one.name} | {one.item: one.item for one in parameters}
    for item in items:
        if item not in known:
            raise click.UsageError(f"neither file has a parameter {item!r}; {meant(item, known)}")
    return {known[item] for item in items}


async def read(target: Target, files: Sequence[ParameterSet], items: Sequence[str] | None) -> ParameterSet:
    """Read a node: what a file has that it is compared with, else all its parameters."""
    from busmaster.app.cli.progress import Bar

    if files and items is None:
        own = {one.item: one for one in known_parameters(target)}
        parameters = [own.get(item, entry.parameter) for item, entry in files[0].entries.items()]
    else:
        parameters = list(parameters_of(target, items))
    with Bar(target.label, len(parameters)) as bar:

        def progress(found: Found) -> None:
            bar.advance()

        return await target.handle.save_parameters(parameters, progress=progress, by=me())


# loading


@command.command("load", short_help="Write the parameters of a file to a node.", cls=NodeCommand)
@partial(connected, or_file=True, port=False)
@click.argument("path", metavar="FILE.toml", type=click.Path(exists=True, dir_okay=False))
@click.argument("node", metavar=NODE_AT)
@click.option("--dry-run", is_flag=True, help="Print the changes, and write nothing.")
@click.option("--yes", is_flag=True, help="Write without a question.")
@click.option("--enabled", is_flag=True, help="Write even if the drive is enabled or running.")
@click.option(
    "--undo",
    metavar="FILE.toml",
    help="File for the overwritten values; by default beside FILE.toml, with the time.",
)
def load_command(
    connection: Callable[[str], Connection],
    path: str,
    node: str,
    dry_run: bool,
    yes: bool,
    enabled: bool,
    undo: str | None,
) -> int:
    """Write the parameters that differ from the file to a node, after one question, and print `ITEM ok` for each.

    Parameters are written in the order of the protocol's document, a mode before all others and a command that stores
    them after all others. Each is read back. Read-only parameters and the node's communication settings are not
    written. Parameters that cannot be written are printed with the reason, and the exit status is 1.

    The old values are saved first, to a file that the same command can load. An enabled drive is refused unless
    --enabled is given; if its protocol cannot report this, a message is printed. The limits of LINE.toml apply, and its
    outputs log each write. If the line is lost, the same command writes the remaining parameters.
    """
    wanted = read_set(path)
    name, where = split(node)
    target = Lines().target(connection(where), name)
    wanted.check(target.handle)
    undo = undo or default_undo(path)
    parsed_output(undo)
    if not (yes or dry_run) and not sys.stdin.isatty():
        raise click.UsageError(
            "confirmation required, but there is no terminal; nothing was sent; use --yes or --dry-run"
        )
    return until_ended(write, target, wanted, dry_run, yes, enabled, undo, node)


def default_undo(path: str) -> str:
    """Return the name of a new file beside a set for what a load of it overwrites."""
    stem = f"{path.removesuffix('.toml')}.undo-{datetime.now(UTC):%Y%m%dT%H%M%S}"
    path, number = f"{stem}.toml", 1
    while os.path.exists(path):  # a set can be loaded into several nodes within a second
        number += 1
        path = f"{stem}-{number}.toml"
    return path


async def write(target: Target, wanted: SetFile, dry_run: bool, yes: bool, enabled: bool, undo: str, node: str) -> int:
    """Write the differences of a set to a node, and return the exit status."""
    records: list[WriteRecord] = []
    audit = None
    if target.line is not None and not target.owned:
        audit = target.line.audit(note)  # first: nothing is written of which no record can be kept
        target.line.authorisation.record = records.append
    try:
        async with target.bus, late_nodes(target.bus, in_file=target.line is not None):
            try:
                if not dry_run and not await may_be_written(target, enabled):
                    return FAILED
                plan = await prepare(target, wanted)
            except BusError:
                note("nothing was written")
                raise
            print_plan(plan, target)
            status = FAILED if any(not left.expected for left in plan.left) else OK
            if dry_run or not plan.changes:
                return status
            if not yes:
                if not await agreed(f"Write {parameter_count(len(plan.changes))} to {target.label}?"):
                    note("nothing was written")
                    return FAILED
                if not await may_be_written(target, enabled, again=True):
                    return FAILED
            write_set(undo, plan.undo, target.kind)
            note(f"the old values are in {undo}; to restore them: busmaster params load {undo} {node}")
            return max(status, await carry_out(plan, target))
    finally:
        if audit is not None:
            await keep(audit, records)


async def may_be_written(target: Target, enabled: bool, *, again: bool = False) -> bool:
    """Return whether the node is stopped, or --enabled was given. Prints a message if it runs or cannot report this.

    `again`: a second check, which does not repeat messages.
    """
    why = await target.handle.in_operation(priority=Priority.BACKGROUND)
    if why is None and not enabled and not again:
        kind = target.kind.name
        note(f"{target.label}: {kind} cannot report whether it is enabled; make sure that it is not", Level.WARNING)
    elif why and not (again and enabled):
        level = Level.WARNING if enabled else Level.ERROR
        advice = "" if enabled else "; nothing was written; stop the drive first, or use --enabled"
        note(f"{target.label} is in operation: {why}{advice}", level)
    return enabled or not why


async def prepare(target: Target, wanted: SetFile) -> ParameterLoad:
    """Read what the node holds of a set."""
    prepared = partial(prepare_change, target, wanted)
    plan = await target.handle.prepare_load(wanted.set, parameters=known_parameters(target), prepare=prepared, by=me())
    for item, value in wanted.set.identity.items():
        now = plan.undo.identity.get(item)
        if now is not None and now != value:
            note(f"{target.label}: {item} is {value_text(now)}, but {value_text(value)} in the file", Level.WARNING)
    return plan


def print_plan(plan: ParameterLoad, target: Target) -> None:
    """Print the changes, and the excluded parameters with the reason."""
    rows = [
        (
            each.parameter.item,
            each.parameter.name,
            text_of(each.parameter, each.before, target.kind),
            text_of(each.parameter, each.value, target.kind),
            each.parameter.unit,
        )
        for each in plan.changes
    ]
    if rows:
        emit(*columns([("ITEM", "NAME", "NOW", "FILE", "UNIT"), *rows], right=(2, 3)))
    for left in plan.left:
        note(left_text(left, target.kind), Level.INFO if left.expected else Level.WARNING)
    note(f"{target.label}: {len(rows)} to write, {plan.equal} equal, {len(plan.left)} excluded")


def left_text(left: Left, kind: NodeKind) -> str:
    """Return why a parameter is not written."""
    now, value = (text_of(left.parameter, one, kind) for one in (left.before, left.value))
    return f"{called(left.parameter)} is not written ({now}, in the file {value}): {left.why}"


async def agreed(question: str) -> bool:
    """Return whether the user agrees. The line goes on meanwhile."""
    os.write(sys.stderr.fileno(), f"{question} [y/N]: ".encode())
    loop = asyncio.get_running_loop()
    answer: asyncio.Future[bytes] = loop.create_future()

    def heard() -> None:
        loop.remove_reader(sys.stdin.fileno())
        if not answer.done():
            answer.set_result(os.read(sys.stdin.fileno(), 1024))

    loop.add_reader(sys.stdin.fileno(), heard)
    try:
        text = await answer
    finally:
        loop.remove_reader(sys.stdin.fileno())
    return text.strip().lower() in (b"y", b"yes")


async def carry_out(plan: ParameterLoad, target: Target) -> int:
    """Write the changes, print what became of each, and return the exit status."""
    outcomes: list[Outcome] = []
    try:
        async for outcome in plan.write(around=partial(recorded, target)):
            outcomes.append(outcome)
            if outcome.result is Result.WRITTEN:
                emit(f"{outcome.change.parameter.item} ok")
            else:
                print_failure(outcome)
    finally:
        # A signal or an internal error: report the remaining changes too.
        for number, change in enumerate(plan.changes[len(outcomes) :]):
            result = Result.UNCONFIRMED if number == 0 else Result.NOT_WRITTEN
            print_failure(Outcome(change, result, "the command was interrupted"))
    written = sum(outcome.result is Result.WRITTEN for outcome in outcomes)
    note(f"{target.label}: {written} of {len(plan.changes)} written")
    return OK if written == len(plan.changes) else FAILED


def print_failure(outcome: Outcome) -> None:
    """Report the result of a change that was not written on standard error."""
    level = Level.CRITICAL if outcome.result is Result.UNCONFIRMED else Level.ERROR
    note(f"{called(outcome.change.parameter)}: {outcome.result.value}: {outcome.why}", level)
