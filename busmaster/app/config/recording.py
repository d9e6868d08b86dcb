"""The outputs of a file."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import partial
from typing import TypeAlias

from busmaster.app.config.table import Readers, Table
from busmaster.app.outputs.settings import (
    FileSettings,
    MetricsSettings,
    MqttSettings,
    Settings,
    SqliteSettings,
)
from busmaster.bounds import LONGEST_TOPIC
from busmaster.ext import meant

Outputs: TypeAlias = dict[str, Settings]
"""Those that are enabled, by their kind."""


def read_outputs(table: Table, groups: Iterable[str]) -> Outputs:
    """Read `[outputs]`, and return those that are enabled.

    Raises FileError, naming line and key, for what is wrong: also in one that is not enabled.
    """
    table.only(*KINDS)
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
        kind = KINDS.get(table.name)
        if kind is None:
            continue  # it was refused above
        with table.part():
            readers: Readers = {**READERS, "groups": partial(_groups, known=groups)}
            said = table.typed(kind, "enabled", readers=readers, without=WITHOUT.get(table.name, ()))
            with table.at():
                settings = kind(**said)
            if table.flag("enabled", True):
                yield table.name, settings


def check_takes(table: Table, settings: Settings, group: str, points: Mapping[str, str]) -> None:
    """Raise FileError for a group that an output could not take: what its points are, by their keys."""
    match settings:
        case MqttSettings(messages="cycle"):
            _check_topic(table, settings, group, f"the group {group}")
        case MqttSettings():
            for key in points:
                _check_topic(table, settings, key, key)
        case MetricsSettings() if settings.groups:
            for key, sort in points.items():
                if sort in ("run", "set", "text"):
                    raise table.error(f"cannot take {key}: it is a {sort}, and a gauge is one number", "groups")


def _check_topic(table: Table, settings: MqttSettings, name: str, what: str) -> None:
    if not name.isprintable():
        raise table.error(f"cannot take {what!r}: a topic has no control characters")
    if len(f"{settings.prefix}/cycles/{name}".encode()) > LONGEST_TOPIC:
        raise table.error(f"cannot take {what[:40]}...: its name is longer than a topic may be")


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


KINDS: Mapping[str, type[Settings]] = {
    "csv": FileSettings,
    "jsonl": FileSettings,
    "sqlite": SqliteSettings,
    "mqtt": MqttSettings,
    "metrics": MetricsSettings,
}
READERS: Readers = {
    "mode": read_mode,
    "keep_days": _limit,
    "keep_mb": _limit,
    "prefix": _topic,
}
"""What is more than its type."""
WITHOUT = {"metrics": ("buffer",), "csv": ("audit",)}
"""Keys of its class that an output does not have: metrics hold no values, and CSV no audit entries."""
