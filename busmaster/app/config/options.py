"""The options of a kind of node, as its protocol declares them, read off a table of the file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from busmaster.app.config.names import expanded
from busmaster.app.config.table import Table
from busmaster.emulator import Delay
from busmaster.errors import InvalidCommand
from busmaster.ext import read_file
from busmaster.registry import NodeKind, Option, kinds

HIGHEST_ADDRESS = 0xFFFF_FFFF


def check_keys(
    table: Table, kind: NodeKind, common: Sequence[str], options_of: Callable[[NodeKind], Sequence[Option]]
) -> None:
    """Raise FileError for a key that is neither `common` to all nodes nor an option of this kind of node."""
    for key in table.data:
        holders = [other.name for other in kinds().values() if any(key == option.name for option in options_of(other))]
        if holders and kind.name not in holders:
            raise table.error(f"only nodes of {' and '.join(holders)} have this, not those of {kind.name}", key)
    table.only(*common, *(option.name for option in options_of(kind)))


def read_options(table: Table, known: Sequence[Option]) -> dict[str, Any]:
    """Return those of the options that the table says, each as the argument that it is."""
    return {option.name: _option(table, option) for option in known if option.name in table}


def _option(table: Table, option: Option) -> Any:
    name = option.name
    match option.kind:
        case "flag":
            return table.flag(name, False)
        case "whole":
            return table.whole(name, least=1)
        case "number":
            return table.number(name)
        case "positive":
            return table.positive(name)
        case "share":
            return table.share(name)
        case "delay":
            return read_delay(table, name)
        case "text":
            return table.choice(name, option.choices) if option.choices else table.text(name)
        case "numbers":
            return frozenset(table.wholes(name, most=HIGHEST_ADDRESS))
        case "addresses":
            return _addresses(table, option)
        case "tables":
            return {each: fields for one in table.tables(name) for each, fields in _named(one, option.fields)}


def _addresses(table: Table, option: Option) -> Mapping[str, int]:
    """Read `symbols = { count = 2008 }`, or `symbols = "press.lst"` where the protocol can read such a file."""
    if option.reader is None or not isinstance(table.data[option.name], str):
        named = table.table(option.name)
        return {key: named.whole(key, most=HIGHEST_ADDRESS) for key in named.data}
    path = table.source.beside(table.text(option.name))
    with table.at(option.name):
        try:
            text = read_file(path).decode("latin-1")  # from a computer of then: any byte is some character
        except OSError as error:
            raise InvalidCommand(f"{path} cannot be read: {error.strerror or error}") from None
        try:
            return option.reader(text)
        except InvalidCommand as error:
            raise InvalidCommand(f"{path}: {error}") from None


def _named(table: Table, fields: Sequence[Option]) -> list[tuple[str, dict[str, Any]]]:
    """Return what a table of `fields` says, under each name that its own stands for."""
    table.only(*(field.name for field in fields))
    said = read_options(table, fields)
    with table.at():
        return [(name, said) for name in expanded(table.name)]


def read_delay(table: Table, key: str) -> Delay:
    """Return `reply_delay = 0.002`, or `reply_delay = [0.001, 0.004]`, as the delay that it is."""
    value = table.data[key]
    bounds = value if isinstance(value, list) else [value]
    if len(bounds) not in (1, 2) or not all(type(bound) in (int, float) for bound in bounds):
        raise table.error("must be a number of seconds, or two of them: [0.001, 0.004]", key)
    with table.at(key):
        return Delay(*bounds)
