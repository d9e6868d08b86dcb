"""What the reference says of LINE.toml's keys is what reading does: names, kinds, bounds, defaults."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

import pytest

from busmaster.app.config.keys import REQUIRED, Key, TableKeys
from busmaster.app.config.schema import tables
from busmaster.app.config.sections import LineFile, read
from busmaster.app.config.source import FileError, Source
from busmaster.registry import Option, kinds

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
WRONG: dict[str, Any] = {
    **dict.fromkeys(("text", "mode", "texts"), 7),
    **dict.fromkeys(("flag", "whole", "number", "seconds", "wholes", "table", "delay"), "no"),
    **dict.fromkeys(("address", "timing", "port"), True),
}
"""For each kind of key a value of another."""


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


def said(data: dict[str, Any], place: tuple[str, ...], key: str, *value: Any) -> LineFile:
    """The file with this value there, or without that key."""
    if not place:
        changed = {name: old for name, old in data.items() if name != key} | ({key: value[0]} if value else {})
        source = Source("line.toml", "")
        source.data = changed
        return read(source)
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
    return read(source)


KEYS = [(table, key) for table in tables() if table.header != "A template" for key in table.keys if "." not in key.name]
each_key = pytest.mark.parametrize(("table", "key"), KEYS, ids=[f"{table.header} {key.name}" for table, key in KEYS])


@each_key
def test_a_key_of_the_reference_is_known_and_takes_no_other_kind_of_value(table: TableKeys, key: Key) -> None:
    with pytest.raises(FileError) as caught:
        said(*placed(table), key.name, WRONG[key.kind])
    assert "no such key" not in str(caught.value)


@each_key
def test_a_value_beyond_the_bounds_of_the_reference_is_refused(table: TableKeys, key: Key) -> None:
    beyond = [bound for bound in (key.least - 1, key.most + 1) if math.isfinite(bound)]
    whole = key.kind == "whole"
    for value in beyond:
        with pytest.raises(FileError):
            said(*placed(table), key.name, int(value) if whole else float(value))
    if key.choices:
        with pytest.raises(FileError, match=f"{re.escape(key.choices[0])}"):
            said(*placed(table), key.name, "none-of-them")


@each_key
def test_left_out_a_key_is_as_its_default_says(table: TableKeys, key: Key) -> None:
    data, place = placed(table)
    if key.default == REQUIRED:
        with pytest.raises(FileError):
            said(data, place, key.name)
    elif key.default:
        source = Source("default", f"value = {key.default}")
        assert said(data, place, key.name) == said(data, place, key.name, source.data["value"])


def test_the_bounds_themselves_are_taken() -> None:
    for table, key in KEYS:
        if key.kind == "whole" and math.isfinite(key.most) and table.header.startswith("[outputs"):
            said(*placed(table), key.name, int(key.most))


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
