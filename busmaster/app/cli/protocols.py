"""What the protocols add to the command line: their names, their options and their items, as they are found."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, TypeVar

import click

from busmaster.app.cli.parsing import Whole, option_type
from busmaster.ext import NodeKind, Option, find, kinds

F = TypeVar("F", bound=Callable[..., Any])

WIDTH = 77
"""Columns of the help of items."""


def parse_protocol(text: str) -> str:
    """Return the name of a kind of node. Raises InvalidCommand for any other."""
    return find(text).name


class ProtocolOption(click.Option):
    """`--protocol P`, whose help names them all."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return the help, with the names of all protocols in it."""
        text = self.help or ""
        self.help = text.replace("{}", ", ".join(kinds()))
        try:
            return super().get_help_record(ctx)
        finally:
            self.help = text


def protocol_option(*, required: bool = True, text: str = "One of {}.") -> Callable[[F], F]:
    """Give a command `--protocol P`; `{}` in its help, `text`, stands for the names."""
    return click.option(
        "--protocol", cls=ProtocolOption, required=required, type=option_type(parse_protocol), metavar="P", help=text
    )


class Offer(NamedTuple):
    """An option of the command line, and the kinds of nodes that have it."""

    option: Option
    kinds: tuple[str, ...]

    def parameter(self) -> click.Option:
        """Return the option as click has it."""
        flag = f"--{self.option.name.replace('_', '-')}"
        text = f"{', '.join(self.kinds)}: {self.option.help}."
        match self.option.kind:
            case "flag":
                return click.Option([flag], is_flag=True, help=text)
            case "whole":
                return click.Option([flag], type=Whole(min=1), metavar="N", help=text)
            case _:
                return click.Option([flag], metavar=self.option.name.upper(), help=text)


def offers(options_of: Callable[[NodeKind], Iterable[Option]]) -> list[Offer]:
    """Return those options of all kinds of nodes that the command line has, each name once."""
    found: dict[str, Offer] = {}
    for kind in kinds().values():
        for option in options_of(kind):
            if option.help:
                known = found.get(option.name, Offer(option, ()))
                found[option.name] = known._replace(kinds=(*known.kinds, kind.name))
    return list(found.values())


def handle_options() -> list[Offer]:
    """Return the options that a handle takes."""
    return offers(lambda kind: kind.options)


def read_options() -> list[Offer]:
    """Return the options that reading an item takes."""
    return offers(lambda kind: kind.read_options)


def take_options(offered: Iterable[Offer], protocol: str, given: dict[str, Any]) -> dict[str, Any]:
    """Remove the protocols' options from `given`, and return the set ones. Raises UsageError for another kind's."""
    taken = {}
    for option, names in offered:
        value = given.pop(option.name, None)
        if value in (None, False):
            continue
        if protocol not in names:
            raise click.UsageError(f"--{option.name.replace('_', '-')} is only for {' and '.join(names)}; leave it out")
        taken[option.name] = value
    return taken


class NodeCommand(click.Command):
    """A command on nodes: it takes the options of their handles too."""

    def offers(self) -> list[Offer]:
        """Return the options that the command takes beyond its own."""
        return handle_options()

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the command's own parameters, then the protocols' options, then --help."""
        *own, show_help = super().get_params(ctx)
        return [*own, *(offer.parameter() for offer in self.offers()), show_help]


class ItemCommand(NodeCommand):
    """A command on items: its help describes them, and refers to `busmaster items`."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write what an ITEM is, protocol by protocol, below the help."""
        head = "ITEM, by protocol (`busmaster items PROTOCOL` describes each):"
        self.epilog = "\n".join(("\b", head, *item_lines()))
        super().format_epilog(ctx, formatter)


def item_lines() -> Iterator[str]:
    """Yield lines that describe ITEM for each kind of node."""
    margin = 4 + max(map(len, kinds()))
    for kind in kinds().values():
        yield from textwrap.wrap(
            f"  {kind.name:{margin - 2}}{kind.items}",
            WIDTH,
            subsequent_indent=" " * margin,
            break_long_words=False,
            break_on_hyphens=False,
        )
