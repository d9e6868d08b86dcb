"""Connection: one endpoint kept connected, with back-off, on ptys, TCP ports and a port that is told to fail."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator, Callable, Hashable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, cast

import pytest

from busmaster.contract.profile import LineSettings
from busmaster.errors import LineDown
from busmaster.testing.virtual_time import run_in_virtual_time
from busmaster.transport import reconnect
from busmaster.transport.endpoints import Endpoint
from busmaster.transport.identity import Identity
from busmaster.transport.reconnect import Connection
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort
from tests.patience import PATIENCE
from tests.ports import free_port
from tests.transport.fakes import PtyMaster, Recorder, plugged


@asynccontextmanager
async def kept(endpoint: Endpoint, recorder: Recorder, **options: Any) -> AsyncIterator[Connection]:
    """A connection that runs in the background."""
    connection = Connection(endpoint, recorder, **options)
    running = asyncio.ensure_future(connection.run())
    try:
        yield connection
    finally:
        await connection.close()
        async with asyncio.timeout(PATIENCE):
            await running


class Wire:
    """A transport without anything behind it, nor asyncio's class (as uvloop's). `stuck`: never closes."""

    def __init__(self, told: Told, protocol: asyncio.Protocol, stuck: bool) -> None:
        self.told = told
        self.protocol = protocol
        self.stuck = stuck
        self.aborted = False

    def get_extra_info(self, name: str) -> Any:
        return self.told.device if name == "identity" else None

    def close(self) -> None:
        if not self.stuck:
            self.lose(None)

    def abort(self) -> None:
        self.aborted = True
        self.lose(None)

    def lose(self, cause: Exception | None) -> None:
        asyncio.get_running_loop().call_soon(self.protocol.connection_lost, cause)


class Told:
    """An endpoint that fails as often as it is told to."""

    name = "told"
    settings: LineSettings | None = None
    echo = False
    receive_latency = 0.0
    paced: bool | None = False

    def __init__(self, failures: float = 0, stuck: bool = False) -> None:
        self.failures = failures
        self.stuck = stuck
        self.attempts: list[float] = []
        self.wires: list[Wire] = []
        self.seen: Hashable | None = None
        self.device: Identity | None = None
        self.asked_for: list[Identity | None] = []
        self.errors: list[Exception] = []

    def presence(self) -> Hashable | None:
        return self.seen

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: Identity | None = None
    ) -> asyncio.Transport:
        self.attempts.append(asyncio.get_running_loop().time())
        self.asked_for.append(only)
        if self.errors:
            raise self.errors.pop(0)
        if len(self.attempts) <= self.failures:
            raise LineDown("told does not exist")
        wire = Wire(self, protocol_factory(), self.stuck)
        self.wires.append(wire)
        transport = cast("asyncio.Transport", wire)
        wire.protocol.connection_made(transport)
        return transport

    @property
    def pauses(self) -> list[float]:
        return [after - before for before, after in zip(self.attempts, self.attempts[1:], strict=False)]


# -- opening ---------------------------------------------------------------------------------------------------------


@pytest.mark.asyncio
async def test_the_first_opening_says_why_it_failed() -> None:
    recorder = Recorder()
    connection = Connection(Told(failures=1), recorder)
    with pytest.raises(LineDown, match="told does not exist"):
        await connection.open()
    assert recorder.connections == 0
    await connection.open()
    assert recorder.connections == 1
    await connection.close()
    assert recorder.losses == [None]


class Even(random.Random):
    """Spreads nothing."""

    def uniform(self, a: float, b: float) -> float:
        assert (a, b) == (0.75, 1.25)
        return 1.0


def test_attempts_back_off_by_doubling_up_to_the_longest_delay_and_their_reason_is_told_once() -> None:
    async def fail() -> None:
        told, recorder, causes = Told(failures=5), Recorder(), list[LineDown]()
        async with kept(told, recorder, on_failed=causes.append, first_delay=1.0, longest_delay=4.0, jitter=Even()):
            await recorder.connected()
        assert told.pauses == pytest.approx([1, 2, 4, 4, 4])
        assert [cause.what for cause in causes] == ["told does not exist"]

    run_in_virtual_time(fail())


def test_a_device_that_was_there_all_the_time_has_not_returned() -> None:
    async def fail() -> None:
        told, recorder = Told(failures=3), Recorder()
        told.seen = "there"
        async with kept(told, recorder, first_delay=1.0, longest_delay=4.0, jitter=Even()):
            await recorder.connected()
        assert told.pauses == pytest.approx([1, 2, 4])

    run_in_virtual_time(fail())


def test_delays_are_spread_by_a_quarter_from_a_seeded_source() -> None:
    async def pauses(seed: int) -> list[float]:
        told, recorder = Told(failures=20), Recorder()
        async with kept(told, recorder, first_delay=1.0, longest_delay=1.0, jitter=random.Random(seed)):
            await recorder.connected()
        return told.pauses

    once, again, other = (run_in_virtual_time(pauses(seed)) for seed in (1, 1, 2))
    assert once == again != other
    assert all(0.74 < pause < 1.26 for pause in once)


def test_a_port_that_opens_and_is_lost_at_once_is_not_hammered_but_one_that_held_is_reopened_soon() -> None:
    async def lose(after: float) -> list[float]:
        told, recorder = Told(), Recorder()
        async with kept(told, recorder, first_delay=1.0, longest_delay=4.0, jitter=Even()):
            for n in range(1, 5):
                await recorder.connected(n)
                await asyncio.sleep(after)
                told.wires[-1].lose(None)
            await recorder.connected(5)
        return told.pauses

    assert run_in_virtual_time(lose(0.0)) == pytest.approx([1, 2, 4, 4])
    assert run_in_virtual_time(lose(10.0)) == pytest.approx([11, 11, 11, 11])


def test_a_device_that_is_seen_to_return_is_opened_at_once_and_the_delays_begin_anew() -> None:
    async def replug() -> None:
        told, recorder = Told(failures=5), Recorder()
        async with kept(told, recorder, first_delay=1.0, longest_delay=100.0, jitter=Even()):
            await asyncio.sleep(9.0)
            assert len(told.attempts) == 4
            told.seen = "back"
            await recorder.connected()
        assert told.attempts == pytest.approx([0, 1, 3, 7, 9, 10], abs=reconnect.LOOK_EVERY)

    run_in_virtual_time(replug())


# -- never ending ----------------------------------------------------------------------------------------------------


def test_r13_no_exception_ends_the_reconnecting_and_each_reason_is_told() -> None:
    async def fail() -> None:
        told, recorder, causes = Told(), Recorder(), list[LineDown]()
        bug = ValueError("odd")
        told.errors = [OSError(5, "Input/output error"), OSError(5, "Input/output error"), bug, bug, KeyError("k")]
        told.errors += [LineDown("in use by ModemManager"), TimeoutError(), OSError(5, "Input/output error")]
        async with kept(told, recorder, on_failed=causes.append):
            await recorder.connected()
        assert [cause.what for cause in causes] == [
            "cannot open told: Input/output error",
            "cannot open told: ValueError: odd",
            "cannot open told: KeyError: 'k'",
            "in use by ModemManager",
            "cannot open told: TimeoutError",
            "cannot open told: Input/output error",
        ]
        assert causes[1].__cause__ is bug
        assert [cause.__cause__ is None for cause in causes] == [True, False, False, True, True, True]
        assert causes[1].hint == "this is a bug; report it with the text from the log"

    run_in_virtual_time(fail())


def test_r13_looking_for_the_device_may_fail_too_and_is_told_once_beside_the_attempts() -> None:
    class Blind(Told):
        def presence(self) -> Hashable | None:
            raise OSError(13, "Permission denied")

    async def fail() -> None:
        told, recorder, causes = Blind(failures=5), Recorder(), list[LineDown]()
        async with kept(told, recorder, on_failed=causes.append, first_delay=1.0):
            await recorder.connected()
        assert [cause.what for cause in causes] == ["cannot open told: Permission denied", "told does not exist"]

    run_in_virtual_time(fail())


def test_r13_a_reason_is_told_again_after_it_was_open_in_between() -> None:
    async def fail() -> None:
        told, recorder, causes = Told(failures=2), Recorder(), list[LineDown]()
        async with kept(told, recorder, on_failed=causes.append):
            await recorder.connected()
            told.failures = len(told.attempts) + 2
            told.wires[-1].lose(None)
            await recorder.connected(2)
        assert [cause.what for cause in causes] == ["told does not exist"] * 2

    run_in_virtual_time(fail())


def test_r13_an_owner_that_fails_when_it_is_told_ends_nothing_either() -> None:
    async def fail() -> None:
        def refuse(cause: LineDown) -> None:
            raise RuntimeError("no ears")

        said: list[str] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: said.append(context["message"]))
        told, recorder = Told(failures=3), Recorder()
        async with kept(told, recorder, on_failed=refuse):
            await recorder.connected()
        assert said == ["on_failed of told failed"]

    run_in_virtual_time(fail())


def test_r13_the_device_that_was_opened_first_is_the_only_one_asked_for_until_another_is_accepted() -> None:
    class Device:
        advice = ""

        def accepts(self, found: Identity) -> bool:
            return found is self

        def is_behind(self, descriptor: int) -> bool:
            return True

    async def replug() -> None:
        told, recorder = Told(), Recorder()
        told.device = first = Device()
        async with kept(told, recorder) as connection:
            for n in range(1, 4):
                await recorder.connected(n)
                if n == 2:
                    connection.accept_device()
                told.wires[-1].lose(None)
            await recorder.connected(4)
        assert told.asked_for == [None, first, None, first]

    run_in_virtual_time(replug())


# -- losing it -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cause", "says"),
    [
        (None, "told was closed by the other end"),
        (ConnectionResetError(104, "Connection reset by peer"), "told was lost: Connection reset by peer"),
        (RuntimeError("odd"), "told was lost: odd"),
        (LineDown("gone", hint=""), "gone"),
    ],
)
@pytest.mark.asyncio
async def test_every_loss_has_a_cause_in_words(cause: Exception | None, says: str) -> None:
    told, recorder = Told(), Recorder()
    async with kept(told, recorder):
        await recorder.connected()
        told.wires[0].lose(cause)
        await recorder.lost()
        assert isinstance(recorder.losses[0], LineDown)
        assert str(recorder.losses[0]) == says


@pytest.mark.asyncio
async def test_a_pty_that_is_unplugged_and_comes_back_at_its_link_is_picked_up(tmp_path: Path) -> None:
    link, recorder = tmp_path / "line", Recorder()
    async with kept(SerialPort(str(link), baudrate=57600), recorder):
        for n in range(3):
            with plugged(link) as pty_master:
                await recorder.connected(n + 1)
                pty_master.write(b"%d" % n)
                await recorder.heard(b"%d" % n)
                assert recorder.transport is not None
                recorder.transport.write(b"hello")
                assert pty_master.read() == b"hello"
            await recorder.lost(n + 1)
    assert all(isinstance(loss, LineDown) for loss in recorder.losses)


@pytest.mark.asyncio
async def test_a_server_that_is_restarted_is_connected_to_again() -> None:
    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(await reader.read(100))
        writer.close()

    address = ("127.0.0.1", free_port())
    server = await asyncio.start_server(answer, *address)
    recorder = Recorder()
    async with kept(TcpPort(*address), recorder, first_delay=0.001):
        await recorder.connected()
        server.close()
        assert recorder.transport is not None
        recorder.transport.write(b"one")
        await recorder.lost()
        assert recorder.received == b"one"
        assert "closed by the other end" in str(recorder.losses[0])
        server = await asyncio.start_server(answer, *address)
        await recorder.connected(2)
    assert recorder.losses[1:] == [None]
    server.close()


# -- closing ---------------------------------------------------------------------------------------------------------


def test_closing_ends_a_run_that_waits_for_its_next_attempt() -> None:
    async def fail() -> float:
        async with kept(Told(failures=10), Recorder(), first_delay=60.0, longest_delay=60.0):
            await asyncio.sleep(30.0)
        return asyncio.get_running_loop().time()

    assert run_in_virtual_time(fail()) == pytest.approx(30.0)


@pytest.mark.asyncio
async def test_closing_while_an_opening_is_under_way_closes_what_it_opens(tmp_path: Path) -> None:
    with plugged() as pty_master:
        recorder = Recorder()
        connection = Connection(SerialPort(pty_master.path, baudrate=57600), recorder)
        opening = asyncio.ensure_future(connection.open())
        await asyncio.sleep(0)
        await connection.close()
        await opening
        assert recorder.connections == 1
        assert recorder.losses == [None]


@pytest.mark.asyncio
async def test_a_transport_that_never_closes_is_aborted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reconnect, "CLOSE_DEADLINE", 0.01)
    told, recorder = Told(stuck=True), Recorder()
    connection = Connection(told, recorder)
    await connection.open()
    await connection.close()
    assert told.wires[0].aborted
    assert recorder.losses == [None]
    await connection.close()


@pytest.mark.asyncio
async def test_flow_control_reaches_the_protocol() -> None:
    with plugged() as pty_master:
        await _flood(pty_master)


async def _flood(pty_master: PtyMaster) -> None:
    recorder = Recorder()
    async with kept(SerialPort(pty_master.path, baudrate=57600), recorder):
        await recorder.connected()
        assert recorder.transport is not None
        recorder.transport.write(bytes(200_000))
        while "resume" not in recorder.flow:
            pty_master.read(patience=0.001)
            await asyncio.sleep(0)
    assert recorder.flow == ["pause", "resume"]


def test_a_close_that_is_cancelled_still_gives_the_port_back() -> None:
    async def cancel() -> None:
        told, recorder = Told(stuck=True), Recorder()
        connection = Connection(told, recorder)
        await connection.open()
        closing = asyncio.ensure_future(connection.close())
        await asyncio.sleep(reconnect.CLOSE_DEADLINE / 2)
        assert [wire.aborted for wire in told.wires] == [False]
        closing.cancel()
        with pytest.raises(asyncio.CancelledError):
            await closing
        assert [wire.aborted for wire in told.wires] == [True]
        await recorder.lost()
        assert recorder.losses == [None]

    run_in_virtual_time(cancel())
