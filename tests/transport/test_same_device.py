"""R13: a port is a device, not a name. Lost ports that come back as another, on ptys that play USB adapters or not."""

from __future__ import annotations

import asyncio
import errno
import fcntl
import os
import subprocess
import sys
import termios
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest
import serial

from busmaster import Hcp2Controller
from busmaster.arbiter.events import LineChange, LineChanged, PortFailed
from busmaster.bus.bus import Bus
from busmaster.errors import LineDown
from busmaster.transport import serial_port
from busmaster.transport.identity import identify
from busmaster.transport.reconnect import Connection
from busmaster.transport.serial_port import SerialPort
from tests.patience import PATIENCE
from tests.transport.fakes import PtyMaster, Recorder, opened, plugged, plugged_high, with_the_number_of
from tests.transport.usb import UsbTree


class Causes(list[str]):
    """What was told of attempts that failed, and can be waited for."""

    def __init__(self) -> None:
        super().__init__()
        self._changed = asyncio.Event()

    def hear(self, cause: LineDown) -> None:
        self.append(str(cause))
        self._changed.set()

    async def until(self, words: str) -> None:
        """Return when the last cause has these words in it."""
        async with asyncio.timeout(PATIENCE):
            while not self or words not in self[-1]:
                self._changed.clear()
                await self._changed.wait()


class Attempts(SerialPort):
    """A port that counts how often it was tried."""

    tried: list[None] = []  # noqa: RUF012  # of one test: see the fixture

    async def open(self, *arguments: Any, **options: Any) -> Any:
        self.tried.append(None)
        return await super().open(*arguments, **options)

    async def is_tried(self, more: int) -> None:
        goal = len(self.tried) + more
        async with asyncio.timeout(PATIENCE):
            while len(self.tried) < goal:  # noqa: ASYNC110  # an attempt announces itself to nobody
                await asyncio.sleep(0.001)


@asynccontextmanager
async def kept(port: SerialPort) -> AsyncIterator[tuple[Connection, Recorder, Causes]]:
    """A connection that has been made, and runs in the background."""
    recorder, causes = Recorder(), Causes()
    connection = Connection(port, recorder, on_failed=causes.hear, first_delay=0.005, longest_delay=0.02)
    await connection.open()
    running = asyncio.ensure_future(connection.run())
    try:
        yield connection, recorder, causes
    finally:
        await connection.close()
        async with asyncio.timeout(PATIENCE):
            await running


@pytest.fixture
def name(tmp_path: Path) -> Path:
    """A name that goes to whoever comes next."""
    Attempts.tried.clear()
    return tmp_path / "ttyUSB0"


def give(name: Path, end: PtyMaster) -> None:
    name.unlink(missing_ok=True)
    name.symlink_to(end.path)


@pytest.fixture
def ends() -> Iterator[list[PtyMaster]]:
    """Far ends, unplugged at the end."""
    made = [PtyMaster() for _ in range(4)]
    yield made
    for end in made:
        end.forget()


# -- the same device only --------------------------------------------------------------------------------------------


@pytest.mark.asyncio
async def test_two_adapters_that_came_back_in_the_other_order_are_refused(
    usb: UsbTree, name: Path, ends: list[PtyMaster]
) -> None:
    ours, other, back = ends[:3]
    usb.plug(ours.path, "A500ABC", place="1-1")
    give(name, ours)
    port = Attempts(str(name), baudrate=57600)
    async with kept(port) as (_, recorder, causes):
        usb.unplug(ours.path)
        usb.plug(other.path, "A500XYZ", place="1-2")
        give(name, other)
        ours.unplug()
        await causes.until("is now")
        assert causes[0] == (
            f"{name} is now FTDI A500XYZ, the line was opened on FTDI A500ABC; "
            "name it usb:A500ABC, which finds it at any USB port, or restart to use the other device"
        )
        await port.is_tried(3)
        assert len(causes) == 1
        other.write(b"of the other line")
        usb.plug(back.path, "A500ABC", place="1-3")
        give(name, back)
        await recorder.connected(2)
        back.write(b"ours")
        await recorder.heard(b"ours")
        assert recorder.received == b"ours"


@pytest.mark.asyncio
async def test_another_device_is_not_even_opened(
    usb: UsbTree, name: Path, ends: list[PtyMaster], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Opening would configure it, flush it and toggle its lines under somebody else's feet."""
    ours, other = ends[:2]
    usb.plug(ours.path, place="1-1")
    usb.plug(other.path, place="1-2")
    give(name, ours)
    async with kept(Attempts(str(name), baudrate=57600)) as (_, _, causes):
        touched: list[serial.Serial] = []
        monkeypatch.setattr(serial.Serial, "open", touched.append)
        give(name, other)
        ours.unplug()
        await causes.until(
            "is now FTDI at USB port 1-2, the line was opened on FTDI at USB port 1-1; plug it in at 1-1"
        )
        assert touched == []


@pytest.mark.asyncio
async def test_a_restart_accepts_the_other_device_and_so_does_accept_device(
    usb: UsbTree, name: Path, ends: list[PtyMaster]
) -> None:
    ours, other = ends[:2]
    usb.plug(ours.path, "A500ABC", place="1-1")
    usb.plug(other.path, "A500XYZ", place="1-2")
    give(name, ours)
    async with kept(Attempts(str(name), baudrate=57600)) as (connection, recorder, causes):
        give(name, other)
        ours.unplug()
        await causes.until("is now")
        connection.accept_device()
        await recorder.connected(2)
    async with kept(Attempts(str(name), baudrate=57600)):
        pass


@pytest.mark.asyncio
async def test_a_serial_number_follows_its_adapter_to_any_name_and_never_takes_another(
    usb: UsbTree, ends: list[PtyMaster], name: Path
) -> None:
    ours, other, back = ends[:3]
    usb.plug(ours.path, "A500ABC", place="1-1")
    port = Attempts("usb:A500ABC", baudrate=57600)
    async with kept(port) as (connection, recorder, causes):
        usb.unplug(ours.path)
        usb.plug(other.path, "A500XYZ", place="1-1")
        ours.unplug()
        await causes.until(f"usb:A500ABC is not plugged in: connected: usb:A500XYZ ({other.path}); plug it in")
        connection.accept_device()
        await port.is_tried(3)
        assert recorder.connections == 1
        assert len(causes) == 1
        usb.plug(back.path, "A500ABC", place="1-2")
        await recorder.connected(2)
        back.write(b"ours")
        await recorder.heard(b"ours")


@pytest.mark.asyncio
async def test_a_number_of_a_pseudo_terminal_that_another_device_got_is_refused(name: Path) -> None:
    with plugged_high() as ours:
        port = Attempts(ours.path, baudrate=57600)
        async with kept(port) as (_, recorder, causes):
            ours.unplug()
            await causes.until("does not exist")
            with with_the_number_of(ours) as heir:
                await causes.until(f"{ours.path} is now the pseudo-terminal made at ")
                assert ", the line was opened on the pseudo-terminal made at " in causes[-1]
                heir.write(b"somebody else's")
                await port.is_tried(3)
                assert len(causes) == 2
            assert recorder.connections == 1
            assert recorder.received == b""


@pytest.mark.asyncio
async def test_the_same_pseudo_terminal_is_opened_again_though_its_times_and_owner_changed(name: Path) -> None:
    with plugged() as pty_master:
        async with kept(Attempts(pty_master.path, baudrate=57600)) as (_, recorder, causes):
            os.chmod(pty_master.path, 0o666)
            assert recorder.transport is not None
            recorder.transport._lose(None)  # type: ignore[attr-defined]  # as the transport does when a read fails
            await recorder.connected(2)
            assert causes == []


@pytest.mark.asyncio
async def test_what_was_opened_is_looked_at_too_not_only_the_name(
    ends: list[PtyMaster], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The name may go to another device between the look and the opening."""
    monkeypatch.setattr(serial_port, "identify", lambda *_: identify(ends[1].path))
    with pytest.raises(LineDown, match=f"{ends[0].path} was replaced by another device while it was opened; try again"):
        await opened(ends[0].path)
    monkeypatch.undo()
    transport, recorder = await opened(ends[0].path)
    transport.abort()
    await recorder.lost()


# -- told, and tried again -------------------------------------------------------------------------------------------


@pytest.mark.asyncio
async def test_an_error_of_the_opening_ioctl_is_told_once_and_tried_again_until_it_works(
    name: Path, ends: list[PtyMaster], monkeypatch: pytest.MonkeyPatch
) -> None:
    give(name, ends[0])
    port = Attempts(str(name), baudrate=57600)
    async with kept(port) as (_, recorder, causes):
        really_ask, left = fcntl.ioctl, 4

        def ask(descriptor: int, request: int, *rest: Any) -> Any:
            nonlocal left
            if request == termios.TIOCEXCL and left:
                left -= 1
                raise OSError(errno.EIO, "Input/output error")
            return really_ask(descriptor, request, *rest)

        monkeypatch.setattr(fcntl, "ioctl", ask)
        give(name, ends[1])
        ends[0].unplug()
        await recorder.connected(2)
        assert left == 0
        assert causes == [f"there is no hardware behind {name}; see `python -m serial.tools.list_ports`"]


@contextmanager
def locked_elsewhere(end: PtyMaster) -> Iterator[int]:
    """The id of another process that has locked the port."""
    lock = f"import fcntl; f = open({end.path!r}); fcntl.flock(f, fcntl.LOCK_EX); print(flush=True); input()"
    with subprocess.Popen([sys.executable, "-ISc", lock], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        yield other.pid
        other.communicate(b"\n")


@pytest.mark.asyncio
async def test_a_port_that_another_program_took_meanwhile_is_told_once_with_its_holder(
    name: Path, ends: list[PtyMaster]
) -> None:
    give(name, ends[0])
    port = Attempts(str(name), baudrate=57600)
    async with kept(port) as (_, recorder, causes):
        with locked_elsewhere(ends[1]) as holder:
            give(name, ends[1])
            ends[0].unplug()
            await causes.until(f"{name} is in use by python")
            assert f"(process {holder}); end that first" in causes[-1]
            await port.is_tried(4)
            assert len(causes) == 1
        await recorder.connected(2)
        give(name, ends[2])
        ends[1].unplug()
        await recorder.connected(3)


@pytest.mark.asyncio
async def test_while_another_device_has_the_name_every_request_says_so_and_what_to_do(
    usb: UsbTree, name: Path, ends: list[PtyMaster]
) -> None:
    ours, other = ends[:2]
    usb.plug(ours.path, "A500ABC")
    usb.plug(other.path, "A500XYZ", place="1-2")
    give(name, ours)
    async with Bus(SerialPort(str(name), baudrate=57600)) as bus, asyncio.timeout(PATIENCE):
        axis, events = Hcp2Controller(bus, 1), bus.events()
        ours.unplug()
        while not isinstance(event := await anext(events), PortFailed) or "does not exist" not in event.cause:
            pass
        for request in (axis.read(1), axis.write(1, 5)):
            with pytest.raises(
                LineDown,
                match=rf"the line is down: {name} does not exist: .*; plug it in or start its emulator, or see",
            ):
                await request
        give(name, other)
        while not isinstance(event := await anext(events), PortFailed) or "is now" not in event.cause:
            pass
        for request in (axis.read(1), axis.write(1, 5)):
            with pytest.raises(LineDown) as caught:
                await request
            assert str(caught.value).endswith(
                f"the line is down: {name} is now FTDI A500XYZ, the line was opened on FTDI A500ABC "
                f"({caught.value.command}); name it usb:A500ABC, which finds it at any USB port, or restart to use "
                "the other device"
            )
            assert caught.value.attempts == 0


@pytest.mark.asyncio
async def test_the_events_of_a_bus_tell_why_its_port_does_not_come_back_and_another_device_can_be_accepted(
    usb: UsbTree, name: Path, ends: list[PtyMaster]
) -> None:
    ours, other = ends[:2]
    usb.plug(ours.path, "A500ABC")
    usb.plug(other.path, "A500XYZ", place="1-2")
    give(name, ours)
    bus = Bus(SerialPort(str(name), baudrate=57600))
    bus._accept_device()
    async with bus, asyncio.timeout(PATIENCE):
        events = bus.events()
        give(name, other)
        ours.unplug()
        changes = [await anext(events), await anext(events)]
        bus._accept_device()
        changes.append(await anext(events))
    assert changes == [
        LineChanged(LineChange.DOWN, f"{name} was lost: it hung up"),
        PortFailed(
            f"{name} is now FTDI A500XYZ, the line was opened on FTDI A500ABC",
            "name it usb:A500ABC, which finds it at any USB port, or restart to use the other device",
        ),
        LineChanged(LineChange.UP),
    ]
