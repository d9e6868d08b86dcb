"""Names that stand for several: `drive4-8` for drive4, drive5, ... drive8, in names of nodes and of items alike."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator

from busmaster.errors import InvalidCommand

RANGE = re.compile(r"(\d+)-(\d+)")
NODE_NAME = re.compile(r"[\w.-]+")
POINT_NAME = re.compile(r"[^\s/,]+")
MOST = 1000
"""Names that one range may stand for."""


def expanded(name: str, known: Container[str] = ()) -> Iterator[str]:
    """Yield the names that `name` stands for; one that is `known` as it is stands for itself.

    Raises InvalidCommand for a range that goes downwards or is too long.
    """
    found = None if name in known else RANGE.search(name)
    if found is None:
        yield name
        return
    first, last = int(found[1]), int(found[2])
    if not first <= last < first + MOST:
        raise InvalidCommand(
            f"a range goes upwards: {last}-{first}, not {found[0]}" if last < first else f"{found[0]} are too many"
        )
    width = len(found[1]) if found[1].startswith("0") else 0
    for number in range(first, last + 1):
        for rest in expanded(name[found.end() :]):
            yield f"{name[: found.start()]}{number:0{width}d}{rest}"


def listed(text: str) -> list[str]:
    """Return what stands between commas. Raises InvalidCommand where nothing does."""
    parts = [part.strip() for part in text.split(",")]
    if not all(parts):
        raise InvalidCommand(f"there is a name missing in {text!r}")
    return parts
