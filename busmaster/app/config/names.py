"""Names that stand for several: `drive4-8` for drive4, drive5, ... drive8, in names of nodes and of items alike."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator
from itertools import product
from math import prod

from busmaster import InvalidCommand
from busmaster.app.bounds import MOST_NAMES
from busmaster.ext import LONGEST_NUMBER

RANGE = re.compile(r"(\d+)-(\d+)")
NODE_NAME = re.compile(r"[\w.-]+")
POINT_NAME = re.compile(r"[^\s/,]+")
SHOWN = 40
"""Characters of a name that a message shows."""


def expanded(name: str, known: Container[str] = ()) -> Iterator[str]:
    """Yield the names that `name` stands for; one that is `known` as it is stands for itself.

    Raises InvalidCommand for a range that goes downwards, and for more than MOST_NAMES names.
    """
    found = [] if name in known else list(RANGE.finditer(name))
    ranges = [_numbers(one[1], one[2]) for one in found]
    if prod(map(len, ranges)) > MOST_NAMES:
        raise InvalidCommand(f"{name[:SHOWN]!r} expands to more than {MOST_NAMES} names; use shorter ranges")
    ends = [0, *(one.end() for one in found)]
    before = [name[end : one.start()] for end, one in zip(ends, found, strict=False)]
    for numbers in product(*ranges):
        yield "".join(map("".join, zip(before, numbers, strict=True))) + name[ends[-1] :]


def _numbers(first: str, last: str) -> list[str]:
    """Return the numbers of a range as texts. Raises InvalidCommand."""
    if max(len(first), len(last)) > LONGEST_NUMBER:
        raise InvalidCommand(f"a number in a range must have at most {LONGEST_NUMBER} digits")
    lowest, highest = int(first), int(last)
    if highest < lowest:
        raise InvalidCommand(f"the range {first}-{last} is descending; write {highest}-{lowest}")
    if highest - lowest >= MOST_NAMES:
        raise InvalidCommand(f"the range {first}-{last} has more than {MOST_NAMES} names; use a shorter one")
    width = len(first) if first.startswith("0") else 0
    return [f"{number:0{width}d}" for number in range(lowest, highest + 1)]


def listed(text: str) -> list[str]:
    """Return what stands between commas. Raises InvalidCommand where nothing does."""
    parts = [part.strip() for part in text.split(",")]
    if not all(parts):
        raise InvalidCommand(f"a name is missing in {text!r}; remove a comma, or add the name")
    return parts
