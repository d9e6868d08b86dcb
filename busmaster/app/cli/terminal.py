"""What reaches a terminal: no name and no text makes it move its cursor, change its colours or do anything else."""

from __future__ import annotations

import json
import unicodedata
from typing import Any


def printable(text: str) -> str:
    """Write what a terminal would obey as JSON writes it: ESC becomes \\u001b, a new line \\n.

    Names and texts come from files, devices and networks. Inside a string of JSON the result is the same text.
    """
    if text.isprintable():
        return text
    # Python calls no space printable but the plain one; those of any width (Zs) move nothing
    return "".join(c if c.isprintable() or unicodedata.category(c) == "Zs" else json.dumps(c)[1:-1] for c in text)


def made_printable(value: Any) -> Any:
    """Return a copy of `value` without control characters in its texts."""
    match value:
        case str():
            return printable(value)
        case dict():
            if set(value) == {"float"}:  # a number that JSON does not have
                return float(value["float"])
            return {name: made_printable(part) for name, part in value.items()}
        case list():
            return [made_printable(part) for part in value]
        case _:
            return value
