"""An event loop whose time jumps: an application that waits for hours is tested in milliseconds.

    def test_my_application():
        asyncio.run(main(), loop_factory=VirtualTimeLoop)     # Python 3.12; before: asyncio.Runner(loop_factory=...)

Time stands still while anything is ready to run, and then jumps to the next timer. `asyncio.sleep`, timeouts, anyio and
all other code that uses the time of the loop works unchanged. What waits for the real world does not: use
`MemoryPort`, not a pseudo-terminal. Threads (`asyncio.to_thread`) are waited for in earnest, while time stands still.
"""

from __future__ import annotations

import asyncio
import math
import selectors
from collections.abc import Callable, Coroutine
from concurrent.futures import Executor
from typing import Any, TypeVar, TypeVarTuple

T = TypeVar("T")
Ts = TypeVarTuple("Ts")
PATIENCE = 0.05
"""Seconds between checks whether a thread has finished."""


class DeadlockError(RuntimeError):
    """No task is ready to run and no timer is set: every task waits for something that will never happen."""


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """Starts at 0 s and advances only by jumps. Raises DeadlockError, out of `run`, instead of waiting forever."""

    def __init__(self) -> None:
        self._now = 0.0
        self._threads = 0
        super().__init__(_JumpingSelector(self))
        self._clock_resolution: float  # set by asyncio, whose stubs do not have it

    def time(self) -> float:
        return self._now

    def run_in_executor(self, executor: Executor | None, func: Callable[[*Ts], T], *args: *Ts) -> asyncio.Future[T]:
        """Run a function in a thread, in earnest: time stands still until it is done."""
        future = super().run_in_executor(executor, func, *args)
        self._threads += 1
        future.add_done_callback(self._thread_done)
        return future

    async def shutdown_default_executor(self, timeout: float | None = None) -> None:
        """Wait for its threads in earnest, without a limit: time stands still."""
        self._threads += 1
        try:
            await super().shutdown_default_executor()
        finally:
            self._threads -= 1

    def _thread_done(self, _: asyncio.Future[Any]) -> None:
        self._threads -= 1

    def jump(self, seconds: float | None) -> float:
        """Go on to the next timer, as nothing is ready. Returns the seconds to wait in earnest, for a thread.

        Raises DeadlockError if there is no timer (None).
        """
        if self._threads:
            return PATIENCE
        if seconds is None:
            waiting = "".join(f"\n  {_where(task)}" for task in asyncio.all_tasks(self))
            raise DeadlockError(
                f"at {self._now:g} s nothing is ready and no timer is set; these wait for ever:{waiting}"
            )
        self._now += seconds
        # A timer is due within this time. The default of 1 ns is lost in the sum after half a year.
        self._clock_resolution = max(self._clock_resolution, math.ulp(self._now))
        return 0.0


class _JumpingSelector(selectors.DefaultSelector):
    def __init__(self, loop: VirtualTimeLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if ready or (timeout is not None and timeout <= 0):
            return ready
        return super().select(self._loop.jump(timeout))


def run_in_virtual_time(main: Coroutine[Any, Any, T]) -> T:
    """Do what `asyncio.run` does, in virtual time."""
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(main)


def _where(task: asyncio.Task[Any]) -> str:
    frames = task.get_stack(limit=1)
    place = f" at {frames[0].f_code.co_filename}:{frames[0].f_lineno}" if frames else ""
    return f"{task.get_name()}: {task.get_coro()!r}{place}"
