"""The one table of deadlines."""

from __future__ import annotations

from math import inf


class Deadlines:
    """When what is due, in the arbiter's time; inf when it is not set."""

    __slots__ = ("expiry", "failing", "health", "line", "schedule")

    def __init__(self) -> None:
        self.line = inf
        """The state of the line ends: a window, a byte gap, a holdoff, a settle."""
        self.schedule = inf
        """The next poll is due."""
        self.expiry = inf
        """The first queued request's `start_within` runs out."""
        self.failing = inf
        """More of what waited for a line that can no longer be used is to fail."""
        self.health = inf
        """A dead node's next probe, or the end of a suspension."""
