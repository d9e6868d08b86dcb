"""How values and results are printed: plain lines, or one JSON object a line, each flushed."""

from __future__ import annotations

import sys
from collections.abc import Container, Iterable, Iterator, Sequence

from busmaster.cli.terminal import note, printable
from busmaster.outputs.values import json_line, json_value, number_text, value_text, word_text

__all__ = ["columns", "emit", "emit_all", "json_line", "json_value", "note", "number_text", "value_text", "word_text"]


def emit(*lines: str) -> None:
    """Print to standard output and flush. Raises BrokenPipeError when nobody reads it any more."""
    emit_all(lines)


def emit_all(lines: Iterable[str]) -> None:
    sys.stdout.write("".join(f"{printable(line)}\n" for line in lines))
    sys.stdout.flush()


def columns(rows: Sequence[Sequence[str]], right: Container[int] = ()) -> Iterator[str]:
    """The lines of a table: each column as wide as its widest cell; those numbered in `right` flush right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for cells in rows:
        padded = (
            cell.rjust(width) if number in right else cell.ljust(width)
            for number, (cell, width) in enumerate(zip(cells, widths, strict=True))
        )
        yield "  ".join(padded).rstrip()
