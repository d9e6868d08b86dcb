"""Reads the points of a node, and checks them against the items of the protocol."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated, Any

from busmaster import BusError, Meaning, Point
from busmaster.app.config.keys import Internal, keys_of, names_of, read_keys
from busmaster.app.config.names import POINT_NAME
from busmaster.app.config.table import Table
from busmaster.ext import OF_QUANTITIES, Between, MeansNothing, NodeKind, Placed

WIDEST = 64
"""Maximum number of bits of a number."""
NO_QUANTITIES = ("word", "bit", "set")
LIMITS = ("minimum", "maximum", "max_step")


@dataclass(frozen=True, slots=True, kw_only=True)
class PointSection:
    """The name, scaling, meaning and write limits of a point, in its unit.

    `template`: the name of the template that defines a part of it, "" if the node's own section defines all.
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
    """Lower limit for writes, in the point's unit. Applies to all clients and to all names of the point."""
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
"""All keys of a point."""


def read_point(table: Table, kind: NodeKind, template: str = "") -> PointSection:
    """Read one point, of which that template defines a part.

    Raises FileError with line and key for an error in it.
    """
    if not POINT_NAME.fullmatch(table.name):
        raise table.error(f"the name {table.name!r} contains a space, comma or slash; use another name")
    table.only(*POINT_KEYS)
    values = {"item": table.name, **read_keys(table, keys_of(PointSection))}
    try:
        meaning = Meaning(**read_keys(table, keys_of(Meaning)))
    except MeansNothing as error:
        raise table.error(error.fault, error.field) from None
    section = PointSection(**values, name=table.name, meaning=meaning, template=template, table=table)
    if not section.factor:
        raise table.error("must not be 0, because every value would be the same", "factor")
    if section.decimals and not kind.takes_decimals:
        raise table.error(
            f"{kind.name} has no implied decimals; use factor = {10**-section.decimals:.{section.decimals}f} "
            "to scale the value on the line",
            "decimals",
        )
    return section


def check_suits(section: PointSection, point: Point[Any], kind: NodeKind) -> None:
    """Raise FileError for a key that does not suit the protocol's number."""
    for key, fault in _misfits(section, point, kind):
        raise section.table.error(fault, key)


def _misfits(section: PointSection, point: Point[Any], kind: NodeKind) -> Iterator[tuple[str, str]]:
    """Yield what does not suit, each with its key."""
    given, meaning, sort = section.table, section.meaning, sort_of(point, kind)
    listed = [key for key in (*LIMITS, *MEANINGS) if key in given]
    for key in listed:
        if sort == "run" and key not in ("precision", "deadband", "heartbeat"):
            yield key, f"is not possible for {section.item}, a run of values; make each value a point of its own"
        if sort == "text" and key != "heartbeat" and (key != "deadband" or meaning.deadband):
            yield key, f"is not possible for {section.item}, which is a text; leave it out"
        if sort in NO_QUANTITIES and key in OF_QUANTITIES:
            yield key, f"is not possible for {section.item}, which is a {sort} and not a quantity{OF_QUANTITIES[key]}"
    if sort in NO_QUANTITIES and meaning.deadband:
        yield "deadband", f"of a {sort} must be 0, because every change is reported"
    for key in ("bits", "labels"):
        if key not in listed:
            continue
        if sort == "set" and key == "labels":
            yield key, f"is not possible for {section.item}, which is a set of flags; name them by bits"
        if sort == "float":
            yield key, f"need whole numbers, but {section.item} has decimals; leave them out"
        for scaled in ("factor", "offset", "decimals"):
            if scaled in given:
                yield key, f"apply to the unscaled number on the line; leave out {scaled}"
    yield from _beyond(section, 1 if sort == "bit" else kind.width(section.item))


def _beyond(section: PointSection, width: int) -> Iterator[tuple[str, str]]:
    """Yield bits and labels of a number that has no room for them."""
    for name, bit in section.meaning.bits.items():
        if bit >= width:
            yield "bits", f"{name} is bit {bit}, but the highest bit of {section.item} is {width - 1}"
    for number in section.meaning.labels:
        if not -(2 ** (width - 1)) <= number < 2**width:
            yield "labels", f"{section.item} cannot be {number}, because it has {width} bit{'s' * (width > 1)}"


def sort_of(point: Point[Any], kind: NodeKind) -> str:
    """Return the sort of a protocol's point: "float", "whole", "word", "bit", "set", "text", "run"; "" if unknown.

    A read with a known place is decoded with zeros there, and the type of the value shows the sort.
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
