"""Runs work that may block forever where it blocks neither the loop nor the end of the program."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")


def in_own_thread(work: Callable[[], T], name: str) -> Future[T]:
    """Run `work` in a daemon thread of its own, and return the future of its result.

    A thread pool is not suitable: its threads are joined at exit, and a driver can block one for minutes.
    """
    future: Future[T] = Future()

    def run() -> None:
        if not future.set_running_or_notify_cancel():
            return
        try:
            result = work()
        # Also SystemExit: the caller that awaits the future must not wait for ever.
        except BaseException as error:
            future.set_exception(error)
        else:
            future.set_result(result)

    threading.Thread(target=run, name=name, daemon=True).start()
    return future
