"""The outputs of a file."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from typing import Any, Literal, TypeAlias, get_args

from busmaster.config.table import Table
from busmaster.contract.arguments import meant
from busmaster.outputs.settings import (
    BUFFER,
    FileSettings,
    MetricsSettings,
    MqttSettings,
    Settings,
    SqliteSettings,
)

Kind: TypeAlias = Literal["csv", "jsonl", "sqlite", "mqtt", "metrics"]
Outputs: TypeAlias = dict[str, Settings]
"""Those that are enabled, by their kind."""


def read_outputs(table: Table, groups: Iterable[str]) -> Outputs:
    """Raises FileError, naming line and key: also in one that is not enabled."""
    table.only(*get_args(Kind))
    return dict(_enabled(table, tuple(groups)))


def _enabled(outer: Table, groups: tuple[str, ...]) -> Iterator[tuple[str, Settings]]:
    for table in outer.each():
        settings = READERS[table.name](table, _common(table, groups))
        if table.flag("enabled", True):
            yield table.name, settings


def _common(table: Table, groups: Collection[str]) -> dict[str, Any]:
    chosen = table.texts("groups", ())
    for number, name in enumerate(chosen):
        if name not in groups:
            raise table.error(f"no such group {name!r}; {meant(name, groups)}", "groups", number)
    return {"groups": chosen, "buffer": table.whole("buffer", BUFFER, least=1)}


def _file(table: Table, common: dict[str, Any]) -> Settings:
    table.only("enabled", "groups", "buffer", "path", "mode", "sync_every")
    return FileSettings(
        path=table.text("path"), mode=_mode(table), sync_every=table.seconds("sync_every", 10.0), **common
    )


def _mode(table: Table) -> int:
    """Who may read and write a new file, as chmod takes it in octal."""
    text = table.text("mode", "0640")
    if len(text) not in (3, 4) or not set(text) <= set("01234567") or int(text, 8) > 0o777:
        raise table.error('a mode is octal, as chmod takes it: mode = "0640"', "mode")
    return int(text, 8)


def _sqlite(table: Table, common: dict[str, Any]) -> Settings:
    table.only("enabled", "groups", "buffer", "path", "mode", "keep_days", "keep_mb")
    return SqliteSettings(
        path=table.text("path"),
        mode=_mode(table),
        keep_days=_limit(table, "keep_days"),
        keep_mb=_limit(table, "keep_mb"),
        **common,
    )


def _limit(table: Table, key: str) -> float | None:
    """How much is kept; None where everything is."""
    limit = table.number(key, None)
    if limit is not None and limit <= 0:
        raise table.error(f"must be more than 0, not {limit}; leave it out to keep all", key)
    return limit


def _mqtt(table: Table, common: dict[str, Any]) -> Settings:
    table.only(
        *("enabled", "groups", "buffer", "host", "port", "prefix", "messages", "qos", "retain"),
        *("username", "password_file", "tls", "ca_file", "allow_commands"),
    )
    prefix = table.text("prefix", "busmaster")
    if not prefix or set(prefix) & set("+#") or prefix.startswith("/") or prefix.endswith("/"):
        raise table.error("a topic has neither + nor #, nor a slash at an end", "prefix")
    messages = table.choice("messages", ("point", "cycle"), "point")
    return MqttSettings(
        host=table.text("host", "127.0.0.1"),
        port=table.whole("port", 1883, least=1, most=65535),
        prefix=prefix,
        messages="cycle" if messages == "cycle" else "point",
        qos=table.whole("qos", 1, most=1),
        retain=table.flag("retain", True),
        username=table.text("username", None),
        password_file=table.text("password_file", None),
        tls=table.flag("tls", False),
        ca_file=table.text("ca_file", None),
        allow=table.texts("allow_commands", ()),
        **common,
    )


def _metrics(table: Table, common: dict[str, Any]) -> Settings:
    table.only("enabled", "host", "port")
    return MetricsSettings(
        host=table.text("host", "127.0.0.1"), port=table.whole("port", 9464, least=0, most=65535), **common
    )


READERS = {"csv": _file, "jsonl": _file, "sqlite": _sqlite, "mqtt": _mqtt, "metrics": _metrics}
