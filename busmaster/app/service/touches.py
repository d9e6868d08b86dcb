"""Which values of another program's line a write has made stale."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Any


class Touches:
    """What a line's owner has reported of writes: since when values of a point, a node or a protocol are stale.

    The owner reports a write before it confirms it, so that no program sees the value before as good once its write
    is confirmed. A value that was read before, and comes later, is recognised by the time of its read.
    """

    def __init__(self) -> None:
        self._when: dict[tuple[str | None, int | None, str | None], float] = {}

    def note(self, decoded: Mapping[str, Any]) -> None:
        """Take one message `touched` (docs/service.md). Without `items` it is of all points of its node, or of all
        nodes."""
        when, items = decoded["when"], decoded.get("items")
        if decoded.get("all"):
            self._when[None, None, None] = when
            return
        for item in (None,) if items is None else items:
            self._when[decoded["protocol"], decoded["address"], item] = when

    def is_stale(self, protocol: str, address: int, item: str, asked: float) -> bool:
        """Return whether a write to the point's place has ended since its value was requested."""
        keys = (protocol, address, item), (protocol, address, None), (None, None, None)
        return max(self._when.get(key, -inf) for key in keys) > asked
