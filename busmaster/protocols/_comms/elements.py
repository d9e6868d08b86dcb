"""A named element of a comms array: what its number means."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

T_co = TypeVar("T_co", covariant=True)


@dataclass(frozen=True, slots=True)
class Element(Generic[T_co]):
    """One named element: what its number means (`decode`), in which unit, and whether the map says R/W.

    A writable element is a level, such as outputs or a reference: writing it again changes nothing.
    """

    name: str
    number: int
    decode: Callable[[float], T_co]
    unit: str = ""
    writable: bool = False


def whole(value: float) -> int:
    """A count or a code, which travels as a decimal number."""
    return round(value)


def bits(value: float) -> int:
    """A bitmap, as a non-negative integer: bit 31 of a signed number stays bit 31."""
    return round(value) & 0xFFFF_FFFF


def by_name(elements: Iterable[Element[object]]) -> Mapping[str, Element[object]]:
    return {element.name: element for element in elements}
