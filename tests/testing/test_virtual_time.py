"""A loop whose time jumps."""

from __future__ import annotations

import asyncio
import threading
import time

import anyio
import pytest

from busmaster.testing.virtual_time import DeadlockError, VirtualTimeLoop, run_in_virtual_time
from tests.patience import PATIENCE

DAY = 86400.0


def test_a_week_of_sleep_takes_no_time() -> None:
    async def main() -> float:
        await asyncio.sleep(7 * DAY)
        return asyncio.get_running_loop().time()

    begun = time.monotonic()
    assert run_in_virtual_time(main()) == pytest.approx(7 * DAY)
    assert time.monotonic() - begun < PATIENCE


def test_timers_run_in_order_and_at_their_times() -> None:
    async def main() -> list[float]:
        loop = asyncio.get_running_loop()
        times: list[float] = []
        for delay in (0.3, 0.1, 1e-9, 0.2):
            loop.call_later(delay, lambda: times.append(loop.time()))
        await asyncio.sleep(1.0)
        return times

    assert run_in_virtual_time(main()) == pytest.approx([1e-9, 0.1, 0.2, 0.3])


def test_time_stands_still_while_something_is_ready() -> None:
    async def main() -> float:
        for _ in range(1000):
            await asyncio.sleep(0)
        return asyncio.get_running_loop().time()

    assert run_in_virtual_time(main()) == 0.0


def test_timeouts_of_asyncio_and_anyio_run_out() -> None:
    async def main() -> float:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(3600):
                await asyncio.Event().wait()
        with anyio.move_on_after(60) as scope:
            await anyio.sleep_forever()
        assert scope.cancelled_caught
        return asyncio.get_running_loop().time()

    assert run_in_virtual_time(main()) == pytest.approx(3660)


def test_what_can_never_go_on_is_a_deadlock_and_says_who_waits() -> None:
    async def main() -> None:
        await asyncio.Event().wait()

    with pytest.raises(DeadlockError, match=r"no timer is set(.|\n)*main(.|\n)*test_virtual_time.py:\d+"):
        run_in_virtual_time(main())


def test_a_thread_is_waited_for_while_time_stands_still() -> None:
    async def main() -> tuple[int, float]:
        done = threading.Event()

        def work() -> int:
            done.wait(5)
            return 42

        asyncio.get_running_loop().call_soon(done.set)
        waiting = asyncio.create_task(asyncio.sleep(100))
        answer = await asyncio.to_thread(work)
        now = asyncio.get_running_loop().time()
        waiting.cancel()
        return answer, now

    assert run_in_virtual_time(main()) == (42, 0.0)


def test_anyio_can_run_on_it() -> None:
    async def main() -> float:
        async with anyio.create_task_group() as group:
            group.start_soon(anyio.sleep, 10)
            group.start_soon(anyio.sleep, 20)
        return anyio.current_time()

    assert anyio.run(main, backend_options={"loop_factory": VirtualTimeLoop}) == pytest.approx(20)


def test_a_thread_that_fails_is_waited_for_no_longer_and_the_end_of_all_threads_is_awaited() -> None:
    ended = threading.Event()

    async def main() -> float:
        loop = asyncio.get_running_loop()
        with pytest.raises(ZeroDivisionError):
            await asyncio.to_thread(lambda: 1 / 0)
        await asyncio.sleep(5.0)
        loop.run_in_executor(None, ended.wait, PATIENCE)
        loop.call_soon(ended.set)
        return loop.time()

    assert run_in_virtual_time(main()) == 5.0
    assert ended.is_set()


def test_timers_are_due_after_years_too() -> None:
    async def main() -> list[float]:
        loop, due = asyncio.get_running_loop(), list[float]()
        for _ in range(3):
            await asyncio.sleep(365 * DAY + 0.1)
            loop.call_later(1e-9, lambda: due.append(loop.time()))
            await asyncio.sleep(1.0)
        return due

    assert run_in_virtual_time(main()) == pytest.approx([(365 * DAY + 0.1) * n + n - 1 for n in (1, 2, 3)])


def test_every_task_that_waits_for_ever_is_named() -> None:
    async def stuck() -> None:
        await asyncio.Event().wait()

    async def main() -> None:
        await asyncio.sleep(3.0)
        await asyncio.gather(asyncio.create_task(stuck(), name="first"), asyncio.create_task(stuck(), name="second"))

    with pytest.raises(DeadlockError) as found:
        run_in_virtual_time(main())
    assert str(found.value).startswith("at 3 s nothing is ready and no timer is set; these wait for ever:\n")
    assert "first: " in str(found.value)
    assert "second: " in str(found.value)
