"""Opening a serial port: never blocking, sole use, and refusals in words. On real ptys."""

from __future__ import annotations

import array
import asyncio
import errno
import fcntl
import os
import resource
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import serial

from busmaster.errors import LineDown
from busmaster.transport import serial_port
from busmaster.transport.marks import MarkingSerial
from busmaster.transport.reconnect import Connection
from busmaster.transport.serial_port import SerialPort
from tests.patience import PATIENCE
from tests.transport.fakes import PtyMaster, Recorder, closed, opened, plugged

TIOCGEXCL = 0x80045440


@pytest.fixture
def pty_master() -> Iterator[PtyMaster]:
    with plugged() as end:
        yield end


# -- opening ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def slow_driver(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Opening any port waits for this event."""
    ready = threading.Event()
    really_open = serial.Serial.open

    def open_slowly(device: serial.Serial) -> None:
        ready.wait()
        really_open(device)

    monkeypatch.setattr(serial.Serial, "open", open_slowly)
    yield ready
    ready.set()


@pytest.mark.asyncio
async def test_a_slow_opening_leaves_the_loop_free(pty_master: PtyMaster, slow_driver: threading.Event) -> None:
    opening = asyncio.ensure_future(opened(pty_master.path))
    await asyncio.sleep(0.02)
    assert not opening.done()
    slow_driver.set()
    await closed(*await opening)


@pytest.mark.asyncio
async def test_an_opening_that_does_not_come_back_is_given_up_and_its_port_released(
    pty_master: PtyMaster, slow_driver: threading.Event
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(serial_port, "OPEN_DEADLINE", 0.02)
        with pytest.raises(LineDown, match="did not open within"):
            await opened(pty_master.path)
    await _is_released_in_the_end(pty_master.path, slow_driver)


def test_a_program_ends_while_a_driver_still_keeps_an_opening_blocked(pty_master: PtyMaster) -> None:
    program = """
import asyncio, sys, threading
import serial
from busmaster.errors import LineDown
from busmaster.transport import serial_port

serial_port.OPEN_DEADLINE = 0.02
serial.Serial.open = lambda device: threading.Event().wait()

async def main():
    try:
        await serial_port.SerialPort(sys.argv[1], baudrate=57600).open(asyncio.Protocol)
    except LineDown as error:
        print(error.what)

asyncio.run(main())
"""
    ended = subprocess.run(
        [sys.executable, "-c", program, pty_master.path], capture_output=True, text=True, timeout=PATIENCE, check=True
    )
    assert "did not open within" in ended.stdout


def test_errors_are_the_usual_ones_if_no_descriptor_is_free(pty_master: PtyMaster) -> None:
    """Modules that only errors need cannot be imported then."""
    program = """
import asyncio, os, resource, sys
from busmaster import BusError, SerialPort
from busmaster.contract.arguments import guess

async def main():
    await asyncio.sleep(0)
    resource.setrlimit(resource.RLIMIT_NOFILE, (os.dup(0), resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    print(repr(guess("speeed", ["speed"])))
    try:
        await SerialPort(sys.argv[1], baudrate=57600).open(asyncio.Protocol)
    except BusError as error:
        print(error.what)

asyncio.run(main())
"""
    ended = subprocess.run(
        [sys.executable, "-c", program, pty_master.path], capture_output=True, text=True, timeout=PATIENCE, check=True
    )
    assert ended.stdout.splitlines() == ["''", f"cannot open {pty_master.path}: Too many open files"]


@pytest.mark.asyncio
async def test_a_cancelled_opening_releases_its_port(pty_master: PtyMaster, slow_driver: threading.Event) -> None:
    opening = asyncio.ensure_future(opened(pty_master.path))
    await asyncio.sleep(0)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    await _is_released_in_the_end(pty_master.path, slow_driver)


@pytest.mark.parametrize("exclusive", [True, False])
@pytest.mark.asyncio
async def test_an_opening_that_is_given_up_leaves_the_flags_to_a_program_that_shares_the_port(
    pty_master: PtyMaster, slow_driver: threading.Event, exclusive: bool
) -> None:
    opening = asyncio.ensure_future(opened(pty_master.path, exclusive=exclusive))
    await asyncio.sleep(0)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    await _is_released(slow_driver)
    assert bool(termios.tcgetattr(pty_master.fd)[0] & termios.PARMRK) is not exclusive


@pytest.mark.asyncio
async def test_an_opening_cancelled_when_it_was_all_but_done_is_closed_again(pty_master: PtyMaster) -> None:
    class Cancels(Recorder):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)
            opening.cancel()

    recorder = Cancels()
    opening = asyncio.ensure_future(SerialPort(pty_master.path, baudrate=57600).open(lambda: recorder))
    with pytest.raises(asyncio.CancelledError):
        await opening
    await recorder.lost()
    assert recorder.losses == [None]


async def _is_released_in_the_end(path: str, slow_driver: threading.Event) -> None:
    await _is_released(slow_driver)
    await closed(*await opened(path))


async def _is_released(slow_driver: threading.Event) -> None:
    released, really_release = threading.Event(), serial_port._release

    def release(device: serial.Serial, exclusive: bool) -> None:
        really_release(device, exclusive)
        released.set()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(serial_port, "_release", release)
        slow_driver.set()
        assert await asyncio.to_thread(released.wait, PATIENCE)


@pytest.mark.asyncio
async def test_the_port_is_configured_in_a_thread_alone(pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch) -> None:
    threads = set()
    really_ask = termios.tcgetattr

    def ask(descriptor: int) -> list[Any]:
        threads.add(threading.current_thread().name)
        return really_ask(descriptor)

    monkeypatch.setattr(termios, "tcgetattr", ask)  # each configuration begins with it
    transport, recorder = await opened(pty_master.path)
    assert f"open {pty_master.path}" in threads
    assert threading.main_thread().name not in threads
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_pty_opens_again_and_again_whatever_framing_the_protocol_has(pty_master: PtyMaster) -> None:
    for _ in range(3):
        transport, recorder = await opened(pty_master.path, bytesize=7, parity="E")
        await closed(transport, recorder)


@pytest.fixture
def high_descriptors(pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Opening the pty's port gives a descriptor above 1023, whichever are free below."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limit[1] != resource.RLIM_INFINITY and limit[1] < 1200:
        pytest.skip("the system allows this process no such descriptors")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(limit[0], 1200), limit[1]))
    really_open = os.open

    def open_high(path: Any, *how: Any, **more: Any) -> int:
        low = really_open(path, *how, **more)
        if path != pty_master.path:
            return low
        try:
            return fcntl.fcntl(low, fcntl.F_DUPFD_CLOEXEC, 1024)
        finally:
            os.close(low)

    monkeypatch.setattr(os, "open", open_high)
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, limit)


@pytest.mark.asyncio
async def test_descriptors_above_1023_work(pty_master: PtyMaster, high_descriptors: None) -> None:
    transport, recorder = await opened(pty_master.path)
    assert transport.get_extra_info("serial").fileno() > 1023
    transport.write(b"ping")
    assert pty_master.read() == b"ping"
    pty_master.write(b"pong")
    await recorder.heard(b"pong")
    await closed(transport, recorder)


# -- sole use --------------------------------------------------------------------------------------------------------


def _taken(bystander: int) -> tuple[bool, bool]:
    """Whether the port is flocked, and whether TIOCEXCL is set, as seen from a descriptor opened before."""
    flag = array.array("i", [0])
    fcntl.ioctl(bystander, TIOCGEXCL, flag)
    try:
        fcntl.flock(bystander, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True, bool(flag[0])
    fcntl.flock(bystander, fcntl.LOCK_UN)
    return False, bool(flag[0])


@pytest.mark.asyncio
async def test_both_locks_are_taken_and_given_back(pty_master: PtyMaster) -> None:
    bystander = os.open(pty_master.path, os.O_RDWR | os.O_NOCTTY)  # keeps the pty, and with it a forgotten flag, alive
    transport, recorder = await opened(pty_master.path)
    inherited = os.dup(transport.get_extra_info("serial").fileno())  # as by a process forked meanwhile
    assert _taken(bystander) == (True, True)
    await closed(transport, recorder)
    assert _taken(bystander) == (False, False)
    os.close(inherited)
    transport, recorder = await opened(pty_master.path, exclusive=False)
    assert _taken(bystander) == (False, False)
    await closed(transport, recorder)
    os.close(bystander)


@pytest.mark.parametrize("exclusive", [True, False])
@pytest.mark.asyncio
async def test_a_port_that_is_closed_or_refused_leaves_the_flags_to_a_program_that_shares_it(
    pty_master: PtyMaster, exclusive: bool
) -> None:
    def marks() -> bool:
        return bool(termios.tcgetattr(pty_master.fd)[0] & termios.PARMRK)

    await closed(*await opened(pty_master.path, exclusive=exclusive))
    assert marks() is not exclusive
    with pytest.raises(LineDown, match="no low-latency flag"):
        await opened(pty_master.path, exclusive=exclusive, low_latency=True)
    assert marks() is not exclusive


@pytest.mark.asyncio
async def test_a_second_opening_says_that_this_program_has_it(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    with pytest.raises(LineDown, match=f"{pty_master.path} is in use by this program; "):
        await opened(pty_master.path)
    await closed(transport, recorder)
    await closed(*await opened(pty_master.path))


@pytest.fixture
def holding_driver(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """A driver that does not let go of unsent bytes before this event, so that no closing is over."""
    lets_go = threading.Event()
    really_flush = termios.tcflush

    def flush(descriptor: int, queue: int) -> None:
        if queue == termios.TCOFLUSH:
            assert lets_go.wait(PATIENCE)
        really_flush(descriptor, queue)

    monkeypatch.setattr(termios, "tcflush", flush)
    monkeypatch.setattr(serial_port, "CLOSE_DEADLINE", 0.001)
    yield lets_go
    lets_go.set()
    # the next test may get a pty with the same number, and an opening that was given up may still be under way
    for closing in tuple(serial_port._closings):
        assert closing.over.wait(PATIENCE)
    for thread in threading.enumerate():
        if thread.name.startswith("open "):
            thread.join(PATIENCE)
            assert not thread.is_alive()


@pytest.mark.asyncio
async def test_a_port_that_this_program_is_still_closing_is_said_to_be_and_opens_when_that_is_over(
    pty_master: PtyMaster, holding_driver: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serial_port, "CLOSING_PATIENCE", 0.001)
    transport, recorder = await opened(pty_master.path)
    transport.close()
    await recorder.lost()
    with pytest.raises(LineDown) as caught:
        await opened(pty_master.path)
    assert str(caught.value) == (
        f"this program is still closing {pty_master.path}: its driver holds unsent bytes; "
        "it can be opened after that; if that does not end, check CTS, replug the adapter"
    )
    monkeypatch.setattr(serial_port, "CLOSING_PATIENCE", 2 * PATIENCE)
    opening = asyncio.ensure_future(opened(pty_master.path))
    await asyncio.sleep(0.05)
    assert not opening.done()
    holding_driver.set()
    transport, recorder = await asyncio.wait_for(opening, PATIENCE)
    with pytest.raises(LineDown, match="is in use by this program; "):
        await opened(pty_master.path)  # which closes nothing now
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_port_that_is_still_being_closed_is_known_by_another_name_too(
    pty_master: PtyMaster, holding_driver: threading.Event, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(serial_port, "CLOSING_PATIENCE", 0.001)
    (tmp_path / "line").symlink_to(pty_master.path)
    transport, recorder = await opened(pty_master.path)
    transport.close()
    await recorder.lost()
    with pytest.raises(LineDown, match=f"this program is still closing {tmp_path / 'line'}: "):
        await opened(str(tmp_path / "line"))


@pytest.mark.asyncio
async def test_while_one_port_is_being_closed_another_is_in_use_by_whoever_has_it(
    pty_master: PtyMaster, holding_driver: threading.Event
) -> None:
    with plugged() as other_master:
        transport, recorder = await opened(pty_master.path)
        other, of_other = await opened(other_master.path)
        transport.close()
        await recorder.lost()
        with pytest.raises(LineDown, match=f"{other_master.path} is in use by this program"):
            await opened(other_master.path)
        holding_driver.set()
        await closed(other, of_other)


@pytest.mark.asyncio
async def test_a_port_whose_closing_ends_while_its_opening_fails_is_opened(
    pty_master: PtyMaster, holding_driver: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    transport, recorder = await opened(pty_master.path)
    transport.close()
    await recorder.lost()
    [closing] = serial_port._closings
    really_open = MarkingSerial.open

    def fail(device: MarkingSerial) -> None:
        monkeypatch.setattr(MarkingSerial, "open", really_open)
        holding_driver.set()
        assert closing.over.wait(PATIENCE)
        raise OSError(errno.EBUSY, "Device or resource busy")

    monkeypatch.setattr(MarkingSerial, "open", fail)
    transport, recorder = await opened(pty_master.path)
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_port_that_is_refused_for_another_reason_says_so_at_once_whatever_is_being_closed(
    pty_master: PtyMaster, holding_driver: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serial_port, "CLOSING_PATIENCE", 0.001)
    transport, recorder = await opened(pty_master.path)
    transport.close()
    await recorder.lost()

    def fail(device: MarkingSerial) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(MarkingSerial, "open", fail)
    with pytest.raises(LineDown, match="there is no hardware behind"):
        await opened(pty_master.path)


@pytest.mark.asyncio
async def test_an_opening_for_which_the_kernel_waits_until_our_closing_is_over_says_that(
    pty_master: PtyMaster, holding_driver: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    transport, recorder = await opened(pty_master.path)
    transport.abort()
    await recorder.lost()
    monkeypatch.setattr(serial_port, "OPEN_DEADLINE", 0.02)
    with pytest.raises(LineDown, match=f"this program is still closing {pty_master.path}"):
        await opened(pty_master.path)


@pytest.mark.asyncio
async def test_a_connection_whose_output_was_held_is_back_when_the_driver_has_let_go(
    pty_master: PtyMaster, holding_driver: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serial_port, "CLOSING_PATIENCE", 0.01)
    recorder, told = Recorder(), asyncio.Event()
    causes: list[str] = []

    def hear(cause: LineDown) -> None:
        causes.append(cause.what)
        told.set()

    connection = Connection(SerialPort(pty_master.path, baudrate=57600), recorder, first_delay=0.01, on_failed=hear)
    await connection.open()
    running = asyncio.ensure_future(connection.run())
    assert recorder.transport is not None
    recorder.transport.abort()
    await asyncio.wait_for(told.wait(), PATIENCE)
    holding_driver.set()
    await recorder.connected(2)
    assert [cause.partition(":")[0] for cause in causes] == [f"this program is still closing {pty_master.path}"]
    await connection.close()
    await running


@pytest.fixture
def locked_elsewhere(pty_master: PtyMaster) -> Iterator[int]:
    """The id of another process that has locked the port."""
    lock = f"import fcntl; f = open({pty_master.path!r}); fcntl.flock(f, fcntl.LOCK_EX); print(flush=True); input()"
    with subprocess.Popen([sys.executable, "-ISc", lock], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdin is not None
        assert other.stdout is not None
        other.stdout.readline()
        yield other.pid
        other.communicate(b"\n")


@pytest.mark.asyncio
async def test_a_second_opening_says_which_other_program_has_it(pty_master: PtyMaster, locked_elsewhere: int) -> None:
    mine = os.open(pty_master.path, os.O_RDWR | os.O_NOCTTY)  # this one has it open too, and has not locked it
    try:
        with pytest.raises(LineDown, match=rf"is in use by python\S* -ISc \(process {locked_elsewhere}\)"):
            await opened(pty_master.path)
    finally:
        os.close(mine)


@pytest.mark.asyncio
async def test_a_busy_port_that_no_program_has_locked_is_said_to_be_in_use_by_the_program_that_has_it_open(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: serial.Serial) -> None:
        raise serial.SerialException(errno.EBUSY, "busy")

    monkeypatch.setattr(serial.Serial, "open", refuse)
    mine = os.open(pty_master.path, os.O_RDWR | os.O_NOCTTY)
    try:
        with pytest.raises(LineDown, match="is in use by this program; end that first"):
            await opened(pty_master.path)
    finally:
        os.close(mine)


# -- what only some drivers have -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("option", "says"), [("rs485", "no RS-485 mode; leave rs485 out"), ("low_latency", "no low-latency flag; leave")]
)
@pytest.mark.asyncio
async def test_a_driver_without_it_is_named_and_the_port_released(
    pty_master: PtyMaster, option: str, says: str
) -> None:
    with pytest.raises(LineDown, match=f"the driver of {pty_master.path} has {says}"):
        await opened(pty_master.path, **{option: True})
    await closed(*await opened(pty_master.path))


@pytest.mark.asyncio
async def test_driver_extras_are_touched_only_when_asked_for(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", lambda _, flag: asked.append(flag))
    await closed(*await opened(pty_master.path))
    assert asked == []
    await closed(*await opened(pty_master.path, low_latency=False))
    await closed(*await opened(pty_master.path, low_latency=True))
    assert asked == [False, True]


# -- refusals --------------------------------------------------------------------------------------------------------


@pytest.mark.asyncio
async def test_a_missing_port_is_said_to_be_missing(tmp_path: Path) -> None:
    with pytest.raises(LineDown, match=r"/no-port does not exist; plug it in"):
        await opened(str(tmp_path / "no-port"))


@pytest.mark.asyncio
async def test_a_dangling_link_says_where_it_points(tmp_path: Path) -> None:
    link = tmp_path / "port"
    link.symlink_to("/dev/pts/99999")
    with pytest.raises(LineDown, match=r"/port does not exist: it points to /dev/pts/99999, which is gone"):
        await opened(str(link))


@pytest.mark.asyncio
async def test_a_file_is_no_serial_port(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", tmp_path, Path(os.devnull)):
        with pytest.raises(LineDown, match="is not a serial port; see"):
            await opened(str(path))


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (serial.SerialException(errno.EACCES, "denied"), r"no permission to open .*; (join|its) "),
        (PermissionError(errno.EPERM, "not permitted"), r"no permission to open .*; (join|its) "),
        (serial.SerialException(errno.EBUSY, "busy"), "is in use by another program"),
        (serial.SerialException(errno.ENXIO, "nothing"), "there is no hardware behind"),
        (serial.SerialException(errno.ENODEV, "nothing"), "there is no hardware behind"),
        (termios.error(errno.EIO, "Input/output error"), "there is no hardware behind"),
        (ValueError("Failed to set custom baud rate"), "does not take 57600 baud, 8N1"),
        (OSError(errno.EMFILE, "too many"), "Too many open files"),
    ],
)
@pytest.mark.asyncio
async def test_every_refusal_is_one_sentence_about_the_port(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch, error: Exception, says: str
) -> None:
    def refuse(_: serial.Serial) -> None:
        raise error

    monkeypatch.setattr(serial.Serial, "open", refuse)
    with pytest.raises(LineDown, match=says) as caught:
        await opened(pty_master.path)
    assert pty_master.path in str(caught.value)
    assert caught.value.__cause__ is None
