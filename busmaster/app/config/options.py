"""The options of a kind of node, as its protocol declares them, read off a table of the file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, Literal

from busmaster import InvalidCommand
from busmaster.app.config.keys import Form, Key, form_of, names_of, read_keys
from busmaster.app.config.names import expanded
from busmaster.app.config.table import Table
from busmaster.emulator import Delay
from busmaster.ext import Between, NodeKind, Option, kinds, read_file

HIGHEST_ADDRESS = 0xFFFF_FFFF
ADDRESS_SCHEMA = {"type": "integer", "minimum": 0, "maximum": HIGHEST_ADDRESS}


def keys_of_options(options: Sequence[Option]) -> tuple[Key, ...]:
    """Return options as keys."""
    return tuple(Key(one.name, _form(one), one.about or f"{one.help[:1].upper()}{one.help[1:]}.") for one in options)


def check_keys(
    table: Table, kind: NodeKind, common: Sequence[str], options_of: Callable[[NodeKind], Sequence[Option]]
) -> None:
    """Raise FileError for a key that is neither `common` to all nodes nor an option of this kind of node."""
    for key in table.data:
        holders = [other.name for other in kinds().values() if any(key == option.name for option in options_of(other))]
        if holders and kind.name not in holders:
            raise table.error(f"is only for nodes of {' and '.join(holders)}, not of {kind.name}; leave it out", key)
    table.only(*common, *(option.name for option in options_of(kind)))


def read_options(table: Table, known: Sequence[Option]) -> dict[str, Any]:
    """Return the options in the table, each as an argument."""
    return read_keys(table, keys_of_options(known))


def _form(option: Option) -> Form:
    match option.kind:
        case "text":
            return form_of(Literal[option.choices] if option.choices else str)
        case "addresses":
            schema: Mapping[str, Any] = {"type": "object", "additionalProperties": ADDRESS_SCHEMA}
            if option.reader is not None:
                schema = {"anyOf": [{"type": "string"}, schema]}
            return Form("table", schema, partial(_read_addresses, option))
        case "tables":
            fields = {key.name: {"description": key.about, **key.form.schema} for key in keys_of_options(option.fields)}
            each = {"type": "object", "properties": fields, "additionalProperties": False}
            return Form("table", {"type": "object", "additionalProperties": each}, partial(_read_tables, option.fields))
        case kind:
            return FORMS[kind]


def _read_addresses(option: Option, table: Table, key: str) -> Mapping[str, int]:
    """Read `symbols = { count = 2008 }`, or `symbols = "press.lst"` where the protocol can read such a file."""
    if option.reader is None or not isinstance(table.data[key], str):
        named = table.table(key)
        return {name: named.whole(name, most=HIGHEST_ADDRESS) for name in named.data}
    path = table.source.beside(table.text(key))
    with table.at(key):
        try:
            text = read_file(path).decode("latin-1")  # from a computer of then: any byte is some character
        except OSError as error:
            raise InvalidCommand(f"{path} cannot be read: {error.strerror or error}") from None
        try:
            return option.reader(text)
        except InvalidCommand as error:
            raise InvalidCommand(f"{path}: {error}") from None


def _read_tables(fields: Sequence[Option], table: Table, key: str) -> dict[str, dict[str, Any]]:
    """Return the contents of each table, for each name in the range of its own name."""
    found: dict[str, dict[str, Any]] = {}
    keys = keys_of_options(fields)
    for one in table.tables(key):
        one.only(*names_of(keys))
        values = read_keys(one, keys)
        with one.at():
            found |= dict.fromkeys(expanded(one.name), values)
    return found


def _read_positive(table: Table, key: str) -> float:
    value = table.number(key)
    if value <= 0:
        raise table.error(f"must be above 0, not {value}", key)
    return value


def _read_delay(table: Table, key: str) -> Delay:
    """Read `reply_delay = 0.002`, or `reply_delay = [0.001, 0.004]`."""
    value = table.data[key]
    bounds = value if isinstance(value, list) else [value]
    if len(bounds) not in (1, 2) or not all(type(bound) in (int, float) for bound in bounds):
        raise table.error("must be a number of seconds, or two of them: [0.001, 0.004]", key)
    with table.at(key):
        return Delay(*bounds)


DELAY = Form(
    "number, or list of two, s",
    {"anyOf": [{"type": "number"}, {"type": "array", "items": {"type": "number"}, "minItems": 1, "maxItems": 2}]},
    _read_delay,
    written=lambda delay: delay.low,
)
FORMS: Mapping[str, Form] = {
    "flag": form_of(bool),
    "whole": form_of(Annotated[int, Between(1)]),
    "number": form_of(float),
    "positive": Form("number, more than 0", {"type": "number", "exclusiveMinimum": 0}, _read_positive),
    "share": form_of(Annotated[float, Between(0, 1)]),
    "delay": DELAY,
    "numbers": Form(
        "list of whole numbers",
        {"type": "array", "items": ADDRESS_SCHEMA},
        lambda table, key: frozenset(table.wholes(key, most=HIGHEST_ADDRESS)),
    ),
}
"""The forms of the kinds of options that need nothing else."""
