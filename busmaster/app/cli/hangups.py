"""SIGHUP requests that a process reads its file again. By default the signal ends a process."""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Any


class Hangups:
    """Handle SIGHUP, in `with`. Enter it before anything that takes time, such as loading a file.

    A signal that arrives before a caller waits is kept; several count as one.
    """

    def __init__(self) -> None:
        self._heard = False
        self._wake: Callable[[], object] | None = None
        self._before: Any = None

    def __enter__(self) -> Hangups:
        if threading.current_thread() is threading.main_thread():  # Python handles signals only there
            self._before = signal.signal(signal.SIGHUP, self._receive)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._before is not None:
            signal.signal(signal.SIGHUP, self._before)

    def _receive(self, _number: int, _frame: object) -> None:
        self._heard = True
        if self._wake is not None:
            self._wake()

    async def next(self) -> None:
        """Return when there is one that was not returned for yet."""
        loop, came = asyncio.get_running_loop(), asyncio.Event()
        # threadsafe, though it is this thread: nothing else wakes a loop that waits in select
        self._wake = lambda: loop.call_soon_threadsafe(came.set)
        try:
            if not self._heard:
                await came.wait()
        finally:
            self._wake = None
        self._heard = False
