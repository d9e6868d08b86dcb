"""The one table of deadlines."""

from __future__ import annotations

from math import inf


class _Other:
    """A deadline that seldom changes: which of them is the earliest is found then, and not at every exchange."""

    def __set_name__(self, owner: type[Deadlines], name: str) -> None:
        self._name = name

    def __get__(self, deadlines: Deadlines, owner: type[Deadlines]) -> float:
        return deadlines.each[self._name]

    def __set__(self, deadlines: Deadlines, due: float) -> None:
        deadlines.each[self._name] = due
        deadlines.earliest_other = min(deadlines.each.values())


class Deadlines:
    """When what is due, in the arbiter's time; inf when it is not set."""

    __slots__ = ("each", "earliest_other", "line")

    schedule = _Other()
    """The next poll is due."""
    expiry = _Other()
    """The first queued request's `start_within` runs out."""
    failing = _Other()
    """More of what waited for a line that can no longer be used is to fail."""
    health = _Other()
    """A dead node's next probe, or the end of a suspension."""
    hold = _Other()
    """The line has been held for one sequence of requests for as long as it may be."""

    def __init__(self) -> None:
        self.line = inf
        """The state of the line ends: a window, a byte gap, a holdoff, a settle."""
        self.each: dict[str, float] = {}
        """All others, by name."""
        self.earliest_other = inf
        self.schedule = self.expiry = self.failing = self.health = self.hold = inf
