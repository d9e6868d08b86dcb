"""The audit log on standard error, for systemd's journal or another reader."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from types import TracebackType

from busmaster.app.cli.output import Level, note

NAME = "busmaster.audit"
TICK = 0.05
MOST_WAITING_ENTRIES = 1_000
"""Maximum number of lines that wait while standard error is blocked."""
CLOSE_WITHIN = 2.0
"""Seconds in which it is to take the rest, at the end."""


class AuditLog(logging.Handler):
    """Print the records of the log "busmaster.audit", in `with`, in a thread of its own: it never delays the line.

    `is_free` returns whether a line may be printed now; not while a live view is drawn.
    """

    def __init__(self, is_free: Callable[[], bool]) -> None:
        super().__init__(logging.INFO)
        self._is_free = is_free
        self._log = logging.getLogger(NAME)
        self._level_before = self._log.level
        self._waiting: deque[tuple[str, Level]] = deque()  # loop and thread share it: its operations are atomic
        self._lost = 0
        self._stop = threading.Event()
        # a daemon: a standard error that takes nothing must not keep the process from ending
        self._thread = threading.Thread(target=self._print, name="busmaster audit log", daemon=True)

    def __enter__(self) -> AuditLog:
        self._level_before = self._log.level
        self._log.setLevel(logging.INFO)
        self._log.addHandler(self)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._log.removeHandler(self)
        self._log.setLevel(self._level_before)
        self._stop.set()
        self._thread.join(CLOSE_WITHIN)

    def emit(self, record: logging.LogRecord) -> None:
        """Have it printed. Never waits."""
        if not self._is_free():
            return
        if len(self._waiting) >= MOST_WAITING_ENTRIES:
            self._lost += 1
            return
        level = Level.WARNING if record.levelno >= logging.WARNING else Level.INFO
        self._waiting.append((f"audit: {record.getMessage()}", level))

    def _print(self) -> None:
        reported, last = 0, False
        while not last:
            last = self._stop.wait(TICK)
            while self._waiting:
                note(*self._waiting.popleft())
            if (lost := self._lost) > reported:
                note(f"audit: {lost - reported} writes are not listed here; standard error was blocked", Level.WARNING)
                reported = lost
