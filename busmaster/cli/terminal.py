"""What reaches a terminal: no name and no text makes it move its cursor, change its colours or do anything else."""

from __future__ import annotations

import json
import unicodedata


def printable(text: str) -> str:
    """Write what a terminal would obey as JSON writes it: ESC becomes \\u001b, a new line \\n.

    Names and texts come from files, devices and networks. Inside a string of JSON the result is the same text.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or unicodedata.category(c) == "Zs" else json.dumps(c)[1:-1] for c in text)
