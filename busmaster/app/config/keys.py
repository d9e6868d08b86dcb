"""The keys of LINE.toml. A key is declared once, as a field of the dataclass of its table.

    period: Annotated[float, Between(SHORTEST_PERIOD, LONGEST_PERIOD, "s")]
    \"""From one cycle to the next.\"""

Name, type and default are the field's own, `Between` is the range and the unit, and the text below the field is the
description. Reading, its errors, the reference of LINE.toml and the JSON Schema for editors are derived from that.

msgspec and cattrs were tried: both report neither the line of a key nor the nearest known key. msgspec stops at the
first problem, and cattrs accepts 5 as a text.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, field
from enum import Enum
from functools import cache
from types import UnionType
from typing import Annotated, Any, Final, Literal, TypeAlias, TypeVar, Union, get_args, get_origin, get_type_hints

from busmaster.app.bounds import LARGEST_WHOLE
from busmaster.app.config.source import FileError
from busmaster.app.config.table import Table, shown
from busmaster.ext import Between, Parsed, is_decimal

T = TypeVar("T")

MILLION = 1_000_000


class _Internal:
    """Marks a field that is not a key."""


INTERNAL: Final = _Internal()
Internal: TypeAlias = Annotated[T, INTERNAL]
"""The type of a section's field that is not a key: its table, or a result calculated from several keys."""


@dataclass(frozen=True, slots=True)
class Form:
    """The form of a key's value in a file.

    `shown` is its name in the reference, `schema` its JSON Schema. `read` reads it. `read` is None if the function of
    the section does that, because it needs more than this table; only then `required` makes the key mandatory.
    `written` returns the text of a default in a file. `name`: the key's name, if it is not the field's.
    """

    shown: str
    schema: Mapping[str, Any]
    read: Callable[[Table, str], Any] | None = None
    written: Callable[[Any], Any] | None = None
    name: str = ""
    required: bool = False


@dataclass(frozen=True, slots=True)
class Key:
    """One key of a table. `default` is what a file would have, None where there is none to show."""

    name: str
    form: Form
    about: str = ""
    default: object = None
    required: bool = False
    field: str = field(default="", kw_only=True)
    """The attribute that has its value."""


def keys_of(section: type) -> tuple[Key, ...]:
    """Return the keys that the fields of a dataclass declare, without their descriptions."""
    return _keys_of(section)


@cache
def _keys_of(section: type) -> tuple[Key, ...]:
    hints = get_type_hints(section, include_extras=True)
    return tuple(
        _key(part, hints[part.name])
        for part in dataclasses.fields(section)
        if part.init and INTERNAL not in getattr(hints[part.name], "__metadata__", ())
    )


def _key(part: dataclasses.Field[Any], hint: Any) -> Key:
    form = form_of(hint)
    default = None if part.default is MISSING or form.read is None else part.default
    if default is not None and form.written is not None:
        default = form.written(default)
    required = form.required if form.read is None else part.default is part.default_factory is MISSING
    return Key(form.name or part.name, form, "", None if default == () else default, required, field=part.name)


def names_of(keys: Iterable[Key]) -> tuple[str, ...]:
    """Return the names of keys."""
    return tuple(key.name for key in keys)


def read_keys(table: Table, keys: Iterable[Key]) -> dict[str, Any]:
    """Return the values that a table has for these keys, by the attributes that have them.

    Raises FileError for a value that its key cannot have, and, if there is none, for a required key that is missing.
    Where problems are collected, the other keys are read first.
    """
    values: dict[str, Any] = {}
    problems: list[FileError] = []
    for key in sorted(keys, key=lambda key: key.name not in table):
        if key.form.read is None or (key.name not in table and (problems or not key.required)):
            continue
        try:
            values[key.field or key.name] = key.form.read(table, key.name)
        except FileError as error:
            problems.append(error)
    for problem in problems:
        table.source.keep(problem)
    if problems:
        raise problems[0]
    return values


def read_section(table: Table, section: type) -> dict[str, Any]:
    """Do what `read_keys` does for all keys of a section, and report each other key."""
    table.only(*names_of(keys_of(section)))
    return read_keys(table, keys_of(section))


# forms


def form_of(hint: Any) -> Form:
    """Return what a file can have for a field of this type."""
    marks: tuple[Any, ...] = ()
    if get_origin(hint) is Annotated:
        hint, *rest = get_args(hint)
        marks = tuple(rest)
    between, parsed = Between(), None
    for mark in marks:
        match mark:
            case Form():
                return mark
            case Between():
                between = mark
            case Parsed():
                parsed = mark
    if parsed is None:
        return _plain(hint, between)
    form = _plain(hint if parsed.given is None else parsed.given, between)
    return _parsed_by(parsed.parse, form, shown=parsed.shown or form.shown, written=parsed.written)


def _plain(hint: Any, between: Between) -> Form:
    members = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    for member in members:
        if bool in members and dataclasses.is_dataclass(member) and isinstance(member, type):
            return flag_or_table(member)
        if get_origin(member) is Literal:
            return choice(get_args(member))
        if isinstance(member, type) and issubclass(member, Enum):
            return enumeration(member)
    if int in members and bool not in members:
        return whole(between)
    if float in members:
        return number(between)
    if str in members and between.most < math.inf:
        return text(int(between.most))
    return next(form for kind, form in FORMS.items() if kind in members)


def _parsed_by(parse: Callable[[Any], Any], form: Form, **changes: Any) -> Form:
    """Return a form whose value `parse` makes of that of another."""
    given = form.read
    assert given is not None

    def read(table: Table, key: str) -> Any:
        value = given(table, key)
        with table.at(key):
            return parse(value)

    return dataclasses.replace(form, read=read, **changes)


def choice(known: Iterable[str]) -> Form:
    """Return the form of a text that is one of `known`."""
    known = tuple(known)
    return Form(
        " or ".join(f'`"{one}"`' for one in known), {"enum": [*known]}, lambda table, key: table.choice(key, known)
    )


def enumeration(kind: type[Enum]) -> Form:
    """Return the form of a member of an enumeration of texts, by its value."""
    return _parsed_by(kind, choice(member.value for member in kind), written=lambda member: member.value)


def whole(between: Between) -> Form:
    """Return the form of a whole number; it is 0 or more, and LARGEST_WHOLE at most, unless its range is another."""
    least, most = int(max(between.least, 0)), LARGEST_WHOLE if between.most == math.inf else int(between.most)
    schema = {"type": "integer", "minimum": least, "maximum": most}
    about = ranged("whole number", between._replace(least=least))
    if between.self_checked:
        return Form(about, schema, Table.whole)
    return Form(about, schema, lambda table, key: table.whole(key, least=least, most=most))


def number(between: Between) -> Form:
    """Return the form of a number. A number of seconds has its own message if it has a largest value."""
    least, most, unit, self_checked = between

    def read(table: Table, key: str) -> float:
        value = table.number(key)
        if not least <= value <= most:
            range_ = f"{least:g} or more" if most == math.inf else f"{least:g} to {most:g}"
            raise table.error(f"must be {range_}, not {value}", key)
        return value

    def read_seconds(table: Table, key: str) -> float:
        return table.seconds(key, least=least, most=most)

    bounds = (("minimum", least), ("maximum", most))
    schema = {"type": "number", **{name: bound for name, bound in bounds if math.isfinite(bound)}}
    if self_checked:
        return Form(ranged("number", between), schema, Table.number)
    return Form(ranged("number", between), schema, read_seconds if unit == "s" and most < math.inf else read)


def text(most: int) -> Form:
    """Return the form of a text with at most so many characters."""

    def read(table: Table, key: str) -> str:
        value = table.text(key)
        if len(value) > most:
            raise table.error(f"must have at most {most} characters, not {len(value)}", key)
        return value

    return Form(f"text, at most {most} characters", {**TEXT_SCHEMA, "maxLength": most}, read)


def ranged(name: str, between: Between) -> str:
    """Return what the reference calls a number with this unit and range."""
    least, most, unit, _ = between
    text = f"{name}, {unit}" if unit else name
    if least > -math.inf and most < math.inf:
        return f"{text}, {least:g} to {f'{most:g}' if most < MILLION else f'{int(most):_d}'}"
    return f"{text}, {least:g} or more" if least > -math.inf else text


def table_of(name: str) -> Form:
    """Return the form of a table. `name` is that of its JSON Schema."""
    return Form("table", {"$ref": f"#/$defs/{name}"})


def flag_or_table(section: type) -> Form:
    """Return the form of true or false, or of a table whose keys this dataclass declares.

    The table's JSON Schema has the name of the class in lower case.
    """

    def read(table: Table, key: str) -> Any:
        value = table.data[key]
        if isinstance(value, bool):
            return value
        if not isinstance(value, dict):
            known = ", ".join(names_of(keys_of(section)))
            raise table.error(f"must be true, false or a table of {known}, not {shown(value)}", key)
        inner = table.table(key)
        values = read_section(inner, section)
        with inner.at():
            return section(**values)

    schema = {"anyOf": [{"type": "boolean"}, {"$ref": f"#/$defs/{section.__name__.lower()}"}]}
    return Form("true or false, or table", schema, read)


def tables_of(name: str, *, required: bool = False) -> Form:
    """Return the form of tables by name: `[nodes.winder]`, `[nodes.press]`."""
    schema = {"type": "object", "additionalProperties": {"$ref": f"#/$defs/{name}"}, "minProperties": int(required)}
    return Form("table", schema, required=required)


def _read_bits(table: Table, key: str) -> Mapping[str, int]:
    named = _named(table, key, "READY = 0")
    return {name: named.whole(name) for name in named.data}


def _read_labels(table: Table, key: str) -> Mapping[int, str]:
    named = _named(table, key, '0 = "off"')
    for number in named.data:
        if not is_decimal(number.removeprefix("-")):
            raise named.error(f'labels are of whole numbers: {{ 0 = "off" }}, not of {number!r}', number)
    labels = {int(number): named.text(number) for number in named.data}
    if len(labels) < len(named.data):
        raise table.error("define a number twice; leave out one of the labels", key)
    return labels


def _named(table: Table, key: str, example: str) -> Table:
    given = table.data[key]
    if not isinstance(given, dict) or not given:
        what = "an empty table" if given == {} else shown(given)
        raise table.error(f"must be a table of names: {{ {example} }}, not {what}", key)
    return table.table(key)


TEXT_SCHEMA: Final = {"type": "string"}
TEXT = Form("text", TEXT_SCHEMA, Table.text)
FLAG = Form("true or false", {"type": "boolean"}, Table.flag)
FORMS: Mapping[Any, Form] = {
    bool: FLAG,
    tuple[str, ...]: Form(
        "text, or list of texts", {"anyOf": [TEXT_SCHEMA, {"type": "array", "items": TEXT_SCHEMA}]}, Table.texts
    ),
    Mapping[str, int]: Form(
        "table", {"type": "object", "additionalProperties": whole(Between()).schema, "minProperties": 1}, _read_bits
    ),
    Mapping[int, str]: Form(
        "table",
        {
            "type": "object",
            "patternProperties": {"^-?[0-9]+$": TEXT_SCHEMA},
            "additionalProperties": False,
            "minProperties": 1,
        },
        _read_labels,
    ),
    str: TEXT,
}
"""The forms of the types that are not numbers."""
