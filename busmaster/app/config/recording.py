"""The outputs of a file."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import partial
from typing import TypeAlias

from busmaster.app.config.table import Readers, Table
from busmaster.app.outputs.kinds import OWN, find, names
from busmaster.app.outputs.settings import Settings
from busmaster.ext import meant

Outputs: TypeAlias = dict[str, Settings]
"""Those that are enabled, by their kind."""


def read_outputs(table: Table, groups: Iterable[str]) -> Outputs:
    """Read `[outputs]`, and return those that are enabled.

    Raises FileError, naming line and key, for what is wrong: also in one that is not enabled.
    """
    if not table.data.keys() <= OWN.keys():
        table.only(*names())
    outputs = dict(_enabled(table, tuple(groups)))
    taken: dict[str, str] = {}
    for kind, settings in outputs.items():
        for key in ("path", "spill"):
            path = getattr(settings, key, None)
            if path is not None and taken.setdefault(path, f"{kind}.{key}") != f"{kind}.{key}":
                with table.part():
                    raise table.table(kind).error(f"{taken[path]} is that file already", key)
    return outputs


def _enabled(outer: Table, groups: Collection[str]) -> Iterator[tuple[str, Settings]]:
    for table in outer.each():
        if table.name not in OWN and table.name not in names():
            continue  # it was refused above
        with table.part():
            with table.at():
                kind = find(table.name)
            readers: Readers = {**READERS, "groups": partial(_groups, known=groups)}
            said = table.typed(kind.settings, "enabled", readers=readers, without=kind.without)
            with table.at():
                settings = kind.settings(**said)
            if table.flag("enabled", True):
                yield table.name, settings


def check_takes(table: Table, kind: str, settings: Settings, group: str, points: Mapping[str, str]) -> None:
    """Raise FileError for a group that an output cannot take. `points` has the sort of each point, by its key."""
    unsuitable = find(kind).unsuitable(settings, group, points)
    if unsuitable is not None:
        raise table.error(unsuitable.why, *([unsuitable.key] if unsuitable.key else []))


def _groups(table: Table, key: str, known: Collection[str]) -> tuple[str, ...]:
    chosen = table.texts(key, ())
    for number, name in enumerate(chosen):
        if name not in known:
            raise table.error(f"no such group {name!r}; {meant(name, known)}", key, number)
    return chosen


def read_mode(table: Table, key: str) -> int:
    """Read who may read and write a new file, as chmod takes it in octal."""
    text = table.text(key)
    if len(text) not in (3, 4) or not set(text) <= set("01234567") or int(text, 8) > 0o777:
        raise table.error('a mode is octal, as chmod takes it: mode = "0640"', key)
    return int(text, 8)


def _limit(table: Table, key: str) -> float:
    """Read how much is kept, where not everything is."""
    limit = table.number(key)
    if limit <= 0:
        raise table.error(f"must be more than 0, not {limit}; leave it out to keep all", key)
    return limit


def _topic(table: Table, key: str) -> str:
    topic = table.text(key)
    if not topic or set(topic) & set("+#") or topic.startswith("/") or topic.endswith("/") or not topic.isprintable():
        raise table.error("a topic has neither + nor # nor control characters, nor a slash at an end", key)
    return topic


READERS: Readers = {
    "mode": read_mode,
    "keep_days": _limit,
    "keep_mb": _limit,
    "prefix": _topic,
}
"""What is more than its type."""
