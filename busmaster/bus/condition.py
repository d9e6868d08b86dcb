"""Whether a line is available, and the effect on its values: the one definition that every consumer uses."""

from __future__ import annotations

from typing import NamedTuple

from busmaster.errors import LineDown


class LineCondition(NamedTuple):
    """Whether the port of a line is lost, and if so, since when (bus's clock, in seconds) and why."""

    is_lost: bool
    since: float = 0.0
    reason: str = ""

    @property
    def error(self) -> LineDown:
        """Return the error of values while the line is lost."""
        return LineDown(f"the line is lost: {self.reason}" if self.reason else "the line is lost")


PRESENT = LineCondition(False)
"""A line whose port is open, or that is not in use."""


class LossLog:
    """When and why the port of a line was lost, and for how long in total. Times are on the bus's clock, in seconds."""

    def __init__(self) -> None:
        self.condition = LineCondition(True)
        """The current loss, or the last one."""
        self._lasts = False
        self._total = 0.0

    def lost(self, now: float, reason: str) -> None:
        """Record that the port is lost. The first time counts, and the latest reason."""
        # Each failed attempt to reopen is reported here too: the loss began with the first.
        since = self.condition.since if self._lasts else now
        self._lasts = True
        # Replaced as a whole, so that other threads never read the time of one loss with the reason of another.
        self.condition = LineCondition(True, since, reason or self.condition.reason)

    def found(self, now: float) -> None:
        """Record that the port is open again."""
        if self._lasts:
            self._lasts = False
            self._total += now - self.condition.since

    def seconds(self, now: float) -> float:
        """Return the total time, in seconds, for which the port was lost."""
        return self._total + (now - self.condition.since if self._lasts else 0.0)
