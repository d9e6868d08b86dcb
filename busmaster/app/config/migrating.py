"""Conversion of an older LINE.toml to the present names. Comments and everything else are kept."""

from __future__ import annotations

import os
import tomllib
from typing import Any

from busmaster.app.config.source import TOKEN, Key, Source, Walk
from busmaster.ext import TIMES

TIMED = ("nodes", "protocols")
"""Tables whose tables have reply times, under the key `timing`."""


def migration(path: str | os.PathLike[str]) -> tuple[str, str]:
    """Return the text of a file, and the same text with the new name of each renamed key.

    Raises OSError if it cannot be read, and FileError with the line if it is not TOML or cannot be migrated.
    """
    source = Source.read(path)
    return source.text, migrated(source)


def migrated(source: Source) -> str:
    """Return the text of a file with the new name of each key that has one.

    Raises FileError for a key that stands there under both names.
    """
    edits: list[tuple[int, int, str]] = []
    text = source.text
    for key, pair in Walk(text).pairs.items():
        if _is_old(key) and _has(source.data, (*key[:-1], TIMES[str(key[-1])])):
            raise source.error(key, f"is also there under its new name {TIMES[str(key[-1])]!r}; delete one of them")
        names = [match for match in TOKEN.finditer(text[pair.start : pair.value]) if match.lastgroup != "mark"]
        names = [match for match in names if match.lastgroup in ("bare", "string")]
        for name, way in zip(reversed(names), (key[: len(key) - back] for back in range(len(names))), strict=True):
            if _is_old(way):
                edits.append((pair.start + name.start(), pair.start + name.end(), TIMES[str(way[-1])]))
    for start, end, new in sorted(set(edits), reverse=True):
        text = text[:start] + new + text[end:]
    assert tomllib.loads(text) == _renamed(source.data, ())
    return text


def _is_old(key: Key) -> bool:
    """Return whether it is a reply time by its old name: a table of such times has `read` and others within."""
    return len(key) > 3 and key[0] in TIMED and key[2] == "timing" and key[-1] in TIMES


def _renamed(data: Any, way: Key) -> Any:
    if not isinstance(data, dict):
        return data
    return {TIMES[key] if _is_old((*way, key)) else key: _renamed(value, (*way, key)) for key, value in data.items()}


def _has(data: Any, way: Key) -> bool:
    for name in way:
        if not isinstance(data, dict) or name not in data:
            return False
        data = data[name]
    return True
