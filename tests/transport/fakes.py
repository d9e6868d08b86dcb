"""What the transport tests stand on: a protocol that notes what it hears, and the far end of a pty."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import select
import socket
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from busmaster.contract.profile import LineSettings
from busmaster.emulator.memory import MemoryTransport
from busmaster.errors import LineDown
from busmaster.testing.virtual_time import VirtualTimeLoop
from busmaster.transport import serial_port
from busmaster.transport.serial_port import PortTransport, SerialPort
from tests.patience import PATIENCE

VIRTUAL_PATIENCE = 1000.0
"""Virtual seconds after which something that should happen has not."""
SO_ATTACH_FILTER, SO_DETACH_FILTER = 26, 27
BPF_RETURN = 6
"""Linux: asm/socket.h, linux/bpf_common.h."""
SPARE_NUMBERS = 32


class Recorder(asyncio.Protocol):
    """Notes every callback, and can be waited for."""

    def __init__(self) -> None:
        self.transport: asyncio.Transport | None = None
        self.connections = 0
        self.received = b""
        self.losses: list[Exception | None] = []
        self.flow: list[str] = []
        self._changed = asyncio.Event()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)
        self.connections += 1
        self._changed.set()

    def data_received(self, data: bytes) -> None:
        self.received += data
        self._changed.set()

    def pause_writing(self) -> None:
        self.flow.append("pause")

    def resume_writing(self) -> None:
        self.flow.append("resume")
        self._changed.set()

    def connection_lost(self, exc: Exception | None) -> None:
        self.losses.append(exc)
        self._changed.set()

    async def connected(self, times: int = 1) -> None:
        """Return when it has been connected that often in all."""
        await self.until(lambda _: self.connections >= times)

    async def lost(self, times: int = 1) -> None:
        """Return when `connection_lost` has been called that often in all."""
        await self.until(lambda _: len(self.losses) >= times)

    async def heard(self, end: bytes) -> None:
        """Return when what was received ends with this."""
        await self.until(lambda _: self.received.endswith(end))

    async def until(self, condition: Callable[[Recorder], bool]) -> None:
        """Return when `condition` holds. Raises TimeoutError if it does not come to hold."""
        virtual = isinstance(asyncio.get_running_loop(), VirtualTimeLoop)
        async with asyncio.timeout(VIRTUAL_PATIENCE if virtual else PATIENCE):
            while not condition(self):
                self._changed.clear()
                await self._changed.wait()


class PtyMaster:
    """The master side of a pty; `path` is where its port is opened."""

    def __init__(self) -> None:
        self.fd, slave = os.openpty()
        self.path = os.ttyname(slave)
        self.number = int(self.path.rpartition("/")[2])
        self._kept = -1
        os.close(slave)
        os.set_blocking(self.fd, False)

    def read(self, patience: float = PATIENCE) -> bytes:
        """What has arrived, after waiting for the first of it without turning the event loop."""
        poller = select.poll()
        poller.register(self.fd, select.POLLIN)
        if not poller.poll(patience * 1000):
            return b""
        return os.read(self.fd, 65536)

    def rest(self) -> bytes:
        """All that still comes, when the port has been closed."""
        found = b""
        with contextlib.suppress(OSError):  # EIO: nobody has it open any more
            while data := self.read():
                found += data
        return found

    def write(self, data: bytes) -> None:
        os.write(self.fd, data)

    def unplug(self) -> None:
        """Hang up. The number stays taken until `forget`.

        Otherwise a pty of a test in another process would get it, and a connection that still tries this name would
        open that pty.
        """
        if self.fd >= 0:
            with contextlib.suppress(OSError):  # EBUSY: only root opens a port that is in exclusive use
                self._kept = os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            os.close(self.fd)
            self.fd = -1

    def forget(self) -> None:
        """Hang up, if that is still to be done, and give back the number."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1
        if self._kept >= 0:
            os.close(self._kept)
            self._kept = -1


@contextlib.contextmanager
def plugged(link: Path | None = None) -> Iterator[PtyMaster]:
    """A fresh pty, with a symlink to it if one is wanted; unplugged at the end."""
    pty_master = PtyMaster()
    if link is not None:
        link.symlink_to(pty_master.path)
    try:
        yield pty_master
    finally:
        pty_master.forget()
        if link is not None:
            link.unlink()


@contextlib.contextmanager
def standing_still(sock: socket.socket) -> Iterator[None]:
    """A network path on which nothing reaches this end meanwhile: a socket filter drops it, unacknowledged."""
    nothing = ctypes.create_string_buffer(struct.pack("HBBI", BPF_RETURN, 0, 0, 0))
    program = struct.pack("HL" if struct.calcsize("P") == 4 else "HxxxxxxQ", 1, ctypes.addressof(nothing))
    sock.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, program)
    try:
        yield
    finally:
        sock.setsockopt(socket.SOL_SOCKET, SO_DETACH_FILTER, 0)


async def opened(path: str, **options: Any) -> tuple[PortTransport, Recorder]:
    """The serial port at `path`, open, and what hears it."""
    recorder = Recorder()
    transport = await SerialPort(path, baudrate=57600, **options).open(lambda: recorder)
    return transport, recorder


async def closed(transport: PortTransport, recorder: Recorder) -> None:
    """Close it, and wait until the driver has let go of it, however long that takes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(serial_port, "CLOSE_DEADLINE", 2 * PATIENCE)
        transport.close()
    await recorder.lost()


@contextlib.contextmanager
def plugged_high() -> Iterator[PtyMaster]:
    """A pty whose number no other process gets when it is gone: the lowest is given, and many lower ones are free."""
    ends = sorted((PtyMaster() for _ in range(SPARE_NUMBERS)), key=lambda end: end.number)
    for end in ends[:-1]:
        end.forget()
    try:
        yield ends[-1]
    finally:
        ends[-1].forget()


@contextlib.contextmanager
def with_the_number_of(gone: PtyMaster) -> Iterator[PtyMaster]:
    """Another pty that has the number of one that is gone; the lower ones are taken meanwhile, if they were free."""
    gone.forget()
    lower: list[PtyMaster] = []
    deadline = time.monotonic() + PATIENCE
    while (pty_master := PtyMaster()).path != gone.path:
        assert time.monotonic() < deadline, f"{gone.path} was not given again"
        if pty_master.number < gone.number:
            lower.append(pty_master)
        else:  # it is still being closed
            pty_master.forget()
            time.sleep(0.001)
    try:
        yield pty_master
    finally:
        for end in (pty_master, *lower):
            end.forget()


def without_rate(transport: MemoryTransport, baudrate: int) -> MemoryTransport:
    """Return the transport as one of a port that does not take this rate."""
    tune = transport.tune

    async def choose(settings: LineSettings) -> None:
        if settings.baudrate == baudrate:
            raise LineDown(f"{baudrate} baud: invalid argument", hint="")
        await tune(settings)

    transport.tune = choose  # type: ignore[method-assign]  # of this one
    return transport
