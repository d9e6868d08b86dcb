"""Cells of CSV: what a spreadsheet must neither compute nor change."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable

FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters of a formula in a spreadsheet."""
KEPT = re.compile(r"0|[1-9]\d{0,14}|[^\d\s.,'].*", re.DOTALL)
"""Texts that a spreadsheet leaves alone, if they begin no formula: a plain number, or what does not begin like one."""


def csv_lines(rows: Iterable[Iterable[object]]) -> bytes:
    """Return the rows as lines of CSV."""
    lines = _Lines()
    csv.writer(lines, lineterminator="\r\n").writerows(rows)  # a cell with one of these is put in quotes
    return "".join(lines).encode()


class _Lines(list[str]):
    """Lines as they are written, each with a line end of one character."""

    def write(self, line: str) -> None:
        """Add a line."""
        self.append(line.removesuffix("\r\n") + "\n")


def no_formula(text: str) -> str:
    """Return the text, behind an apostrophe where a spreadsheet would otherwise compute it."""
    return f"'{text}" if text[:1] in FORMULA else text


def text_cell(text: str) -> str:
    """Return a text that `text_of` restores exactly, with an apostrophe in front if it is not safe by itself.

    These are formulas, empty texts, and texts that a spreadsheet converts to a number or date: 1.20 to 1.2, 01 to
    1, 4-8 as a date.
    """
    return text if KEPT.fullmatch(text) and no_formula(text) == text else f"'{text}"


def text_of(cell: str) -> str:
    """Return the text of a cell that `text_cell` or a user has written."""
    return cell.removeprefix("'")
