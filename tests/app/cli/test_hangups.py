"""SIGHUP: kept until something waits for it, several counted as one, and the handler as before at the end."""

from __future__ import annotations

import asyncio
import os
import signal
import threading

import pytest

from busmaster.app.cli.hangups import Hangups
from tests.patience import PATIENCE


def hang_up() -> None:
    os.kill(os.getpid(), signal.SIGHUP)


async def within_patience(hangups: Hangups) -> None:
    await asyncio.wait_for(hangups.next(), PATIENCE)


def test_signals_before_anything_waits_are_kept_as_one() -> None:
    async def story(hangups: Hangups) -> None:
        await within_patience(hangups)
        waiting = asyncio.ensure_future(hangups.next())
        await asyncio.sleep(0)
        assert not waiting.done(), "several count as one"
        hang_up()
        await asyncio.wait_for(waiting, PATIENCE)
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(hangups.next(), 0.001)
        hang_up()  # after a wait that was cancelled
        await within_patience(hangups)

    with Hangups() as hangups:
        hang_up()
        hang_up()
        asyncio.run(story(hangups))
        hang_up()  # no loop runs any more that it could wake


def test_a_signal_at_the_moment_at_which_the_wait_is_cancelled_is_kept() -> None:
    async def story(hangups: Hangups) -> None:
        waiting = asyncio.ensure_future(hangups.next())
        await asyncio.sleep(0)
        hang_up()
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        await asyncio.wait_for(hangups.next(), 1.0)

    with Hangups() as hangups:
        asyncio.run(story(hangups))


def test_the_handler_is_as_before_at_the_end() -> None:
    def ours(*_: object) -> None:
        """Nothing."""

    before = signal.signal(signal.SIGHUP, ours)
    try:
        with Hangups():
            assert signal.getsignal(signal.SIGHUP) is not ours
        assert signal.getsignal(signal.SIGHUP) is ours
    finally:
        signal.signal(signal.SIGHUP, before)


def test_in_another_thread_signals_are_left_alone() -> None:
    before, failed = signal.getsignal(signal.SIGHUP), list[Exception]()

    def enter() -> None:
        try:
            with Hangups():
                assert signal.getsignal(signal.SIGHUP) is before
        except Exception as error:
            failed.append(error)

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert failed == []
    assert signal.getsignal(signal.SIGHUP) is before
