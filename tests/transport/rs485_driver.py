"""A kernel driver with an RS-485 mode and modem lines, in place of the system calls: a pty has neither.

It answers as linux/serial.h and drivers/tty/serial/serial_core.c of Linux describe.
"""

from __future__ import annotations

import array
import asyncio
import errno
import fcntl
import os
import struct
import termios
import threading
import time
from typing import Any

import pytest

from busmaster.transport import rs485
from tests.patience import PATIENCE

TERMINATE = 1 << 5
"""SER_RS485_TERMINATE_BUS of linux/serial.h: a flag that is the user's."""


class FakeDriver:
    """Answers the ioctls of one kernel driver for every descriptor, and records what is done to the lines."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.state = [TERMINATE, 7, 7]
        self.takes_mode = True
        self.most_delay = 100
        self.can_receive_while_sending = True
        self.has_lines = True
        self.empty: list[bool] | None = None
        """What the queries of the transmitter return, one after the other; None: there is no such query."""
        self.log: list[str] = []
        self.rts: bool | None = None
        self.changed = threading.Event()
        self._ioctl, self._write, self._drain = fcntl.ioctl, os.write, termios.tcdrain
        monkeypatch.setattr(fcntl, "ioctl", self.ioctl)
        monkeypatch.setattr(os, "write", self.write)
        monkeypatch.setattr(termios, "tcdrain", self.drain)

    def ioctl(self, descriptor: int, request: int, argument: Any = 0, mutate: bool = True) -> Any:
        if request in (rs485.TIOCGRS485, rs485.TIOCSRS485):
            return self._mode(request, argument)
        if request in (termios.TIOCMBIS, termios.TIOCMBIC):
            if not self.has_lines:
                raise OSError(errno.ENOTTY, "no lines")
            if argument != struct.pack("I", termios.TIOCM_RTS):
                return 0  # DTR, which pyserial sets first
            self.rts = request == termios.TIOCMBIS
            self._note("RTS high" if self.rts else "RTS low")
            return 0
        if request == rs485.TIOCSERGETLSR:
            if self.empty is None:
                raise OSError(errno.ENOTTY, "no query")
            argument[0] = rs485.TEMT if (is_empty := self.empty.pop(0) if self.empty else True) else 0
            self._note("empty" if is_empty else "sending")
            return 0
        return self._ioctl(descriptor, request, argument, mutate)

    def write(self, descriptor: int, data: bytes) -> int:
        if descriptor > 2 and os.isatty(descriptor) and self.rts is not None and threading.current_thread().daemon:
            self._note(f"write {data.hex(' ')}")
        return self._write(descriptor, data)

    def drain(self, descriptor: int) -> None:
        self._note("drained")
        self._drain(descriptor)

    def _mode(self, request: int, argument: array.array[int]) -> int:
        if not self.takes_mode:
            raise OSError(errno.ENOTTY, "no mode")
        if request == rs485.TIOCGRS485:
            argument[:3] = array.array("I", self.state)
            return 0
        flags, before, after = argument[:3]
        if not self.can_receive_while_sending:
            flags &= ~rs485.RX_DURING_TX
        self.state = [flags, min(before, self.most_delay), min(after, self.most_delay)]
        return 0

    def _note(self, what: str) -> None:
        self.log.append(what)
        self.changed.set()

    async def until(self, *log: str) -> None:
        """Return when this is the end of the log."""
        deadline = time.monotonic() + PATIENCE
        while tuple(self.log[-len(log) :]) != log:
            assert time.monotonic() < deadline, self.log
            self.changed.clear()
            await asyncio.to_thread(self.changed.wait, 0.01)
