"""The points of a node, as a file says them: read, and checked against what the protocol has there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated, Any

from busmaster import Meaning, Point
from busmaster.app.config.keys import Internal, keys_of, names_of, read_keys
from busmaster.app.config.names import POINT_NAME
from busmaster.app.config.table import Table
from busmaster.errors import BusError
from busmaster.ext import OF_QUANTITIES, Between, MeansNothing, Placed
from busmaster.registry import NodeKind

WIDEST = 64
"""Bits of a number: what has more is no number."""
NO_QUANTITIES = ("word", "bit", "set")
LIMITS = ("minimum", "maximum", "max_step")


@dataclass(frozen=True, slots=True, kw_only=True)
class PointSection:
    """What a point is called, what its number on the line means, and what may be written to it, in its unit.

    `template`: the name of the template that says something of it, "" where the node's own section says all.
    """

    name: Internal[str]
    item: str = ""
    """The ITEM that it is, as on the command line. The point's own name by default."""
    unit: str = ""
    """The unit of its value: a name, which nothing is calculated with."""
    factor: float = 1
    """value = number on the line x factor + offset."""
    offset: float = 0
    """See `factor`."""
    decimals: Annotated[int, Between(0, 9)] = 0
    """How many of the number's last digits are decimals, where the line carries no point."""
    minimum: float | None = None
    """The least that may be written, in its unit, by whatever name and whoever writes."""
    maximum: float | None = None
    """The most that may be written, likewise."""
    max_step: float | None = None
    """How far a write may be from the last value that was confirmed; more than 0."""
    writable: bool = True
    """Whether it may be written at all."""
    read_after_write: bool = False
    """Whether a polled point is read as soon as a write to it is confirmed, ahead of its next poll."""
    meaning: Internal[Meaning]
    template: Internal[str] = field(default="", compare=False)
    table: Internal[Table] = field(compare=False, repr=False)

    @property
    def limited(self) -> bool:
        """Whether anything holds it back."""
        return not self.writable or any(getattr(self, limit) is not None for limit in LIMITS)


MEANINGS = names_of(keys_of(Meaning))
POINT_KEYS = (*names_of(keys_of(PointSection)), *MEANINGS)
"""All that a file can say of a point."""


def read_point(table: Table, kind: NodeKind, template: str = "") -> PointSection:
    """Read one point, of which that template says something.

    Raises FileError, naming line and key, for what is wrong in it.
    """
    if not POINT_NAME.fullmatch(table.name):
        raise table.error(f"a point's name has no spaces, commas or slashes: {table.name!r} has")
    table.only(*POINT_KEYS)
    values = {"item": table.name, **read_keys(table, keys_of(PointSection))}
    try:
        meaning = Meaning(**read_keys(table, keys_of(Meaning)))
    except MeansNothing as error:
        raise table.error(error.fault, error.field) from None
    section = PointSection(**values, name=table.name, meaning=meaning, template=template, table=table)
    if not section.factor:
        raise table.error("a factor of 0 makes every value the same", "factor")
    if section.decimals and not kind.takes_decimals:
        raise table.error(
            f"{kind.name} has no implied decimals: write factor = {10**-section.decimals:.{section.decimals}f} "
            "to scale what is sent",
            "decimals",
        )
    return section


def check_suits(section: PointSection, point: Point[Any], kind: NodeKind) -> None:
    """Raise FileError for what a file says of a point and the protocol's number there cannot bear."""
    for key, fault in _misfits(section, point, kind):
        raise section.table.error(fault, key)


def _misfits(section: PointSection, point: Point[Any], kind: NodeKind) -> Iterator[tuple[str, str]]:
    """Yield what does not suit, each with its key."""
    given, meaning, sort = section.table, section.meaning, sort_of(point, kind)
    said = [key for key in (*LIMITS, *MEANINGS) if key in given]
    for key in said:
        if sort == "run" and key not in ("precision", "deadband", "heartbeat"):
            yield key, f"cannot be said of {section.item}, a run of values: make each value a point of its own"
        if sort == "text" and key != "heartbeat" and (key != "deadband" or meaning.deadband):
            yield key, f"cannot be said of {section.item}, which is a text"
        if sort in NO_QUANTITIES and key in OF_QUANTITIES:
            yield key, f"cannot be said of {section.item}, which is a {sort} and no quantity{OF_QUANTITIES[key]}"
    if sort in NO_QUANTITIES and meaning.deadband:
        yield "deadband", f"of a {sort} is 0: every change is told"
    for key in ("bits", "labels"):
        if key not in said:
            continue
        if sort == "set" and key == "labels":
            yield key, f"cannot be said of {section.item}, which is a set of many: name them by bits"
        if sort == "float":
            yield key, f"are of whole numbers, and {section.item} has decimals"
        for scaled in ("factor", "offset", "decimals"):
            if scaled in given:
                yield key, f"are of the number as it is on the line: leave out {scaled}"
    yield from _beyond(section, 1 if sort == "bit" else kind.width(section.item))


def _beyond(section: PointSection, width: int) -> Iterator[tuple[str, str]]:
    """Yield bits and labels of a number that has no room for them."""
    for name, bit in section.meaning.bits.items():
        if bit >= width:
            yield "bits", f"{name} is bit {bit}, and the highest of {section.item} is bit {width - 1}"
    for number in section.meaning.labels:
        if not -(2 ** (width - 1)) <= number < 2**width:
            yield "labels", f"{section.item} is never {number}: it has {width} bit{'s' * (width > 1)}"


def sort_of(point: Point[Any], kind: NodeKind) -> str:
    """Return what a protocol's point is: "float", "whole", "word", "bit", "set", "text", "run"; "" where nobody knows.

    A read that says where it reads tells what it would return, and so what its value would be if all were 0 there.
    """
    width = kind.width(point.item)
    if width in (0, 1) or width > WIDEST:
        return {0: "run", 1: "bit"}.get(width, "set")
    if not isinstance(point.command, Placed):
        return ""
    try:
        value = point.value_of(point.command.shown(dict.fromkeys(point.command.places, 0)))
    except (BusError, ArithmeticError, LookupError, TypeError, ValueError):
        return ""
    for known, sort in SORTS.items():
        if isinstance(value, known):
            return sort
    return ""


SORTS: Mapping[type, str] = {
    bool: "bit",
    Enum: "word",
    frozenset: "word",
    int: "whole",
    float: "float",
    str: "text",
    bytes: "text",
    tuple: "run",
    list: "run",
}
"""In this order: a bit is an int too, and so may be a word."""
