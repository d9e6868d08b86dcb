"""How values and results are printed: plain lines, or one JSON object a line, each flushed."""

from __future__ import annotations

import sys
from collections.abc import Iterable

from busmaster.outputs.values import json_line, json_value, number_text, value_text, word_text

__all__ = ["emit", "emit_all", "json_line", "json_value", "note", "number_text", "value_text", "word_text"]


def emit(*lines: str) -> None:
    """Print to standard output and flush. Raises BrokenPipeError when nobody reads it any more."""
    emit_all(lines)


def emit_all(lines: Iterable[str]) -> None:
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()


def note(line: str) -> None:
    """A line for the person, on standard error."""
    print(f"busmaster: {line}", file=sys.stderr, flush=True)
