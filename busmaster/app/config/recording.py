"""The outputs of a file."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import TypeAlias

from busmaster.app.config.keys import keys_of, names_of, read_keys
from busmaster.app.config.table import Table
from busmaster.app.outputs.kinds import OWN, find, names
from busmaster.app.outputs.settings import Settings
from busmaster.ext import meant

Outputs: TypeAlias = dict[str, Settings]
"""Those that are enabled, by their kind."""


def read_outputs(table: Table, groups: Iterable[str]) -> Outputs:
    """Read `[outputs]`, and return those that are enabled.

    Raises FileError with line and key for an error, also in an output that is not enabled.
    """
    if not table.data.keys() <= OWN.keys():
        table.only(*names(), advice="; an output of another package must be installed in this environment")
    outputs = dict(_enabled(table, tuple(groups)))
    taken: dict[str, str] = {}
    for kind, settings in outputs.items():
        for key in ("path", "spill"):
            path = getattr(settings, key, None)
            if not isinstance(path, str):
                continue
            path = os.path.realpath(path)  # it can be written in several ways, and through links
            if taken.setdefault(path, f"{kind}.{key}") != f"{kind}.{key}":
                with table.part():
                    raise table.table(kind).error(f"is already the file of {taken[path]}; use another path", key)
    return outputs


def _enabled(outer: Table, groups: Collection[str]) -> Iterator[tuple[str, Settings]]:
    for table in outer.each():
        if table.name not in OWN and table.name not in names():
            continue  # it was refused above
        with table.part():
            with table.at():
                kind = find(table.name)
            keys = [key for key in keys_of(kind.settings) if key.name not in kind.without]
            table.only(*names_of(keys))
            values = read_keys(table, keys)
            _check_groups(table, values.get("groups", ()), groups)
            with table.at():
                settings = kind.settings(**values)
            if settings.enabled:
                yield table.name, settings


def check_takes(table: Table, kind: str, settings: Settings, group: str, points: Mapping[str, str]) -> None:
    """Raise FileError for a group that an output cannot take. `points` has the sort of each point, by its key."""
    unsuitable = find(kind).unsuitable(settings, group, points)
    if unsuitable is not None:
        raise table.error(unsuitable.why, *([unsuitable.key] if unsuitable.key else []))


def _check_groups(table: Table, chosen: Collection[str], known: Collection[str]) -> None:
    for number, name in enumerate(chosen):
        if name not in known:
            raise table.error(f"no such group {name!r}; {meant(name, known)}", "groups", number)
