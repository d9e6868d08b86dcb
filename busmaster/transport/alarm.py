"""One timer of a line, which fires when it is due.

An event loop rounds its timers up to the next millisecond, since that is the unit of its system call. For a reply
window of 50 ms that is nothing; for the pause of 1.75 ms that Modbus wants before every request it is a third more,
each time. So what is due soon is given to a timer of the kernel's that the loop reads like a port (timerfd). Where
there is none (another system, a loop that reads no descriptors, a loop that keeps a time of its own) the loop's
timer serves for everything, and the log says so once.
"""

from __future__ import annotations

import asyncio
import ctypes
import logging
import os
from collections.abc import Callable
from functools import cache

from busmaster.transport.clock import clock_of, is_virtual

logger = logging.getLogger("busmaster")

SOON = 0.02
"""What is due within so many seconds is worth a timer of the kernel's; of a longer wait a millisecond is little."""
TFD_NONBLOCK = os.O_NONBLOCK
TFD_CLOEXEC = os.O_CLOEXEC
CLOCK_MONOTONIC = 1  # linux/time.h; what time.monotonic() reads
TFD_TIMER_ABSTIME = 1
EXPIRATIONS = 8
"""Bytes of a timerfd's count of expirations."""


class Alarm:
    """Calls `ring` once, when it is due, by the clock of the loop (`clock_of`). A later `set` replaces an earlier one.

    What is SOON rings never too early. A longer wait may, on uvloop: its timers count from the beginning of the loop's
    turn. Whoever is rung looks at the clock.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, ring: Callable[[], None]) -> None:
        self._loop = loop
        self._clock = clock_of(loop)
        self._ring = ring
        self._handle: asyncio.TimerHandle | None = None
        # A timer of the kernel's would ring in the machine's time.
        self._precise = None if is_virtual(loop) else kernel_timer(loop, self._on_expiry)
        self._is_set = False

    def set(self, when: float) -> None:
        """Ring at that time; at once, but never within this call, if it is over."""
        self.cancel()
        seconds = when - self._clock()
        if seconds < SOON and self._precise is not None:
            self._is_set = True
            self._precise.set(max(when, 0.0))
        else:
            self._handle = self._loop.call_later(max(seconds, 0.0), self._on_time)

    def cancel(self) -> None:
        """Do not ring."""
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None
        self._is_set = False  # a timer of the kernel's that still expires finds nobody waiting

    def close(self) -> None:
        """Never ring again, and give the descriptor back."""
        self.cancel()
        if self._precise is not None:
            self._loop.remove_reader(self._precise.descriptor)
            self._precise.close()
            self._precise = None

    def _on_time(self) -> None:
        self._handle = None
        self._ring()

    def _on_expiry(self) -> None:
        if self._precise is not None and self._precise.has_expired() and self._is_set:
            self._is_set = False
            self._ring()


class KernelTimer:
    """A timerfd, which a loop reads like a port. Raises OSError where the system has none."""

    def __init__(self) -> None:
        self.descriptor = call_system("timerfd_create", CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC)
        self._when = ItimerSpec()
        self._settime = ctypes.CDLL(None).timerfd_settime
        self._settime.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.POINTER(ItimerSpec), ctypes.c_void_p)
        self._pointer = ctypes.pointer(self._when)

    def set(self, when: float) -> None:
        """Expire once, at that time by time.monotonic(), in seconds; at once if it is over.

        To say in how long would add what it takes to say it, some 20 us on a core that has just woken up.
        """
        whole = int(when)
        self._when.seconds = whole
        self._when.nanoseconds = min(int((when - whole) * 1e9) + 1, 999_999_999)  # never 0, which would switch it off
        self._settime(self.descriptor, TFD_TIMER_ABSTIME, self._pointer, None)

    def has_expired(self) -> bool:
        """Return whether it has since it was set last: one that was set again meanwhile has not."""
        try:
            return len(os.read(self.descriptor, EXPIRATIONS)) == EXPIRATIONS
        except BlockingIOError:
            return False

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self.descriptor)


class ItimerSpec(ctypes.Structure):
    """What the system calls `struct itimerspec`: an interval, which stays 0, and the first expiration."""

    _fields_ = (
        ("interval_seconds", ctypes.c_long),
        ("interval_nanoseconds", ctypes.c_long),
        ("seconds", ctypes.c_long),
        ("nanoseconds", ctypes.c_long),
    )


def call_system(name: str, *arguments: int | bytes) -> int:
    """Call a function of the C library that Python does not have. Raises OSError where it fails, or does not exist."""
    try:
        result = int(getattr(ctypes.CDLL(None, use_errno=True), name)(*arguments))
    except AttributeError as error:
        raise OSError(f"this system has no {name}") from error
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


def kernel_timer(loop: asyncio.AbstractEventLoop, on_expiry: Callable[[], None]) -> KernelTimer | None:
    """Return a timer that this loop reads; None where there is none, which the log says once a process."""
    try:
        timer = KernelTimer()
    except OSError as error:
        tell_once(str(error))
        return None
    try:
        loop.add_reader(timer.descriptor, on_expiry)
    except NotImplementedError:
        timer.close()
        tell_once(f"a {type(loop).__name__} reads no descriptors")
        return None
    return timer


@cache
def tell_once(why: str) -> None:
    """Say in the log that pauses are rounded up."""
    logger.info("pauses of the line are rounded up to the next millisecond: %s", why)
