"""The points of a file as a table, a row each: for people, and as CSV.

A column is what a file can say of a point; a cell is empty where it is not said. Texts are as they are; numbers, `true`
and `false`, and tables of bits and labels are as in LINE.toml.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import get_type_hints

from busmaster.config.point_section import POINT_KEYS, PointSection
from busmaster.config.rewriting import Said, toml_text
from busmaster.config.sections import LineFile, NodeSection
from busmaster.outputs.cells import csv_lines, text_cell

NODE, POINT, ITEM, ORIGIN = "node", "point", "item", "origin"
COLUMNS = (NODE, POINT, *POINT_KEYS, ORIGIN)
SYMBOLS = "symbols"
TEXTS = frozenset(part.name for part in fields(PointSection) if get_type_hints(PointSection)[part.name] is str)
"""Keys whose cells are texts, and not written as in LINE.toml."""


@dataclass(frozen=True, slots=True)
class Row:
    """One point. `node` is the name of the section, which may be a range; `origin` where it comes from, if not there.

    That is the name of a template, or `symbols`.
    """

    node: str
    point: str
    said: Said
    origin: str


def rows(file: LineFile) -> Iterator[Row]:
    """Yield the points of a file, by its sections of nodes."""
    for node in sections(file).values():
        for name, point in node.points.items():
            yield Row(node.table.name, name, point.table.data, point.template)
        for name in node.options.get(SYMBOLS, ()):
            if name not in node.points:
                yield Row(node.table.name, name, {}, SYMBOLS)


def sections(file: LineFile) -> dict[str, NodeSection]:
    """Return the first node of each section: those of a range have their points in common."""
    found: dict[str, NodeSection] = {}
    for node in file.nodes.values():
        found.setdefault(node.table.name, node)
    return found


def said_text(said: Said, key: str) -> str:
    """Return what is said under a key as people read it; "" where nothing is."""
    return "" if key not in said else str(said[key]) if key in TEXTS else toml_text(said[key])


def points_csv(file: LineFile) -> bytes:
    """Return the points of a file as CSV, which `taken` takes to the letter."""
    return csv_lines([COLUMNS, *(map(_cells, rows(file)))])


def _cells(row: Row) -> Iterator[str]:
    """Yield the cells of a row."""
    yield text_cell(row.node)
    yield text_cell(row.point)
    for key in POINT_KEYS:
        text = said_text(row.said, key)
        yield text_cell(text) if key in TEXTS and key in row.said else text
    yield row.origin and text_cell(row.origin)
