"""The clock of an event loop, and the time of day."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from math import inf

VIRTUAL = 1.0
"""A loop whose time differs from the machine's by more seconds than this has a virtual clock."""

# The two clocks are read one after the other, so their difference varies a little although neither was set.
CLOCK_WAS_SET = 0.005
"""Difference in seconds above which the machine's clock counts as set."""


def is_virtual(loop: asyncio.AbstractEventLoop) -> bool:
    """Return True if the loop has a virtual clock."""
    return abs(loop.time() - time.monotonic()) > VIRTUAL


def clock_of(loop: asyncio.AbstractEventLoop) -> Callable[[], float]:
    """Return the loop's own clock if it is virtual, else the machine's, which is finer than that of some loops."""
    # uvloop's clock stands still during a turn of the loop and counts whole milliseconds.
    return loop.time if is_virtual(loop) else time.monotonic


class TimeOfDay:
    """The machine's time of day, for times of another clock."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._offset = inf

    def offset(self) -> float:
        """Return the offset from the clock to seconds since 1970.

        The value stays exactly the same until the machine's clock is set.
        """
        before, wall = self._clock(), time.time()
        if self._clock() - before > CLOCK_WAS_SET:
            # The process was stopped between the two readings, for example by a debugger: the clock was not set.
            before, wall = self._clock(), time.time()
        offset = wall - before
        if abs(offset - self._offset) > CLOCK_WAS_SET:
            self._offset = offset
        return self._offset
