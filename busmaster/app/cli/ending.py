"""Signals end a command in an orderly way, so that ports, links and files are released."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
import time
from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import Any, NoReturn, TypeVar

import anyio
import click

T = TypeVar("T")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGQUIT, signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU)
"""Signals that users and supervisors send, and that would end the process at once. Not SIGABRT, by which a supervisor
ends a process that hangs: it would continue to hang."""
PATIENCE = 2.0


class Ending:
    """The first signal cancels what `run` runs, or unwinds whatever the thread does.

    Terminals, shells and supervisors often send a second one at once: it must not break the unwinding. One that comes
    `patience` later ends the process where it stands.
    """

    def __init__(self) -> None:
        self.patience = PATIENCE
        """Seconds in which the same signal is ignored, because the safe state may need longer."""
        self.number = 0
        """The signal that was received; 0 before."""
        self._since = 0.0
        self._running = False
        self._cancel: Callable[[], object] | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Ending:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                # a shell starts what runs in its background deaf to Ctrl-C and Ctrl-\, and so it is to stay
                if signal.getsignal(number) is not signal.SIG_IGN:
                    self._before[number] = signal.signal(number, self._heard)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Restore the signal handlers, unless a signal was received.

        Further signals while the process shuts down are ignored.
        """
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_IGN if self.number else handler)

    def _heard(self, number: int, _frame: object) -> None:
        now = time.monotonic()
        if self.number:
            if now >= self._since + self.patience:
                os._exit(128 + number)
            return
        self.number, self._since = number, now
        # raised while the loop runs, or is being closed, it would break that; there the task is cancelled
        if not self._running:
            self._unwind()
        if self._cancel is not None:
            self._cancel()

    def _unwind(self) -> NoReturn:
        raise KeyboardInterrupt if self.number == signal.SIGINT else SystemExit(128 + self.number)

    def run(
        self,
        function: Callable[..., Awaitable[T]],
        *arguments: Any,
        loop_factory: Callable[[], asyncio.AbstractEventLoop] | None = None,
    ) -> T:
        """Run an async function as anyio.run does, in a loop of `loop_factory`.

        Raises KeyboardInterrupt or SystemExit if it was cancelled by a signal.
        """

        async def cancellable() -> T:
            loop, task = asyncio.get_running_loop(), asyncio.current_task()
            assert task is not None
            # threadsafe, though it is this thread: nothing else wakes a loop that waits in select
            self._cancel = lambda: loop.call_soon_threadsafe(task.cancel)
            try:
                if self.number:  # received while there was no task yet to cancel
                    raise asyncio.CancelledError
                return await function(*arguments)
            finally:
                self._cancel = None

        self._running = True
        try:
            return anyio.run(cancellable, backend_options={"loop_factory": loop_factory})
        finally:
            self._running = False
            if self.number:
                self._unwind()


def until_ended(
    function: Callable[..., Awaitable[T]],
    *arguments: Any,
    loop_factory: Callable[[], asyncio.AbstractEventLoop] | None = None,
) -> T:
    """Run an async function in an event loop, to be ended by the signals of the command that runs."""
    ending = click.get_current_context().find_object(Ending)
    if ending is None:
        return anyio.run(function, *arguments, backend_options={"loop_factory": loop_factory})
    return ending.run(function, *arguments, loop_factory=loop_factory)


__all__ = [
    "Ending",
    "until_ended",
]
