"""The keys of LINE.toml as they are declared: read, bounded, and described in the reference and the JSON Schema."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from busmaster.app.config.keys import Key
from busmaster.app.config.schema import TableKeys, json_schema, tables
from busmaster.app.config.sections import read
from busmaster.app.config.source import FileError, Source
from busmaster.registry import Option, kinds

EXAMPLES = Path(__file__).parents[3] / "examples"
BASE: dict[str, Any] = {
    "port": {"path": "/dev/ttyUSB0"},
    "nodes": {"n": {"protocol": "hcp2", "address": 1, "points": {"p": {"item": "10"}}}},
    "groups": {"g": {"period": 1.0, "points": ["n/p"]}},
    "outputs": {
        "csv": {"path": "line.csv"},
        "jsonl": {"path": "line.jsonl"},
        "sqlite": {"path": "line.sqlite"},
        "mqtt": {},
        "metrics": {},
    },
    "safe": {"writes": {"n/p": 0}},
    "service": {"users": {"root": {"role": "read"}}},
}
"""A file with a table of each kind."""
PLACES: dict[str, tuple[str, ...]] = {
    "The top": (),
    "[port]": ("port",),
    "rs485 = {}": ("port", "rs485"),
    "[protocols.NAME]": ("protocols", "hcp2"),
    "[nodes.NAME]": ("nodes", "n"),
    "timing = {}": ("nodes", "n", "timing"),
    "[nodes.NAME.points]": ("nodes", "n", "points", "p"),
    "[groups.NAME]": ("groups", "g"),
    **{f"[outputs.{name}]": ("outputs", name) for name in BASE["outputs"]},
    "[safe]": ("safe",),
    "[service]": ("service",),
    "[service.users.NAME]": ("service", "users", "root"),
    "[emulator]": ("emulator",),
    "[emulator.nodes.NAME]": ("emulator", "nodes", "n"),
    "faults = {}": ("emulator", "faults"),
}
"""Where each table of the reference stands in it. Those of one protocol's nodes have files of their own."""
VALUES: tuple[Any, ...] = (
    *(
        "none-of-them",
        0,
        1,
        7,
        -7,
        1.5,
        True,
        [],
        ["x"],
        [7],
        {},
        {"a": 1},
        {"a": "x"},
        {"a": [7]},
        [{}],
        date(2026, 1, 1),
    ),
)
"""Values of every type that TOML has."""
SCHEMA = json_schema()
WHOLE = Draft202012Validator(SCHEMA)


def placed(table: TableKeys) -> tuple[dict[str, Any], tuple[str, ...]]:
    """A file for this table, and where the table stands in it."""
    header, _, kind = table.header.partition(" of ")
    if table.header == "[port] with host":
        return BASE | {"port": {"host": "127.0.0.1", "port": 5020, "baudrate": 9600}}, ("port",)
    if table.header == "[port] with rfc2217 = true":
        return BASE | {"port": {"host": "127.0.0.1", "port": 5020, "rfc2217": True}}, ("port",)
    if not kind:
        return BASE, PLACES[header]
    address = {"address": 11} if kinds()[kind].profile.addressed else {}
    return {"port": {"path": "/dev/ttyUSB0"}, "nodes": {"n": {"protocol": kind} | address}}, PLACES[header]


def source_with(data: dict[str, Any], place: tuple[str, ...], key: str, *value: Any) -> Source:
    """The file with this value there, or without that key."""
    copy: dict[str, Any] = {**data}
    inner = copy
    for name in place:
        inner[name] = {**inner.get(name, {})}
        inner = inner[name]
    inner.pop(key, None)
    if value:
        inner[key] = value[0]
    source = Source("line.toml", "")
    source.data = copy
    return source


def problem_of(data: dict[str, Any], place: tuple[str, ...], key: str, *value: Any) -> str:
    """What is wrong with that file, "" if nothing is."""
    try:
        read(source_with(data, place, key, *value))
    except FileError as error:
        return str(error)
    return ""


def allows(key: Key, value: Any) -> bool:
    """Whether the JSON Schema allows a value of the key."""
    return bool(WHOLE.evolve(schema=dict(key.form.schema)).is_valid(value))


KEYS = [(table, key) for table in tables() if table.header != "A template" for key in table.keys if "." not in key.name]


def test_json_schema_is_of_draft_2020_12() -> None:
    Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.slow
def test_json_schema_allows_what_the_program_reads_and_rejects_other_types() -> None:
    wrong = []
    for table, key in KEYS:
        data, place = placed(table)
        allowed = [value for value in VALUES if allows(key, value)]
        for value in VALUES:
            problem = problem_of(data, place, key.name, value)
            if not problem and value not in allowed:
                wrong.append(f"{table.header} {key.name} = {value!r}: the program reads it, the schema rejects it")
            if "no such key; " in problem.partition(f".{key.name}.")[0] and not isinstance(value, dict):
                wrong.append(f"{table.header} {key.name}: {problem}")
        if len(allowed) > len(VALUES) // 2:
            wrong.append(f"{table.header} {key.name}: the schema allows {allowed}")
    assert wrong == []


def test_a_value_beyond_its_bounds_is_rejected_by_the_program_and_by_the_json_schema() -> None:
    bounded = limited_texts = 0
    for table, key in KEYS:
        data, place = placed(table)
        schema = key.form.schema
        least, most = schema.get("minimum"), schema.get("maximum")
        for bound, beyond in ((least, -1), (most, 1)):
            if bound is None:
                continue
            bounded += 1
            assert allows(key, bound), key
            assert not allows(key, bound + beyond), key
            assert problem_of(data, place, key.name, bound + beyond), f"{table.header} {key.name} = {bound + beyond}"
        if (longest := schema.get("maxLength")) is not None:
            limited_texts += 1
            assert allows(key, "x" * longest), key
            assert not problem_of(data, place, key.name, "x" * longest), key
            assert not allows(key, "x" * (longest + 1)), key
            assert f"at most {longest} characters" in problem_of(data, place, key.name, "x" * (longest + 1)), key
        if key.form.shown.startswith('`"'):  # one of several texts
            assert not allows(key, "none-of-them"), key
            assert str(schema["enum"][0]) in problem_of(data, place, key.name, "none-of-them"), key
    assert bounded > 100
    assert limited_texts > 0


def test_a_key_that_is_left_out_has_its_default() -> None:
    for table, key in KEYS:
        data, place = placed(table)
        if key.required:
            assert problem_of(data, place, key.name), key
        elif key.default not in (None, ""):
            assert read(source_with(data, place, key.name)) == read(source_with(data, place, key.name, key.default)), (
                key
            )


def test_an_unknown_key_of_any_table_is_rejected_by_the_program_and_by_the_json_schema() -> None:
    for table in tables():
        if table.header == "A template":
            continue
        data, place = placed(table)
        assert WHOLE.is_valid(source_with(data, place, "unknown").data), table.header
        source = source_with(data, place, "unknown", 1)
        assert not WHOLE.is_valid(source.data), table.header
        with pytest.raises(FileError, match="no such key"):
            read(source)


def test_json_schema_allows_the_options_of_a_node_s_own_protocol_alone() -> None:
    node = {"protocol": "dc104", "maximum": 30}
    assert WHOLE.is_valid(BASE | {"nodes": {"n": node}})
    for wrong in (node | {"protocol": "hcp2"}, node | {"maximum": "30"}, node | {"maximum": 0}, {"maximum": 30}):
        assert not WHOLE.is_valid(BASE | {"nodes": {"n": wrong}}), wrong
    assert WHOLE.is_valid(BASE | {"protocols": {"dc104": {"maximum": 30}}})
    assert not WHOLE.is_valid(BASE | {"protocols": {"hcp2": {"maximum": 30}}})


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.name)
def test_json_schema_allows_every_example(path: Path) -> None:
    WHOLE.validate(tomllib.loads(path.read_text()))


def test_json_schema_describes_every_key() -> None:
    """Editors show the descriptions."""
    assert "description" in SCHEMA["properties"]["port"]
    for name, definition in SCHEMA["$defs"].items():
        for key, schema in definition.get("properties", {}).items():
            told = schema.get("description") or all(one.get("description") for one in schema.get("anyOf", [{}]))
            assert told or name in ("protocols", "outputs"), f"{name}.{key}"


def options() -> Iterator[Option]:
    for kind in kinds().values():
        for option in (*kind.options, *kind.emulated):
            yield option
            yield from option.fields


def test_every_option_of_a_kind_of_node_says_what_it_is() -> None:
    silent = {option.name for option in options() if not (option.about or option.help)}
    assert silent == set()


def test_what_the_reference_says_are_sentences() -> None:
    """A table of keys has one text, and each key one or more whole sentences."""
    for table in tables():
        for text in (table.about, *(key.about for key in table.keys)):
            assert re.fullmatch(r"[A-Z0-9`].*\.", text.removeprefix("value = ").capitalize(), re.DOTALL), text
