"""What the kernel knows of an open port: what has not left, and what the driver counted."""

from __future__ import annotations

import array
import asyncio
import errno
import fcntl
import socket
import termios
from collections.abc import Callable, Coroutine, Iterator
from types import SimpleNamespace
from typing import Any, cast

import pytest
import uvloop

from busmaster import Bus, SerialPort
from busmaster.arbiter.counters import DriverErrors
from busmaster.transport import kernel
from busmaster.transport.kernel import DELAYED_ACK, TIOCGICOUNT, Socket, open_port
from busmaster.transport.tcp import TcpPort
from tests.app.outputs.cycles import until as outside_until
from tests.patience import PATIENCE
from tests.transport.fakes import PtyMaster, Recorder, closed, opened, plugged, standing_still
from tests.transport.test_marks import set_input_flags

Runner = Callable[[Coroutine[Any, Any, None]], None]
LATER = 60.0
"""Seconds after the last write: no path is that slow."""


@pytest.fixture
def pty_master() -> Iterator[PtyMaster]:
    with plugged() as end:
        yield end


class Driver:
    """Answers a serial driver's ioctls as a UART's would: a pty has neither a queue nor counts."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.queue = 0
        self.counts: dict[int, int] | None = {}
        self._really = fcntl.ioctl
        monkeypatch.setattr(fcntl, "ioctl", self.ioctl)

    def ioctl(self, descriptor: int, request: int, answer: Any = 0, *rest: Any) -> Any:
        if request == termios.TIOCOUTQ:
            answer[0] = self.queue
            return 0
        if request == TIOCGICOUNT:
            if self.counts is None:
                raise OSError(errno.ENOTTY, "Inappropriate ioctl for device")
            for place, count in self.counts.items():
                answer[place] = count
            return 0
        return self._really(descriptor, request, answer, *rest)


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Driver:
    return Driver(monkeypatch)


# -- a tty -----------------------------------------------------------------------------------------------------------


@pytest.mark.asyncio
async def test_what_a_stopped_tty_does_not_take_has_not_left(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    port = open_port(transport)
    assert port.unsent(0.0) == 0
    termios.tcflow(transport._fd, termios.TCOOFF)
    transport.write(b"05\x05")
    assert port.unsent(0.0) == 3
    assert recorder.flow == ["pause"]
    termios.tcflow(transport._fd, termios.TCOON)
    await recorder.until(lambda r: r.flow == ["pause", "resume"])
    assert port.unsent(0.0) == 0
    assert pty_master.read() == b"05\x05"
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_a_port_with_flow_control_is_one_that_can_hold_its_bytes(pty_master: PtyMaster) -> None:
    for rtscts in (True, False):
        transport, recorder = await opened(pty_master.path, rtscts=rtscts)
        assert open_port(transport).flow_controlled is rtscts
        await closed(transport, recorder)


@pytest.mark.asyncio
async def test_bytes_that_have_come_and_were_not_handed_over_are_seen(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    port = open_port(transport)
    assert not port.unread()
    pty_master.write(b"late")
    outside_until(port.unread)  # the loop does not turn meanwhile
    assert recorder.received == b""
    await recorder.until(lambda r: r.received == b"late")
    assert not port.unread()
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_what_lies_in_the_drivers_queue_has_not_left(pty_master: PtyMaster, driver: Driver) -> None:
    transport, recorder = await opened(pty_master.path)
    driver.queue = 8
    assert open_port(transport).unsent(0.0) == 8
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_the_drivers_counts_run_from_the_opening_or_the_reset_and_over_their_end(
    pty_master: PtyMaster, driver: Driver
) -> None:
    driver.counts = {6: 10, 7: 20, 8: 2**31 - 1, 9: 40, 10: 50}  # frame, overrun, parity, brk, buf_overrun
    transport, recorder = await opened(pty_master.path)
    port = open_port(transport)
    assert port.errors() == DriverErrors(0, 0, 0, 0, 0)
    driver.counts = {6: 11, 7: 22, 8: -(2**31) + 2, 9: 44, 10: 55}
    assert port.errors() == DriverErrors(framing=1, parity=3, breaks=4, overruns=2, buffer_overruns=5)
    port.reset()
    assert port.errors() == DriverErrors(0, 0, 0, 0, 0)
    await closed(transport, recorder)


@pytest.mark.asyncio
async def test_the_drivers_counts_begin_again_where_the_buss_statistics_are_reset(
    pty_master: PtyMaster, driver: Driver
) -> None:
    driver.counts = {6: 10, 7: 0, 8: 0, 9: 0, 10: 0}
    async with Bus(SerialPort(pty_master.path, baudrate=57600)) as bus:
        driver.counts[6] += 1
        assert (await bus.statistics()).driver == DriverErrors(
            framing=1, parity=0, breaks=0, overruns=0, buffer_overruns=0
        )
        bus.reset_statistics()
        assert (await bus.statistics()).driver == DriverErrors(0, 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("counted", "told"),
    [
        ({9: 3}, (90, 3)),
        ({6: 93, 9: 3}, (90, 3)),
        ({6: 93}, (93, 0)),
        ({9: 93}, (0, 93)),
        ({}, (0, 93)),  # a driver that does not count, though it can be asked
        ({7: 5, 10: 5}, (0, 93)),
        (None, (0, 93)),  # one that cannot be asked
    ],
)
@pytest.mark.asyncio
async def test_marks_of_damaged_zeros_are_no_breaks_where_the_driver_counts_those(
    pty_master: PtyMaster, driver: Driver, counted: dict[int, int] | None, told: tuple[int, int]
) -> None:
    before = {6: 10, 7: 20, 8: 30, 9: 2**31 - 2, 10: 50}
    driver.counts = None if counted is None else dict(before)
    async with Bus(SerialPort(pty_master.path, baudrate=57600)) as bus, asyncio.timeout(PATIENCE):

        async def heard(marks: int) -> tuple[int, int]:
            pty_master.write(b"\xff\x00\x00" * marks)
            while (found := await bus.statistics()).damaged + found.breaks < marks:  # noqa: ASYNC110  # nothing tells
                await asyncio.sleep(0.001)
            return found.damaged, found.breaks

        transport: Any = bus._pump._transport
        set_input_flags(transport._fd, 0)
        if counted is not None:
            driver.counts = {n: _wrapped(before[n] + counted.get(n, 0)) for n in before}
        assert await heard(93) == told
        bus.reset_statistics()
        assert await heard(2) == ((2, 0) if counted and not counted.keys() <= {7, 10} else (0, 2))


def _wrapped(count: int) -> int:
    """As an int of 32 bits, which the kernel's counts are."""
    return (count + 2**31) % 2**32 - 2**31


@pytest.mark.asyncio
async def test_a_pty_has_no_counts_of_a_driver(pty_master: PtyMaster) -> None:
    transport, recorder = await opened(pty_master.path)
    assert open_port(transport).errors() is None
    await closed(transport, recorder)


def test_a_transport_that_cannot_tell_is_not_asked() -> None:
    class Foreign:
        def get_extra_info(self, name: str, default: Any = None) -> Any:
            return default

    port = open_port(cast("asyncio.Transport", Foreign()))
    assert port.unsent(LATER) is None
    assert not port.unread()
    assert port.errors() is None
    assert open_port(asyncio.Transport()).unsent(LATER) is None


def test_the_struct_that_is_read_has_room_for_all_of_the_kernels() -> None:
    assert array.array("i").itemsize * kernel.ICOUNTER_SIZE == 80


# -- a socket --------------------------------------------------------------------------------------------------------


def run_on_uvloop(main: Coroutine[Any, Any, None]) -> None:
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(main)


both_loops = pytest.mark.parametrize("run", [asyncio.run, run_on_uvloop], ids=["asyncio", "uvloop"])


class Peer:
    """A server that never reads, with its one connection."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self.connection = socket.socket()

    async def connect(self) -> tuple[asyncio.Transport, Socket, Recorder]:
        recorder = Recorder()
        transport = await TcpPort("127.0.0.1", self.listener.getsockname()[1]).open(lambda: recorder)
        self.connection.close()
        self.connection, _ = self.listener.accept()
        self.connection.settimeout(PATIENCE)
        port = open_port(transport)
        assert isinstance(port, Socket)
        return transport, port, recorder

    def read_all(self) -> None:
        """Read to the end of the connection."""
        while self.connection.recv(1_000_000):
            pass

    def close(self) -> None:
        self.connection.close()
        self.listener.close()


@pytest.fixture
def peer() -> Iterator[Peer]:
    made = Peer()
    yield made
    made.close()


async def until(condition: Callable[[], bool]) -> None:
    """The kernel tells of an acknowledgement to nobody: it must be looked for."""
    async with asyncio.timeout(PATIENCE):
        while not condition():  # noqa: ASYNC110  # the kernel announces it to nobody
            await asyncio.sleep(0.001)


@both_loops
def test_what_is_under_way_on_a_path_that_stands_still_counts_once_it_is_later_than_usual(
    peer: Peer, run: Runner
) -> None:
    async def main() -> None:
        transport, port, recorder = await peer.connect()
        with standing_still(peer.connection):
            transport.write(b"05\x05")
            assert port.unsent(0.0) == 0
            assert port.unsent(LATER) == 3
        transport.write(b"again")
        await until(lambda: port.unsent(LATER) == 0)
        assert peer.connection.recv(3, socket.MSG_WAITALL) == b"05\x05"
        transport.close()
        await recorder.lost()

    run(main())


@both_loops
def test_an_acknowledgement_within_the_usual_time_of_the_path_is_waited_for(peer: Peer, run: Runner) -> None:
    async def main() -> None:
        transport, port, recorder = await peer.connect()
        with standing_still(peer.connection):
            transport.write(b"05\x05")
            usual = port._usual_acknowledgement()
            assert usual < LATER
            port._usual_acknowledgement = lambda: 0.2  # type: ignore[method-assign]  # a slow path
            assert port.unsent(0.199) == 0
            assert port.unsent(0.201) == 3
            port._usual_acknowledgement = lambda: 0.0  # type: ignore[method-assign]  # a quick one
            assert port.unsent(DELAYED_ACK - 0.001) == 0
            assert port.unsent(DELAYED_ACK + 0.001) == 3
        transport.abort()
        await recorder.lost()

    run(main())


@pytest.mark.asyncio
async def test_the_usual_time_of_an_acknowledgement_is_that_of_the_kernels_retransmissions(peer: Peer) -> None:
    transport, port, recorder = await peer.connect()
    measured = kernel.TCP_INFO_TIMES.pack(100_000, 25_000)  # microseconds: 100 ms, and four times 25 ms
    with standing_still(peer.connection):
        transport.write(b"05\x05")
        really = port._socket
        port._socket = cast("socket.socket", SimpleNamespace(getsockopt=lambda *_: measured))
        assert (port.unsent(0.199), port.unsent(0.201)) == (0, 3)
        port._socket = really
    transport.abort()
    await recorder.lost()


@both_loops
def test_what_a_peer_that_stops_reading_has_no_room_for_has_not_left(peer: Peer, run: Runner) -> None:
    async def main() -> None:
        transport, port, recorder = await peer.connect()
        while port.unsent(0.0) == 0:
            transport.write(bytes(100_000))
            await asyncio.sleep(0)
        port.discard_unsent()
        transport.abort()
        await recorder.lost()
        with pytest.raises(ConnectionResetError):
            peer.read_all()

    run(main())


@both_loops
def test_what_is_discarded_on_a_path_that_stands_still_never_arrives(peer: Peer, run: Runner) -> None:
    async def main() -> None:
        transport, port, recorder = await peer.connect()
        with standing_still(peer.connection):
            transport.write(b"write 1 to element 5")
            port.discard_unsent()
            transport.abort()
            await recorder.lost()
        peer.connection.settimeout(0.3)
        with pytest.raises((ConnectionResetError, TimeoutError)):  # the reset may have been dropped as well
            peer.connection.recv(100)

    run(main())
