"""Which clock a loop keeps."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

VIRTUAL = 1.0
"""A loop whose time differs by more seconds than this from the machine's keeps a time of its own."""


def is_virtual(loop: asyncio.AbstractEventLoop) -> bool:
    """Return whether the loop keeps a time of its own."""
    return abs(loop.time() - time.monotonic()) > VIRTUAL


def clock_of(loop: asyncio.AbstractEventLoop) -> Callable[[], float]:
    """Return the loop's own clock if its time is virtual; else the machine's, which is finer than some loops'."""
    return loop.time if is_virtual(loop) else time.monotonic
