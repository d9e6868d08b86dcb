"""A progress bar on standard error, where that is a terminal; results go to standard output around it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


class Bar:
    """Counts to `total`. It is drawn by `advance` alone, between two exchanges: a thread that draws disturbs timing."""

    def __init__(self, label: str, total: int) -> None:
        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        bar = Progress(*columns, console=console, auto_refresh=False, transient=True, redirect_stdout=False)
        self._bar = bar if console.is_terminal else None
        self._task = bar.add_task(label, total=total)

    def __enter__(self) -> Bar:
        self._show()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._hide()

    def advance(self, count: int = 1) -> None:
        """Count so many more and draw the bar."""
        if self._bar is not None:
            self._bar.update(self._task, advance=count, refresh=True)

    @contextmanager
    def hidden(self) -> Iterator[None]:
        """Hide the bar while a result is printed."""
        self._hide()
        try:
            yield
        finally:
            self._show()

    def _show(self) -> None:
        if self._bar is not None:
            self._bar.start()

    def _hide(self) -> None:
        if self._bar is not None:
            self._bar.stop()
