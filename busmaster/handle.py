"""What every handle shares: a node, and points by name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, ClassVar

from busmaster.errors import InvalidCommand
from busmaster.points import Point
from busmaster.profile import Profile

if TYPE_CHECKING:
    from busmaster.bus import Bus
    from busmaster.exchange import Timings


class Handle:
    """An awaitable handle of one node: thin and typed, over `Node.request`.

    Raises InvalidCommand for an address that the protocol does not have. Two handles of one address share the node.
    """

    profile: ClassVar[Profile]

    def __init__(self, bus: Bus, address: int, *, timings: Timings | None = None, retries: int | None = None) -> None:
        self.node = bus.node(self.profile, address, timings=timings, retries=retries)

    def point(self, item: str) -> Point[Any]:
        """The point that ITEM names on the command line. Raises InvalidCommand for one that does not exist."""
        raise NotImplementedError

    @classmethod
    def items(cls) -> tuple[str, ...]:
        """The names (not the numbers) that `point` knows."""
        return ()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.node.label}>"


def item_text(item: str) -> str:
    """The item. Raises InvalidCommand for a number: 1.10 would be 1.1, and 7 may be meant as `element(7)`."""
    if not isinstance(item, str):
        raise InvalidCommand(f"an item is text, such as {str(item)!r}, not {item!r}")
    return item


def unknown_item(item: str, known: Iterable[str], form: str) -> InvalidCommand:
    """The error for an item that does not exist: what would do, and the nearest name."""
    near = difflib.get_close_matches(str(item), list(known), n=1)
    guess = f"; did you mean {near[0]!r}?" if near else ""
    return InvalidCommand(f"no such item {item!r}: use {form}{guess}")
