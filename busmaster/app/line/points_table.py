"""The points of a file as a table with one row each, as text and as CSV.

A column is a key of a point. A cell is empty if the key is not set. Texts have no quotes; numbers, `true` and `false`,
and tables of bits and labels are as in LINE.toml.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, get_type_hints

from busmaster import Point
from busmaster.app.config.point_section import POINT_KEYS, PointSection
from busmaster.app.config.rewriting import Entries, toml_text
from busmaster.app.config.sections import LineFile, NodeSection
from busmaster.app.line.configured_line import ConfiguredLine
from busmaster.app.outputs.cells import csv_lines, text_cell
from busmaster.ext import Placed

NODE, POINT, ITEM, LIMITED_BY, ORIGIN = "node", "point", "item", "limited_by", "origin"
COLUMNS = (NODE, POINT, *POINT_KEYS, LIMITED_BY, ORIGIN)
"""The last two are export-only."""
SYMBOLS = "symbols"
TEXTS = frozenset(part.name for part in fields(PointSection) if get_type_hints(PointSection)[part.name] is str)
"""Keys whose cells are texts, and not written as in LINE.toml."""


@dataclass(frozen=True, slots=True)
class Row:
    """One point. `node` is the name of the section, which may be a range; `origin` where it comes from, if not there.

    That is the name of a template, or `symbols`. `limited_by` are the other points of the node whose limits hold for it
    as well: they name the same quantity, or a part of it.
    """

    node: str
    point: str
    entries: Entries
    origin: str
    limited_by: tuple[str, ...] = ()


def rows(file: LineFile) -> Iterator[Row]:
    """Yield the points of a file, by its sections of nodes."""
    limiting = _limiting(file)
    for node in sections(file).values():
        where = node.table.name
        for name, point in node.points.items():
            yield Row(where, name, point.table.data, point.template, limiting.get((where, name), ()))
        for name in node.options.get(SYMBOLS, ()):
            if name not in node.points:
                yield Row(where, name, {}, SYMBOLS, limiting.get((where, name), ()))


def _limiting(file: LineFile) -> dict[tuple[str, str], tuple[str, ...]]:
    """Return, for each point of a section, the other points whose limits apply to it."""
    found: dict[tuple[str, str], tuple[str, ...]] = {}
    limited = {where: node for where, node in sections(file).items() if any(p.limited for p in node.points.values())}
    line = ConfiguredLine(replace(file, groups={}), outputs=False) if limited else None  # without groups
    for where, node in limited.items():
        assert line is not None
        names = {name: name for name in node.options.get(SYMBOLS, ())}
        names |= {name: point.item for name, point in node.points.items()}
        places = {name: _places(line.nodes[node.name].point(item)) for name, item in names.items()}
        holding = [name for name, point in node.points.items() if point.limited]
        for name in names:
            found[where, name] = tuple(one for one in holding if one != name and places[one] & places[name])
    return found


def _places(point: Point[Any]) -> frozenset[Hashable]:
    return frozenset(point.command.places) if isinstance(point.command, Placed) else frozenset()


def sections(file: LineFile) -> dict[str, NodeSection]:
    """Return the first node of each section: those of a range have their points in common."""
    found: dict[str, NodeSection] = {}
    for node in file.nodes.values():
        found.setdefault(node.table.name, node)
    return found


def entry_text(entries: Entries, key: str) -> str:
    """Return the value of a key as text; "" if it is not set."""
    return "" if key not in entries else str(entries[key]) if key in TEXTS else toml_text(entries[key])


def points_csv(file: LineFile) -> bytes:
    """Return the points of a file as CSV, which `taken` takes to the letter."""
    return csv_lines([COLUMNS, *(map(_cells, rows(file)))])


def _cells(row: Row) -> Iterator[str]:
    """Yield the cells of a row."""
    yield text_cell(row.node)
    yield text_cell(row.point)
    for key in POINT_KEYS:
        text = entry_text(row.entries, key)
        yield text_cell(text) if key in TEXTS and key in row.entries else text
    yield text_cell(", ".join(row.limited_by))
    yield row.origin and text_cell(row.origin)
