"""How long an event loop is away from its ports: what it does between two looks at them."""

from __future__ import annotations

import asyncio
import gc
import selectors
import time
from collections.abc import Awaitable, Callable
from typing import NamedTuple


class Hold(NamedTuple):
    """The longest of some holds, in milliseconds: our own work, with the garbage collector's, and by the clock."""

    own: float = 0.0
    cpu: float = 0.0
    clock: float = 0.0


class Watch(selectors.DefaultSelector):
    """A selector that notes how long the loop is away from it."""

    def __init__(self) -> None:
        super().__init__()
        self._left: tuple[float, float] | None = None
        self._collecting = self._collected = 0.0
        self._longest = Hold()
        self.each: list[float] | None = None
        """Every hold's own work, in milliseconds, while this is a list."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if self._left is not None:
            cpu, clock = time.thread_time() - self._left[0], time.perf_counter() - self._left[1]
            hold = (cpu - self._collected, cpu, clock)
            if self.each is not None:
                self.each.append(1000 * hold[0])
            self._longest = Hold(*(max(a, 1000 * b) for a, b in zip(self._longest, hold, strict=True)))
        ready = super().select(timeout)
        self._collected = 0.0
        self._left = time.thread_time(), time.perf_counter()
        return ready

    def take(self) -> Hold:
        """The longest since the last time."""
        longest, self._longest = self._longest, Hold()
        return longest

    def collects(self, phase: str, _: dict[str, int]) -> None:
        """For `gc.callbacks`."""
        if phase == "start":
            self._collecting = time.thread_time()
        else:
            self._collected += time.thread_time() - self._collecting


def watched(work: Callable[[Watch], Awaitable[int]]) -> int:
    """Run it on a loop of its own. What is there before is kept from the garbage collector, as an application may."""
    watch = Watch()
    gc.collect()
    gc.freeze()
    gc.callbacks.append(watch.collects)
    try:
        with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(watch)) as runner:
            return runner.run(_awaited(work(watch)))
    finally:
        gc.callbacks.remove(watch.collects)
        gc.unfreeze()


async def _awaited(work: Awaitable[int]) -> int:
    return await work
