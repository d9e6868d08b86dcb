"""The clock of an event loop."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

VIRTUAL = 1.0
"""A loop whose time differs from the machine's by more seconds than this has a virtual clock."""


def is_virtual(loop: asyncio.AbstractEventLoop) -> bool:
    """Return True if the loop has a virtual clock."""
    return abs(loop.time() - time.monotonic()) > VIRTUAL


def clock_of(loop: asyncio.AbstractEventLoop) -> Callable[[], float]:
    """Return the loop's own clock if it is virtual, else the machine's, which is finer than that of some loops."""
    # uvloop's clock stands still during a turn of the loop and counts whole milliseconds.
    return loop.time if is_virtual(loop) else time.monotonic
