"""What a command reads or changes, place by place: what limits are held against, and what a listener learns of points.

A place is the smallest thing that a node keeps: one element, one parameter, one register. Protocols whose frames reach
the same nodes name their places alike.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any, Protocol, runtime_checkable

from busmaster.contract.profile import Profile


@runtime_checkable
class Placed(Protocol):
    """A read that says where it reads. What has no such read cannot be limited."""

    @property
    def places(self) -> tuple[Hashable, ...]:
        """Return where it reads."""
        ...

    def shown(self, values: Mapping[Hashable, Any], /) -> Any:
        """Return what it would return where its places hold these. Raises KeyError for a place that is missing."""
        ...


@runtime_checkable
class Telling(Protocol):
    """A read whose values are told apart by their places: a block tells each value in it."""

    def told(self, value: Any, profile: Profile, /) -> Mapping[Hashable, Any]:
        """Return what each place held when it returned `value`, as far as that is known."""
        ...


@runtime_checkable
class Changing(Protocol):
    """A write that says what it changes. One that does not is refused by a node that has limits."""

    def changes(self, profile: Profile, /) -> Mapping[Hashable, Any]:
        """Return what each place that it changes holds after it; None where that is not known."""
        ...


__all__ = [
    "Changing",
    "Placed",
]
