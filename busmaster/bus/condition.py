"""Whether a line is there, and what that makes of its values: the one definition that every consumer uses."""

from __future__ import annotations

from typing import NamedTuple

from busmaster.errors import LineDown


class LineCondition(NamedTuple):
    """Whether the port of a line is lost; if it is, since when (bus's clock, in seconds), and why."""

    is_lost: bool
    since: float = 0.0
    reason: str = ""

    @property
    def error(self) -> LineDown:
        """Return what a value fails with while the line is lost."""
        return LineDown(f"the line is lost: {self.reason}" if self.reason else "the line is lost")


PRESENT = LineCondition(False)
"""Of a line whose port is open, or that is not in use."""


class LossLog:
    """When and why the port of a line was lost, and for how long in all. Times are of the bus's clock, in seconds."""

    def __init__(self) -> None:
        self.condition = LineCondition(True)
        """Of the loss that lasts, or was the last one."""
        self._lasts = False
        self._total = 0.0

    def lost(self, now: float, reason: str) -> None:
        """Note that the port is not there. The time of the first note counts, and the latest reason."""
        since = self.condition.since if self._lasts else now
        self._lasts = True
        self.condition = LineCondition(True, since, reason or self.condition.reason)

    def found(self, now: float) -> None:
        """Note that the port is there again."""
        if self._lasts:
            self._lasts = False
            self._total += now - self.condition.since

    def seconds(self, now: float) -> float:
        """Return for how many seconds the port was lost, in all."""
        return self._total + (now - self.condition.since if self._lasts else 0.0)
