"""A poll group of a line that another program owns: cycles as its owner tells them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from busmaster import Point
from busmaster.app.service.telling import FindNode, owners_point_of, snapshot_of
from busmaster.ext import Cycles


class RemoteGroup(Cycles):
    """A poll group of the line. Iterate it, or look at `latest`; close it when it is not read any more."""

    def __init__(self, name: str, points: tuple[Point[Any], ...], *, find: FindNode, end: Callable[[], None]) -> None:
        super().__init__(name)
        self.period = 0.0
        self.dropped = 0
        """Cycles that this program was too slow for, counted by the line's owner."""
        self._find = find
        self._on_end = end
        self._own = points
        self._points = points
        self._set = -1

    @property
    def own(self) -> bool:
        """Return whether this program made it: its values are then what this program's points decode."""
        return bool(self._own)

    @property
    def points(self) -> tuple[Point[Any], ...]:
        return self._points

    def close(self) -> None:
        """Read it no more; one that this program made ends."""
        if not self._over:
            self._on_end()

    def hear(self, method: str, params: Mapping[str, Any]) -> None:
        """Take what the line's owner says of it."""
        body = params["body"]
        for consumer in self._consumers:
            consumer.dropped += params["dropped"] - self.dropped
        self.dropped = params["dropped"]
        if method == "points":
            self._set = body["set"]
            # By its own points, a program gets the values that they decode.
            if not self._own:
                self._points = tuple(owners_point_of(said, self._find) for said in body["points"])
        elif method == "snapshot" and body["set"] == self._set:
            self._tell(snapshot_of(body, self.name, self._points))
        elif method == "ended":
            self._on_end()

    def end(self) -> None:
        """End those who read it, after what they hold."""
        self._end()
