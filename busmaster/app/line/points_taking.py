"""Points taken from a CSV into a file: checked row by row, written only if all are good."""

from __future__ import annotations

import csv
import io
import os
import re
import stat
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from busmaster import InvalidCommand
from busmaster.app.config.point_section import POINT_KEYS, PointSection, check_suits, read_point
from busmaster.app.config.rewriting import Entries, rewritten, toml_text
from busmaster.app.config.sections import LineFile, NodeSection, read
from busmaster.app.config.source import FileError, Key, Source
from busmaster.app.config.table import Table
from busmaster.app.config.templates import read_template
from busmaster.app.line.configured_line import ConfiguredLine
from busmaster.app.line.points_table import COLUMNS, NODE, POINT, TEXTS, rows, sections
from busmaster.app.outputs.cells import text_of
from busmaster.ext import meant

DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+")
MOST_FAULTS = 20
"""Maximum number of errors of a CSV that are reported in full; the others are counted."""


class BadRows(InvalidCommand):
    """A CSV is not good. `faults` has a sentence for each thing that is wrong, with its row and column."""

    def __init__(self, *faults: str) -> None:
        self.faults = faults
        super().__init__("; ".join(faults))


@dataclass(frozen=True, slots=True)
class Change:
    """The change of one point by a CSV: its keys before, None for a new point, and after."""

    node: str
    point: str
    before: Entries | None
    after: Entries

    def __str__(self) -> str:
        name, before = f"{self.node}/{self.point}", self.before
        if before is None:
            return f"{name} is new: {toml_text(self.after)}"
        keys = (key for key in POINT_KEYS if not _same(before, self.after, key))
        changes = (f"{key} {_entry_text(before, key)} -> {_entry_text(self.after, key)}" for key in keys)
        return f"{name}: {', '.join(changes)}"


def _entry_text(entries: Entries, key: str) -> str:
    return toml_text(entries[key]) if key in entries else "none"


def _same(one: Entries, other: Entries, key: str) -> bool:
    """Return whether two points have the same value of a key. True differs from 1."""
    if key not in one or key not in other:
        return key not in one and key not in other
    return bool(one[key] == other[key]) and isinstance(one[key], bool) == isinstance(other[key], bool)


@dataclass(frozen=True, slots=True)
class Taking:
    """What becomes of a file by a CSV: its text, what changes, and the points that the CSV has not, which stay."""

    text: str
    changes: tuple[Change, ...]
    stay: tuple[str, ...]


def taken(file: LineFile, name: str, data: bytes) -> Taking:
    """Return a file changed by a CSV, called `name`, with rows for some or all of its points.

    Points are added and changed, never deleted. Keys without a column in the CSV are not changed. An empty cell removes
    the key. Raises BadRows with all errors of the rows, FileError for an error in the resulting file.
    """
    incoming = _Incoming(file, name)
    incoming.read(data)
    faults = incoming.faults
    if faults:
        raise BadRows(*faults[:MOST_FAULTS], *([f"and {len(faults) - MOST_FAULTS} more"] * (len(faults) > MOST_FAULTS)))
    stay = tuple(f"{row.node}/{row.point}" for row in rows(file) if (row.node, row.point) not in incoming.numbers)
    source = file.table.source
    if not incoming.changes:
        return Taking(source.text, (), stay)
    ConfiguredLine(incoming.file(), outputs=False)  # what does not go together is refused by row and column
    text = rewritten(source, incoming.own)
    assert read(Source(source.name, text)).nodes == incoming.file().nodes
    return Taking(text, tuple(incoming.changes), stay)


def write_beside(path: str, text: str) -> None:
    """Write a file anew, as whole as it was: beside it, and then in its place. Raises OSError, the file unchanged."""
    target = os.path.realpath(path)
    with open(target, "r+b") as held:  # refused where it may not be written, though its folder may be
        before = os.fstat(held.fileno())
    descriptor, beside = tempfile.mkstemp(prefix=f".{os.path.basename(target)}.", dir=os.path.dirname(target))
    try:
        with open(descriptor, "wb") as file:
            file.write(text.encode())
            file.flush()
            os.fchmod(descriptor, stat.S_IMODE(before.st_mode))
            with suppress(PermissionError):  # another user owned it; it now belongs to this user, who may write here
                os.fchown(descriptor, before.st_uid, before.st_gid)
            os.fsync(descriptor)
        os.replace(beside, target)
    except BaseException:
        os.unlink(beside)
        raise


class _RowPlace(Source):
    """Adds the row's number and the column to an error. The first part of a key is the point's name."""

    def __init__(self, name: str, number: int) -> None:
        super().__init__(name, "")
        self._number = number

    def error(self, key: Key, text: str) -> FileError:
        column = f", column {key[1]}" if len(key) > 1 else f", column {POINT}" if key else ""
        return FileError(self.name, 0, "", f"row {self._number}{column}: {' '.join([*map(str, key[2:]), text])}")


class _Incoming:
    """The rows of a CSV, and the changes of a file by them."""

    def __init__(self, file: LineFile, name: str) -> None:
        self.faults: list[str] = []
        self.changes: list[Change] = []
        self.numbers: dict[tuple[str, str], int] = {}
        """The row of each point that the CSV has."""
        self.own: dict[tuple[str, str], Entries] = {}
        """The new keys of each changed point in the node's own section."""
        self._file = file
        self._name = name
        self._sections = sections(file)
        self._line = ConfiguredLine(file, outputs=False)
        self._held = {(row.node, row.point): row for row in rows(file)}
        self._templates = {name: read_template(node.table, node.kind) for name, node in self._sections.items()}
        self._points: dict[str, dict[str, PointSection]] = {}

    def file(self) -> LineFile:
        """Return the file as the rows make it."""
        nodes = {
            name: replace(node, points={**node.points, **self._points.get(node.table.name, {})})
            for name, node in self._file.nodes.items()
        }
        return replace(self._file, nodes=nodes)

    def read(self, data: bytes) -> None:
        """Read all rows, and collect their errors. Raises BadRows if the text is not a CSV of points."""
        records = self._records(data)
        head = [cell.strip().lower() for cell in next(records, [])]
        for column in head:
            if column not in COLUMNS:
                raise BadRows(f"{self._name}: row 1: no such column {column!r}; {meant(column, COLUMNS)}")
            if head.count(column) > 1:
                raise BadRows(f"{self._name}: row 1: there are two columns {column}; remove one")
        for column in (NODE, POINT):
            if column not in head:
                raise BadRows(f"{self._name}: row 1: the column {column} is missing; add it")
        for number, cells in enumerate(records, 2):
            if any(cells):
                try:
                    self._row(_RowPlace(self._name, number), number, head, cells)
                except FileError as error:
                    self.faults.append(str(error))

    def _records(self, data: bytes) -> Iterator[list[str]]:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            line = data[: error.start].count(b"\n") + 1
            raise BadRows(f"{self._name}: line {line}: the file is not UTF-8; save it as UTF-8") from None
        delimiter = ";" if ";" in text.partition("\n")[0] else ","
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
        try:
            yield from reader
        except csv.Error as error:
            raise BadRows(f"{self._name}: line {reader.line_num}: not valid CSV: {error}") from None

    def _row(self, place: _RowPlace, number: int, head: Sequence[str], cells: Sequence[str]) -> None:
        """Read one row. Raises FileError for an error in it."""
        if len(cells) != len(head):
            more = "; put cells with a comma into quotes" if len(cells) > len(head) else ""
            raise place.error((), f"the row has {len(cells)} cells instead of {len(head)}{more}")
        given = dict(zip(head, cells, strict=True))
        where, name = text_of(given[NODE]), text_of(given[POINT])
        node = self._node(place, where)
        first = self.numbers.setdefault((where, name), number)
        if first != number:
            raise place.error((name,), f"{where}/{name} is also in row {first}; remove one of the rows")
        held = self._held.get((where, name))
        before = held.entries if held else {}
        after = {key: value for key in POINT_KEYS for value in _values(place, name, key, given, before)}
        if held and all(_same(before, after, key) for key in POINT_KEYS):
            return
        self.own[where, name] = self._own(place, where, name, after)
        self._points.setdefault(where, {})[name] = self._section(node, Table(place, (name,), after))
        self.changes.append(Change(where, name, before if held else None, after))

    def _node(self, place: _RowPlace, where: str) -> NodeSection:
        if where in self._sections:
            return self._sections[where]
        node = self._file.nodes.get(where)
        what = f"the node belongs to {node.table.name}; use that name" if node else meant(where, self._sections)
        raise place.error(("", NODE), f"no section of nodes has the name {where!r}; {what}")

    def _own(self, place: _RowPlace, where: str, name: str, after: Entries) -> Entries:
        """Return the keys for the node's own section that, together with the template, give this point."""
        template = self._templates[where].points.get(name)
        given = {} if template is None else template.data
        for key in given:
            if key not in after:
                value = toml_text(given[key])
                raise place.error((name, key), f"is {value} in the template and cannot be removed; write another value")
        written = self._file.table.source.data["nodes"][where].get("points", {}).get(name, {})
        return {key: after[key] for key in after if key in written or not _same(given, after, key)}

    def _section(self, node: NodeSection, table: Table) -> PointSection:
        """Read and check a point of that section."""
        section = read_point(table, node.kind)
        with table.at(*(["item"] if "item" in table else [])):
            point = self._line.nodes[node.name].point(section.item)
        check_suits(section, point, node.kind)
        return section


def _values(place: _RowPlace, name: str, key: str, given: dict[str, str], before: Entries) -> Iterator[Any]:
    """Yield the value of a key: that of the cell, or the present one if there is no such column."""
    cell = given.get(key)
    if cell is None:
        if key in before:
            yield before[key]
    elif cell:
        yield text_of(cell) if key in TEXTS else _value(place, (name, key), cell.strip())


def _value(place: _RowPlace, key: Key, cell: str) -> Any:
    """Return the value of a cell in the form of LINE.toml. An unsuitable value is rejected when its key is read."""
    if cell.lower() in ("true", "false"):
        return cell.lower() == "true"  # a spreadsheet writes TRUE
    if DECIMAL_COMMA.fullmatch(cell):
        raise place.error(key, f"{cell} has a decimal comma; write {cell.replace(',', '.')}")
    try:
        table = tomllib.loads(f"cell = {cell}")
    except tomllib.TOMLDecodeError:
        return cell
    return table["cell"] if len(table) == 1 else cell
