"""The places that a command reads or changes, and the values that it sends. Used to check limits, and to find point
values in overheard traffic.

A place is the smallest unit of a node: one element, one parameter, one register. Protocols that reach the same nodes
use the same names for their places.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any, Protocol, runtime_checkable

from busmaster.contract.profile import Profile


@runtime_checkable
class Placed(Protocol):
    """A read with known places. Quantities without such a read cannot be limited."""

    @property
    def places(self) -> tuple[Hashable, ...]:
        """Return the places that it reads."""
        ...

    def shown(self, values: Mapping[Hashable, Any], /) -> Any:
        """Return its result for these values of its places. Raises KeyError for a missing place."""
        ...


@runtime_checkable
class ReadsPlaces(Protocol):
    """A read whose result contains the value of each place, such as a block."""

    def place_values(self, value: Any, profile: Profile, /) -> Mapping[Hashable, Any]:
        """Return the value of each place for the result `value`, as far as known."""
        ...


@runtime_checkable
class Changing(Protocol):
    """A write with known places. Nodes with limits reject writes without them."""

    def changes(self, profile: Profile, /) -> Mapping[Hashable, Any]:
        """Return the value of each changed place after the write; None if it is not known."""
        ...


@runtime_checkable
class Rounding(Protocol):
    """A write that may send another value than it was given, because the telegram has too few characters."""

    @property
    def rounded(self) -> str:
        """Return a text for the log if the value was rounded, else ""."""
        ...


__all__ = [
    "Changing",
    "Placed",
]
