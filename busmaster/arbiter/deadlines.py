"""The one table of deadlines."""

from __future__ import annotations

from math import inf


class Deadlines:
    """When what is due, in the arbiter's time; inf when it is not set."""

    __slots__ = ("expiry", "health", "line", "schedule")

    def __init__(self) -> None:
        self.line = inf
        """The state of the line ends: a window, a byte gap, a holdoff, a settle."""
        self.schedule = inf
        """The next poll is due."""
        self.expiry = inf
        """The first queued request's `start_within` runs out."""
        self.health = inf
        """A dead node's next probe, or the end of a suspension."""

    def earliest(self) -> float:
        # It is asked after every byte that comes. A call of `min` takes more than twice as long.
        earliest = self.line
        if self.schedule < earliest:
            earliest = self.schedule
        if self.expiry < earliest:
            earliest = self.expiry
        if self.health < earliest:
            earliest = self.health
        return earliest
