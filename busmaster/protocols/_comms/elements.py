"""Named elements of a comms array: the meaning of their numbers, and their description in the documents."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from busmaster.contract.items import Access, Bit, Item

T_co = TypeVar("T_co", covariant=True)


STARTS_EVENT = range(1, 6)
"""Comms 1 to 5: a write starts an event of the Mint program, even if the value is the same."""


@dataclass(frozen=True, slots=True)
class Element(Generic[T_co]):
    """One named element: the meaning of its number (`decode`), its unit, and whether it is R/W in the map.

    `kept`: why a load of parameters never writes it. `keyword`: its Mint keyword. A writable element is a level, such
    as outputs or a reference: writing it again changes nothing.
    """

    name: str
    number: int
    decode: Callable[[float], T_co]
    meaning: str
    unit: str = ""
    keyword: str = ""
    writable: bool = False
    bits: tuple[Bit, ...] = ()
    kept: str = ""

    @property
    def item(self) -> Item:
        """Its description in the document, for lists."""
        access: Access = "read/write" if self.writable else "read"
        return Item(self.name, str(self.number), self.meaning, self.unit, access, self.keyword, self.bits)


COMMS = (
    Item("1-5", "1-5", "the program's own; a write starts Event comms1 to comms5", "", "read/write", "COMMS"),
    Item("6-99", "6-99", "the program's own", "", "read/write", "COMMS"),
)
"""The elements that HCP and HCP2 have in common. The Mint program in the controller defines their meaning."""


def whole(value: float) -> int:
    """Return a count or a code, which is sent as a decimal number."""
    return round(value)


def bits(value: float) -> int:
    """Return a bitmap as a non-negative integer: bit 31 of a signed number stays bit 31."""
    return round(value) & 0xFFFF_FFFF


def by_name(elements: Iterable[Element[object]]) -> Mapping[str, Element[object]]:
    """Return the elements by their names."""
    return {element.name: element for element in elements}
