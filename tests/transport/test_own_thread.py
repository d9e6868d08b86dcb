"""Work in a thread of its own: whoever awaits it hears how it ended."""

from __future__ import annotations

import threading
from typing import NoReturn

import pytest

from busmaster.transport.own_thread import in_own_thread
from tests.patience import PATIENCE


def test_the_result_of_the_work_is_that_of_its_future() -> None:
    future = in_own_thread(threading.current_thread, "a name")
    thread = future.result(PATIENCE)
    assert (thread.name, thread.daemon) == ("a name", True)


@pytest.mark.parametrize("error", [OSError("gone"), SystemExit(1), KeyboardInterrupt()])
def test_whatever_the_work_raises_ends_its_future(error: BaseException) -> None:
    def work() -> NoReturn:
        raise error

    assert in_own_thread(work, "raises").exception(PATIENCE) is error
