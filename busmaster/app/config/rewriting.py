"""Changes of points in the text of a file. Comments, order and everything else are kept."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from typing import Any, TypeAlias

from busmaster.app.config.source import FileError, Key, Source, Walk

Entries: TypeAlias = Mapping[str, Any]
"""The keys of one point and their values."""
BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(value: Any) -> str:
    """Return a value as TOML writes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # as in TOML, except for this character
    if isinstance(value, Mapping):
        inside = ", ".join(f"{key_text(key)} = {toml_text(one)}" for key, one in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml_text, value))}]"
    return repr(value)


def key_text(*names: str) -> str:
    """Return the way to a value as TOML writes it, in quotes where it needs them."""
    return ".".join(name if BARE.fullmatch(name) else toml_text(name) for name in names)


def rewritten(source: Source, points: Mapping[tuple[str, str], Entries]) -> str:
    """Return the file's text in which these points, by node section and name, have exactly these keys.

    Raises FileError for a point that is written in a form that cannot be changed.
    """
    editing = _Editing(source)
    wanted = deepcopy(source.data)
    added: dict[str, dict[str, Entries]] = {}
    for (node, name), entries in points.items():
        held = source.data["nodes"][node].get("points", {})
        wanted["nodes"][node].setdefault("points", {})[name] = entries
        if name in held:
            editing.change(("nodes", node, "points", name), held[name], entries)
        else:
            added.setdefault(node, {})[name] = entries
    for node, new in added.items():
        editing.add(("nodes", node, "points"), new)
    text = editing.text()
    try:
        as_wanted = tomllib.loads(text) == wanted
    except tomllib.TOMLDecodeError:
        as_wanted = False
    if not as_wanted:
        raise source.error(("nodes",), "points have a form that cannot be changed automatically; edit the file")
    return text


class _Editing:
    """Edits of one text. They are made in one go, so that all of them go by the places in the text as it was."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._before = source.text
        self._line_end = "\r\n" if "\r\n" in source.text else "\n"
        self._walk = Walk(source.text)
        self._edits: list[tuple[int, int, str]] = []

    def text(self) -> str:
        pieces, place = [], 0
        for start, end, new in sorted(self._edits, key=lambda edit: edit[0]):
            pieces += [self._before[place:start], new]
            place = max(place, end)
        return "".join(pieces) + self._before[place:]

    def change(self, point: Key, held: Entries, entries: Entries) -> None:
        """Give an existing point exactly these keys."""
        pair = self._walk.pairs.get(point)
        if pair is not None:  # position = { ... }
            self._edits.append((pair.value, pair.end, self._inline(point, held, entries)))
            return
        for key in held:
            if key not in entries:
                self._drop((*point, key))
            elif held[key] != entries[key]:
                self._replace((*point, key), entries[key])
        new = [((key,), entries[key]) for key in entries if key not in held]
        if new and not self._append(point, new):
            raise self._unable(point)

    def add(self, table: Key, points: Mapping[str, Entries]) -> None:
        """Add points to a node's."""
        if self._append(table, [((name,), entries) for name, entries in points.items()]):
            return
        node = self._walk.bodies.get(table[:-1], len(self._before))
        lines = (f"{key_text(name)} = {toml_text(entries)}" for name, entries in points.items())
        self._insert_lines(node, ["", f"[{key_text(*map(str, table))}]", *lines])

    # inside

    def _append(self, table: Key, pairs: Sequence[tuple[tuple[str, ...], Any]]) -> bool:
        """Add pairs at the end of a table, and return whether the table exists in the text."""
        if table in self._walk.bodies:  # [nodes.winder.points]
            self._insert_lines(self._walk.bodies[table], [f"{key_text(*way)} = {toml_text(v)}" for way, v in pairs])
            return True
        own = self._walk.pairs.get(table)
        if own is not None:  # points = { ... }
            inside = ", ".join(f"{key_text(*way)} = {toml_text(value)}" for way, value in pairs)
            ends = [pair.end for pair in self._walk.pairs.values() if pair.section == table]
            self._edits.append(
                (max(ends), max(ends), f", {inside}") if ends else (own.value, own.end, f"{{ {inside} }}")
            )
            return True
        dotted = [
            pair
            for key, pair in self._walk.pairs.items()
            if key[: len(table)] == table and len(pair.section) < len(table) and pair.section in self._walk.bodies
        ]
        if dotted:  # points.position.unit = ...
            last = max(dotted, key=lambda pair: pair.end)
            way = [str(name) for name in table[len(last.section) :]]
            self._insert_lines(last.end, [f"{key_text(*way, *names)} = {toml_text(value)}" for names, value in pairs])
        return bool(dotted)

    def _inline(self, point: Key, held: Entries, entries: Entries) -> str:
        """Return an inline table; values that did not change are written as they were."""
        return f"{{ {', '.join(self._members(point, held, entries))} }}" if entries else "{}"

    def _members(self, point: Key, held: Entries, entries: Entries) -> Iterator[str]:
        for key in (*(key for key in held if key in entries), *(key for key in entries if key not in held)):
            pair = self._walk.pairs.get((*point, key))
            kept = pair is not None and held[key] == entries[key]
            text = self._before[pair.value : pair.end] if pair and kept else toml_text(entries[key])
            yield f"{key_text(key)} = {text}"

    def _replace(self, way: Key, value: Any) -> None:
        pair = self._walk.pairs.get(way)
        if pair is None:
            raise self._unable(way)
        self._edits.append((pair.value, pair.end, toml_text(value)))

    def _drop(self, way: Key) -> None:
        """Take away the lines of a pair."""
        pair = self._walk.pairs.get(way)
        if pair is None:
            raise self._unable(way)
        self._edits.append((self._before.rfind("\n", 0, pair.start) + 1, self._after_line(pair.end), ""))

    def _insert_lines(self, behind: int, lines: list[str]) -> None:
        """Put lines behind the one on which that place is."""
        place = self._after_line(behind)
        opening = self._line_end if self._before[:place] and self._before[place - 1] != "\n" else ""
        self._edits.append((place, place, opening + "".join(line + self._line_end for line in lines)))

    def _after_line(self, place: int) -> int:
        return self._before.find("\n", place) + 1 or len(self._before)

    def _unable(self, way: Key) -> FileError:
        return self._source.error(way, "is not written as one pair, KEY = VALUE; edit the file")
