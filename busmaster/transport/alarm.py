"""One timer of a line, which fires at its deadline.

An event loop rounds its timers up to the next millisecond, the unit of its system call. For a reply window of 50 ms
that is negligible. For the pause of 1.75 ms before each Modbus request it is up to a third more, each time. So a near
deadline uses a kernel timer (timerfd) that the loop reads like a port. Without one, the loop's timer is used for all
deadlines, and this is logged once: on another system, on a loop that cannot read descriptors, or with a virtual clock.
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
"""Deadlines within this many seconds use the kernel timer. For longer waits a millisecond is negligible."""
TFD_NONBLOCK = os.O_NONBLOCK
TFD_CLOEXEC = os.O_CLOEXEC
CLOCK_MONOTONIC = 1  # linux/time.h; what time.monotonic() reads
TFD_TIMER_ABSTIME = 1
EXPIRATIONS = 8
"""Size in bytes of a timerfd's count of expirations."""


class Alarm:
    """Calls `ring` once at its deadline, by the clock of the loop (`clock_of`). A later `set` replaces an earlier one.

    A deadline within SOON never fires too early. A longer one can, on uvloop: its timers count from the beginning of
    the loop's turn. The callback must check the clock.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, ring: Callable[[], None]) -> None:
        self._loop = loop
        self._clock = clock_of(loop)
        self._ring = ring
        self._handle: asyncio.TimerHandle | None = None
        # A kernel timer uses the machine's time and not the loop's virtual time.
        self._precise = None if is_virtual(loop) else kernel_timer(loop, self._on_expiry)
        self._is_set = False

    def set(self, when: float) -> None:
        """Set the deadline. If it has passed, fire immediately, but never within this call."""
        self.cancel()
        seconds = when - self._clock()
        if seconds < SOON and self._precise is not None:
            self._is_set = True
            self._precise.set(max(when, 0.0))
        else:
            self._handle = self._loop.call_later(max(seconds, 0.0), self._on_time)

    def cancel(self) -> None:
        """Cancel the deadline."""
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None
        self._is_set = False  # an expiry of the kernel timer that is already pending is then ignored

    def close(self) -> None:
        """Cancel the deadline and close the descriptor."""
        self.cancel()
        if self._precise is not None:
            # First: the loop must not watch the number of a closed descriptor, which the next file gets.
            self._loop.remove_reader(self._precise.descriptor)
            self._precise.close()
            self._precise = None

    def _on_time(self) -> None:
        self._handle = None
        self._ring()

    def _on_expiry(self) -> None:
        # Read even if the deadline was cancelled: an unread descriptor would wake the loop again and again.
        if self._precise is not None and self._precise.has_expired() and self._is_set:
            self._is_set = False
            self._ring()


class KernelTimer:
    """A timerfd, which a loop reads like a port. Raises OSError if the system has none."""

    def __init__(self) -> None:
        self.descriptor = call_system("timerfd_create", CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC)
        # Allocated once, because `set` runs for every request.
        self._when = ItimerSpec()
        # Without `use_errno`, which costs a copy of errno for each call: with these arguments the call cannot fail.
        self._settime = ctypes.CDLL(None).timerfd_settime
        self._settime.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.POINTER(ItimerSpec), ctypes.c_void_p)
        self._pointer = ctypes.pointer(self._when)

    def set(self, when: float) -> None:
        """Expire once at this time of time.monotonic(), in seconds; immediately if it has passed.

        An absolute time, because a relative one would be late by the time of the call, some 20 us on a core that has
        just woken up.
        """
        whole = int(when)
        self._when.seconds = whole
        self._when.nanoseconds = min(int((when - whole) * 1e9) + 1, 999_999_999)  # never 0, which would switch it off
        self._settime(self.descriptor, TFD_TIMER_ABSTIME, self._pointer, None)

    def has_expired(self) -> bool:
        """Return True if it has expired since it was last set."""
        try:
            # It was set again after the loop had found it readable: then the read would block.
            return len(os.read(self.descriptor, EXPIRATIONS)) == EXPIRATIONS
        except BlockingIOError:
            return False

    def close(self) -> None:
        """Close the descriptor."""
        os.close(self.descriptor)


class ItimerSpec(ctypes.Structure):
    """`struct itimerspec` of Linux: an interval, which stays 0, and the first expiration."""

    _fields_ = (
        ("interval_seconds", ctypes.c_long),
        ("interval_nanoseconds", ctypes.c_long),
        ("seconds", ctypes.c_long),
        ("nanoseconds", ctypes.c_long),
    )


def call_system(name: str, *arguments: int | bytes) -> int:
    """Call a function of the C library that Python does not have. Raises OSError if it fails or does not exist."""
    try:
        result = int(getattr(ctypes.CDLL(None, use_errno=True), name)(*arguments))
    except AttributeError as error:
        raise OSError(f"this system has no {name}") from error
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


def kernel_timer(loop: asyncio.AbstractEventLoop, on_expiry: Callable[[], None]) -> KernelTimer | None:
    """Return a timer that this loop reads; None if there is none, which is logged once per process."""
    try:
        timer = KernelTimer()
    except OSError as error:
        warn_once(str(error))
        return None
    try:
        # A loop that is not built on descriptors, for example one made for tests.
        loop.add_reader(timer.descriptor, on_expiry)
    except NotImplementedError:
        timer.close()
        warn_once(f"a {type(loop).__name__} cannot read descriptors")
        return None
    return timer


@cache
def warn_once(why: str) -> None:
    """Log that pauses are rounded up."""
    logger.info("pauses of the line are rounded up to the next millisecond: %s", why)
