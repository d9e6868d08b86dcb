"""A line's timer fires when it is due, never twice, and never for what was taken back."""

from __future__ import annotations

import asyncio
import ctypes
import errno
import logging
import os
import time
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any

import pytest
import uvloop

from busmaster.testing import run_in_virtual_time
from busmaster.transport import alarm as alarm_module
from busmaster.transport.alarm import SOON, Alarm, KernelTimer, call_system
from tests.patience import PATIENCE


def run_on(factory: Callable[[], asyncio.AbstractEventLoop], main: Coroutine[Any, Any, None]) -> None:
    with asyncio.Runner(loop_factory=factory) as runner:
        runner.run(main)


LOOPS = pytest.mark.parametrize("factory", [asyncio.new_event_loop, uvloop.new_event_loop])


def stand_still(seconds: float) -> None:
    """Hold the loop up."""
    time.sleep(seconds)


async def rung(after: float) -> tuple[float, float]:
    """When it was set, and when it rang."""
    loop = asyncio.get_running_loop()
    done = asyncio.Event()
    alarm = Alarm(loop, done.set)
    start = loop.time() if after >= SOON else time.monotonic()  # uvloop's own timers count from when its turn began
    alarm.set(time.monotonic() + after)
    async with asyncio.timeout(PATIENCE):
        await done.wait()
    end = time.monotonic()
    alarm.close()
    return start, end


@LOOPS
@pytest.mark.parametrize("after", [-1.0, 0.0, 1e-9, 0.0004, 0.00175, SOON, 2 * SOON])
def test_it_never_rings_early(factory: Callable[[], asyncio.AbstractEventLoop], after: float) -> None:
    async def main() -> None:
        start, end = await rung(after)
        assert end - start >= after

    run_on(factory, main())


@LOOPS
def test_what_is_due_soon_is_not_rounded_up_to_a_millisecond(factory: Callable[[], asyncio.AbstractEventLoop]) -> None:
    """The best of many: what a busy machine adds is not the timer's."""

    async def main() -> None:
        best = PATIENCE
        for _ in range(1000):
            start, end = await rung(0.0004)
            best = min(best, end - start)
            if best < 0.0009:
                return
        pytest.fail(f"the quickest of 1000 took {best * 1e3:.2f} ms")

    run_on(factory, main())


@LOOPS
def test_a_later_set_replaces_an_earlier_one(factory: Callable[[], asyncio.AbstractEventLoop]) -> None:
    async def main() -> None:
        rings: list[float] = []
        rung = asyncio.Event()

        def ring() -> None:
            rings.append(time.monotonic())
            rung.set()

        alarm = Alarm(asyncio.get_running_loop(), ring)
        alarm.set(time.monotonic())
        stand_still(0.002)  # it has expired, and the loop has not looked yet
        start = time.monotonic()
        alarm.set(start + 0.01)
        async with asyncio.timeout(PATIENCE):
            await rung.wait()
        assert rings[0] - start >= 0.01
        await asyncio.sleep(0.03)
        assert len(rings) == 1
        alarm.close()

    run_on(factory, main())


@LOOPS
@pytest.mark.parametrize("after", [0.0, 0.005, 2 * SOON])
def test_what_was_taken_back_does_not_ring(factory: Callable[[], asyncio.AbstractEventLoop], after: float) -> None:
    async def main() -> None:
        rings: list[None] = []
        alarm = Alarm(asyncio.get_running_loop(), lambda: rings.append(None))
        alarm.set(time.monotonic() + after)
        alarm.cancel()
        await asyncio.sleep(after + 0.02)
        alarm.close()
        alarm.close()
        assert rings == []

    run_on(factory, main())


def open_timers() -> set[str]:
    """The descriptors of this process that are kernel timers: what else opens and closes meanwhile does not count."""
    found = set()
    for number in os.listdir("/proc/self/fd"):
        with suppress(FileNotFoundError):
            if "timerfd" in os.readlink(f"/proc/self/fd/{number}"):
                found.add(number)
    return found


def test_closing_gives_the_descriptor_back() -> None:
    async def main() -> None:
        before = open_timers()
        for _ in range(10):
            alarm = Alarm(asyncio.get_running_loop(), lambda: None)
            alarm.set(time.monotonic() + 0.001)
            assert open_timers() > before
            alarm.close()
        assert open_timers() <= before

    asyncio.run(main())


def test_virtual_time_is_exact() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        done = asyncio.Event()
        Alarm(loop, done.set).set(0.00175)
        await done.wait()
        assert loop.time() == 0.00175

    run_in_virtual_time(main())


def test_without_a_kernel_timer_the_loops_serves_and_the_log_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Without:
        """A C library of a system that knows no timerfd."""

    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Without())
    alarm_module.warn_once.cache_clear()
    with caplog.at_level(logging.INFO, "busmaster"):
        start, end = asyncio.run(rung(0.002))
        asyncio.run(rung(0.002))
    assert end - start >= 0.002
    assert [record.getMessage() for record in caplog.records] == [
        "pauses of the line are rounded up to the next millisecond: this system has no timerfd_create"
    ]


def test_a_loop_that_reads_no_descriptors_keeps_its_own_timer(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise NotImplementedError

    async def main() -> None:
        monkeypatch.setattr(asyncio.get_running_loop(), "add_reader", refuse)
        before = open_timers()
        await rung(0.001)
        assert open_timers() <= before

    asyncio.run(main())


def test_a_kernel_timer_that_was_set_again_has_not_expired() -> None:
    timer = KernelTimer()
    timer.set(0.0)
    while not timer.has_expired():
        pass
    timer.set(0.0)
    time.sleep(0.001)
    timer.set(time.monotonic() + 60.0)
    assert not timer.has_expired()
    timer.close()


@pytest.mark.parametrize(("first", "second"), [(0.001, 2 * SOON), (2 * SOON, 0.001), (2 * SOON, 3 * SOON)])
def test_of_a_near_and_a_far_deadline_the_later_set_counts_alone(first: float, second: float) -> None:
    async def main() -> None:
        rings: list[float] = []
        alarm = Alarm(asyncio.get_running_loop(), lambda: rings.append(time.monotonic()))
        start = time.monotonic()
        alarm.set(start + first)
        alarm.set(start + second)
        await asyncio.sleep(4 * SOON)
        async with asyncio.timeout(PATIENCE):
            while not rings:  # noqa: ASYNC110  # a busy machine
                await asyncio.sleep(0.001)
        assert len(rings) == 1
        assert rings[0] - start >= second
        alarm.close()

    asyncio.run(main())


def test_a_call_of_the_system_that_fails_says_why() -> None:
    with pytest.raises(OSError, match="Bad file descriptor") as caught:
        call_system("inotify_add_watch", -1, b"/", 0x100)
    assert caught.value.errno == errno.EBADF
