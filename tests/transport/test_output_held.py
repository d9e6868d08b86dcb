"""Requests that do not leave when they are written: the process stands still, or the port holds them back."""

from __future__ import annotations

import asyncio
import socket
import termios
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import replace
from math import inf
from random import Random
from types import SimpleNamespace
from typing import Any, cast

import pytest

from busmaster import (
    Bus,
    BusError,
    Hcp2Controller,
    LineDown,
    MemoryPort,
    NoReply,
    NotStarted,
    SerialPort,
    TcpPort,
    WriteUnconfirmed,
)
from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.counters import LineState
from busmaster.arbiter.events import LineChange, LineChanged, Overdue
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.transaction import Transaction
from busmaster.bus.node import Node
from busmaster.contract.tap import Attempt
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryTransport
from busmaster.emulator.serve import serve_pty
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import make_device
from busmaster.testing.virtual_time import run_in_virtual_time
from busmaster.transport import pump as pump_module
from busmaster.transport.alarm import Alarm
from busmaster.transport.kernel import OpenPort
from busmaster.transport.pump import STUCK_AFTER, Pump
from tests.arbiter.bench import TAU
from tests.transport.fakes import PtyMaster, plugged, standing_still
from tests.transport.test_marks import reply

WINDOW = hcp2.PROFILE.timings.read.window
MAX_REPLY_DELAY = hcp2.PROFILE.timings.read.max_reply_delay


def line(delay: float = 0.002) -> Line:
    devices = [make_device("hcp2", address, delay=Delay(delay)) for address in (1, 2)]
    return Line(hcp2.PROFILE.line, devices, paced=True, chance=Random(1))


def transport_of(bus: Bus) -> MemoryTransport:
    transport = bus._pump._transport
    assert isinstance(transport, MemoryTransport)
    return transport


# -- what the pump tells ---------------------------------------------------------------------------------------------


class Ledger:
    """Notes what happens in which order; stands for the port, the arbiter and the tap."""

    def __init__(self) -> None:
        self.time = 0.0
        self.notes: list[tuple[Any, ...]] = []
        self.has = 0
        self.is_due = False
        self.is_over = False
        self.due = inf
        self.events: list[object] = []
        self.causes: list[str] = []

    # the port

    def write(self, data: bytes) -> None:
        self.time += 0.3  # as if the process stood still on the way
        self.notes.append(("written", data))

    def get_extra_info(self, _name: str, default: Any = None) -> Any:
        return default

    def get_write_buffer_size(self) -> int:
        return self.has

    def discard_unsent(self) -> None:
        self.notes.append(("discarded",))

    def abort(self) -> None:
        self.notes.append(("aborted",))

    # the arbiter

    out: bytes | None = None
    state: LineState | None = None

    def poll_transmit(self) -> bytes | None:
        data, self.out = self.out, None
        return data

    def poll_event(self) -> object:
        return self.events.pop() if self.events else None

    def poll_timeout(self) -> float:
        return self.due

    def line_up(self, now: float, *, paced: bool) -> None: ...

    def line_down(self, cause: str, _now: float) -> None:
        self.causes.append(cause)

    def line_due(self, _now: float) -> bool:
        return self.is_due

    def answer_counts(self, _now: float) -> bool:
        return self.is_over

    def unsent(self, count: int, now: float) -> None:
        self.notes.append(("unsent", count, now))

    def handle_timeout(self, now: float, *, unread: bool) -> None:
        self.notes.append(("timeout", now, unread))

    # the tap

    def attempted(self, attempt: Attempt) -> None:
        self.notes.append(("attempted", attempt))

    # both

    attempt = None

    def transmitted(self, now: float, data: bytes | None = None, _attempt: object = None, /) -> None:
        self.notes.append(("transmitted", now) if data is None else ("tapped", now, data))


@pytest.fixture
def ledger() -> Ledger:
    return Ledger()


def pump_on(ledger: Any) -> Pump:
    pump = Pump(ledger, on_sample=lambda _, __: None, on_cycle=lambda _: None, on_event=lambda _: None)
    pump.tap = ledger
    pump.clock = lambda: ledger.time
    pump.connection_made(ledger)
    return pump


def test_a_request_counts_as_sent_when_the_write_has_returned(ledger: Ledger) -> None:
    pump = pump_on(ledger)
    ledger.out = b"05\x05"
    pump.turn()
    assert ledger.notes == [("written", b"05\x05"), ("transmitted", 0.3), ("tapped", 0.3, b"05\x05")]


@pytest.mark.parametrize("tapped", [True, False])
def test_a_tap_is_told_of_each_finished_attempt(ledger: Ledger, tapped: bool) -> None:
    pump = pump_on(ledger)
    attempt = Attempt("hcp2", 1, hcp2.Read(1), hcp2.PROFILE.timings)
    assert attempt.number == 1
    ledger.events.append(attempt)
    if not tapped:
        pump.tap = None
    pump.turn()
    assert ledger.notes == [("attempted", attempt)] * tapped


def test_what_has_not_left_is_asked_for_only_when_a_deadline_of_the_line_is_due(ledger: Ledger) -> None:
    pump = pump_on(ledger)
    pump._on_time()
    ledger.is_due, ledger.has = True, 2
    pump._on_time()
    ledger.has = 0
    pump._on_time()
    timeout = ("timeout", 0.0, False)
    assert ledger.notes == [timeout, ("unsent", 2, 0.0), timeout, ("unsent", 0, 0.0), timeout]


def test_what_has_left_when_a_hold_begins_is_not_asked_for_when_it_is_over(ledger: Ledger) -> None:
    pump = pump_on(ledger)
    for held in (0, 2, 0):
        ledger.out, ledger.state, ledger.has, ledger.is_due = b"05\x05", None, 0, False
        pump.turn()
        ledger.state, ledger.has, ledger.due = LineState.HOLDOFF, held, ledger.time + 1.0
        pump.turn()
        ledger.notes.clear()
        ledger.time, ledger.is_due, ledger.due = ledger.time + 1.0, True, inf
        pump._on_time()
        asked = [("unsent", held, ledger.time)] * (held > 0)
        assert ledger.notes == [*asked, ("timeout", ledger.time, False)]


def test_during_an_exchange_the_port_is_not_asked_before_a_deadline(ledger: Ledger) -> None:
    pump = pump_on(ledger)
    ledger.out = b"05\x05"
    pump.turn()
    ledger.state, ledger.due = LineState.EXCHANGE, ledger.time + 1.0
    pump.turn()
    ledger.notes.clear()
    ledger.is_due, ledger.due = True, inf
    pump._on_time()
    assert ledger.notes == [("unsent", 0, ledger.time), ("timeout", ledger.time, False)]


def test_a_port_that_is_gone_is_not_asked(ledger: Ledger) -> None:
    pump = pump_on(ledger)
    pump._alarm = cast("Alarm", SimpleNamespace(set=lambda due: ledger.notes.append(("set", due))))
    ledger.out = b"05\x05"
    pump.turn()
    ledger.notes.clear()
    ledger.state, ledger.due = LineState.HOLDOFF, ledger.time + 1.0
    pump.connection_lost(None)
    assert ledger.notes == [("set", ledger.due)]


def test_what_lies_unread_is_looked_for_when_a_callers_time_is_over(ledger: Ledger) -> None:
    pump = pump_on(ledger)
    assert pump._port is not None
    pump._port.unread = lambda: True  # type: ignore[method-assign]  # something does
    pump._on_time()
    ledger.is_over = True
    pump._on_time()
    assert ledger.notes == [("timeout", 0.0, False), ("unsent", 0, 0.0), ("timeout", 0.0, True)]


def test_a_write_that_the_port_did_not_take_is_told_at_once_and_so_is_its_leaving(ledger: Ledger) -> None:
    pump = pump_on(ledger)
    ledger.out, ledger.has = b"05\x05", 3
    pump.pause_writing()
    pump.turn()
    ledger.has, ledger.time = 0, 1.0
    pump.resume_writing()
    assert ledger.notes[1:] == [
        ("transmitted", 0.3),
        ("tapped", 0.3, b"05\x05"),
        ("unsent", 3, 0.3),
        ("unsent", 0, 1.0),
    ]


def test_a_port_that_takes_bytes_again_is_not_queried_after_each_write(ledger: Ledger) -> None:
    pump = pump_on(ledger)
    pump.pause_writing()
    pump.resume_writing()
    ledger.notes.clear()
    ledger.out = b"05\x05"
    pump.turn()
    assert [note[0] for note in ledger.notes] == ["written", "transmitted", "tapped"]


@pytest.mark.asyncio
async def test_a_caller_that_is_cancelled_as_its_time_ends_gets_no_second_error(ledger: Ledger) -> None:
    pump = pump_on(ledger)
    node = NodeRecord(hcp2.PROFILE, 1, hcp2.PROFILE.timings, 2)
    cancelled = asyncio.get_running_loop().create_future()
    cancelled.cancel()
    for waiter in (cancelled, None):
        ledger.events.append(Overdue(Transaction(node, hcp2.Read(1), tag=waiter), NoReply("no reply")))
    pump.turn()
    assert ledger.events == []


def test_a_deadline_that_a_look_at_the_port_has_brought_forward_is_kept(ledger: Ledger) -> None:
    pump, alarms = pump_on(ledger), list[float]()
    pump._alarm = cast("Alarm", SimpleNamespace(set=alarms.append))
    for due in (5.0, 2.0, 3.0):
        ledger.due = due
        pump._look_again()
    assert alarms == [5.0, 2.0], "a later one needs no alarm: the earlier one asks again"


def test_output_that_is_given_up_is_discarded_before_its_transport_is_aborted(ledger: Ledger) -> None:
    pump = pump_on(ledger)
    assert pump._port is not None
    pump._port.discard_unsent = ledger.discard_unsent  # type: ignore[method-assign]  # it is noted
    ledger.is_due, ledger.has = True, 2
    pump._on_time()
    ledger.time = STUCK_AFTER - 0.1
    pump._on_time()
    assert ("aborted",) not in ledger.notes
    ledger.time = STUCK_AFTER
    pump._on_time()
    assert ledger.notes[-3:] == [("discarded",), ("aborted",), ("timeout", STUCK_AFTER, False)]


def test_a_port_that_comes_back_may_hold_its_output_as_long_as_the_one_before(ledger: Ledger) -> None:
    pump = pump_on(ledger)
    ledger.is_due, ledger.has = True, 2
    pump._on_time()
    pump.connection_lost(None)
    ledger.time = STUCK_AFTER
    pump.connection_made(ledger)  # type: ignore[arg-type]  # it stands for the port
    pump._on_time()
    assert ("aborted",) not in ledger.notes
    ledger.time = 2 * STUCK_AFTER
    pump._on_time()
    assert ("aborted",) in ledger.notes


def test_each_loss_has_its_own_cause_and_a_port_that_comes_back_holds_nothing(ledger: Ledger) -> None:
    pump = pump_on(ledger)
    ledger.has, ledger.is_due = 2, True
    pump.pause_writing()
    pump._on_time()
    ledger.time = STUCK_AFTER
    pump._on_time()
    pump.connection_lost(None)
    ledger.has, ledger.is_due = 0, False
    pump.connection_made(ledger)  # type: ignore[arg-type]  # it stands for the port
    ledger.notes.clear()
    ledger.out = b"05\x05"
    pump.turn()
    assert [note[0] for note in ledger.notes] == ["written", "transmitted", "tapped"]
    pump.connection_lost(OSError(5, "Input/output error"))
    assert ledger.causes == [
        "no byte has left the port for 5 s: the port does not take it; open it again",
        "Input/output error",
    ]


async def in_sync(axis: Hcp2Controller) -> None:
    """Return when nothing is left of earlier requests, so that the next one goes at once."""
    await axis.read(1)
    await asyncio.sleep(1.0)


# -- a port that holds its output ------------------------------------------------------------------------------------


@pytest.mark.parametrize("held", [0.005, 0.090, 0.140, 0.4, 2.0])
def test_a_request_held_back_is_waited_for_and_nothing_else_is_sent_meanwhile(held: float) -> None:
    async def main() -> None:
        async with Bus(MemoryPort(line(0.090))) as bus:
            first, second = Hcp2Controller(bus, 1), Hcp2Controller(bus, 2)
            await first.write(1, 11)
            await second.write(1, 22)
            transport_of(bus).hold()
            began = bus.now()
            reading = asyncio.gather(first.read(1, retries=0), second.read(1, retries=0))
            await asyncio.sleep(held)
            request = hcp2.Read(1).open(1, Node.of(first).timings).request
            assert transport_of(bus).get_write_buffer_size() == len(request)
            transport_of(bus).release()
            assert tuple(await reading) == (11, 22)
            assert held + 0.18 < bus.now() - began < held + 0.3
            assert Node.of(first).statistics().no_reply == 0

    run_in_virtual_time(main())


def test_the_wait_for_a_reply_runs_from_when_the_request_has_left() -> None:
    async def main() -> None:
        async with Bus(MemoryPort(line())) as bus:
            absent = Hcp2Controller(bus, 9)
            await Hcp2Controller(bus, 1).read(1)
            transport_of(bus).hold()
            began = bus.now()
            reading = asyncio.ensure_future(absent.read(1, retries=0))
            await asyncio.sleep(0.3)
            assert not reading.done()
            transport_of(bus).release()
            with pytest.raises(NoReply):
                await reading
            assert bus.now() - began == pytest.approx(0.3 + MAX_REPLY_DELAY, abs=0.01)

    run_in_virtual_time(main())


class Driver:
    """What the driver of a port says that it still holds; unlike a transport, it tells nobody when that has left."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, flow_controlled: bool) -> None:
        self.holds = 0
        monkeypatch.setattr(OpenPort, "unsent", lambda _port, _waited: self.holds)
        monkeypatch.setattr(OpenPort, "flow_controlled", flow_controlled)

    async def awaited(self, bus: Bus, emulated: Line, *, held: float) -> float:
        """Have a request held for so long, and its reply be lost. Returns how long its caller waited then."""
        axis, device = Hcp2Controller(bus, 1), emulated.devices[0]
        await axis.read(1)
        device.faults.lost = 1.0
        self.holds = 8
        reading = asyncio.ensure_future(axis.read(1, retries=0))
        await asyncio.sleep(held)
        self.holds = 0
        released = bus.now()
        with pytest.raises(NoReply):
            await reading
        device.faults.lost = 0.0
        return bus.now() - released


def test_r2_output_let_go_within_its_window_is_noticed_on_a_port_that_was_found_holding_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver, emulated = Driver(monkeypatch, flow_controlled=False), line()

    async def main() -> None:
        async with Bus(MemoryPort(emulated)) as bus:
            unseen = await driver.awaited(bus, emulated, held=0.5 * WINDOW)
            assert unseen == pytest.approx(MAX_REPLY_DELAY - 0.5 * WINDOW, abs=0.01), (
                "a port that never held is not asked"
            )
            for held in (2 * WINDOW, 0.5 * WINDOW):
                assert await driver.awaited(bus, emulated, held=held) == pytest.approx(MAX_REPLY_DELAY, abs=0.01)
            transport_of(bus).abort()
            await asyncio.sleep(3.0)
            waited = await driver.awaited(bus, emulated, held=0.5 * WINDOW)
            assert waited == pytest.approx(MAX_REPLY_DELAY, abs=0.01), "it is the same device that is opened again"

    run_in_virtual_time(main())


def test_r2_output_let_go_within_its_window_is_noticed_on_a_port_with_flow_control(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver, emulated = Driver(monkeypatch, flow_controlled=True), line()

    async def main() -> None:
        async with Bus(MemoryPort(emulated)) as bus:
            assert await driver.awaited(bus, emulated, held=0.5 * WINDOW) == pytest.approx(MAX_REPLY_DELAY, abs=0.01)

    run_in_virtual_time(main())


def test_output_that_never_leaves_takes_the_line_down_and_is_discarded() -> None:
    async def main() -> None:
        emulated = line()
        async with Bus(MemoryPort(emulated)) as bus:
            axis = Hcp2Controller(bus, 1)
            await axis.write(1, 5)
            events = bus.events()
            transport_of(bus).hold()
            began = bus.now()
            with pytest.raises(WriteUnconfirmed, match=r"no byte has left the emulated line for 5 s: the port"):
                await axis.write(1, 6)
            assert STUCK_AFTER < bus.now() - began < STUCK_AFTER + 0.2
            changes = [await anext(events) for _ in range(2)]
            assert [change.change for change in changes if isinstance(change, LineChanged)] == [
                LineChange.DOWN,
                LineChange.UP,
            ]
            assert await axis.read(1) == 5

    run_in_virtual_time(main())


def test_output_is_held_anew_where_the_port_was_lost_meanwhile() -> None:
    """Twice 3 s on two connections are not 5 s on one."""

    async def main() -> None:
        async with Bus(MemoryPort(line())) as bus:
            axis = Hcp2Controller(bus, 1)
            await axis.write(1, 5)
            events = bus.events()
            transport_of(bus).hold()
            reading = asyncio.ensure_future(axis.read(1))
            await asyncio.sleep(3.0)
            transport_of(bus).lose(None)
            changes = [await anext(events) for _ in range(2)]
            assert [change.change for change in changes if isinstance(change, LineChanged)][-1] is LineChange.UP
            await asyncio.gather(reading, return_exceptions=True)
            transport_of(bus).hold()
            reading = asyncio.ensure_future(axis.read(1))
            await asyncio.sleep(3.0)
            transport_of(bus).release()
            assert await reading == 5

    run_in_virtual_time(main())


@pytest.mark.parametrize("held", [0.01, 0.5])
def test_closing_does_not_wait_for_output_that_is_held_and_says_that_it_was(held: float) -> None:
    async def main(request: Callable[[Hcp2Controller], Awaitable[object]], error: type[BusError], hint: str) -> None:
        async with Bus(MemoryPort(line())) as bus:
            axis = Hcp2Controller(bus, 1)
            await in_sync(axis)
            transport_of(bus).hold()
            waiting = asyncio.ensure_future(request(axis))
            await asyncio.sleep(held)
            began = bus.now()
        assert bus.now() - began < WINDOW + MAX_REPLY_DELAY
        with pytest.raises(error) as caught:
            await waiting
        assert caught.value.what == "the port had not sent it when the bus was closed"
        assert caught.value.hint.startswith(hint)

    run_in_virtual_time(main(lambda axis: axis.write(1, 6), WriteUnconfirmed, "read the value back"))
    run_in_virtual_time(main(lambda axis: axis.read(1, retries=0), NoReply, "flow control holds the port"))


def test_on_a_bus_that_closes_a_reply_to_what_has_just_left_still_counts() -> None:
    async def main() -> None:
        async with Bus(MemoryPort(line())) as bus:
            axis = Hcp2Controller(bus, 1)
            await axis.write(1, 6)
            await in_sync(axis)
            transport_of(bus).hold()
            reading = asyncio.ensure_future(axis.read(1))
            await asyncio.sleep(0.05)
            asyncio.get_running_loop().call_later(0.0001, transport_of(bus).release)
        assert await reading == 6

    run_in_virtual_time(main())


@pytest.mark.parametrize("time", [0.03, 0.5])  # within the reply window, in which nobody asks the port, and after it
def test_whoever_runs_out_of_time_while_the_port_holds_output_is_told_so(time: float) -> None:
    async def failed(waiting: Awaitable[object]) -> tuple[type[BaseException], str, str]:
        with pytest.raises(BusError) as caught:
            await waiting
        return caught.type, caught.value.what, caught.value.hint.partition(":")[0].partition(";")[0]

    async def main() -> None:
        async with Bus(MemoryPort(line())) as bus:
            axis = Hcp2Controller(bus, 1)
            await in_sync(axis)
            for request, kind, hint in (
                (axis.write, WriteUnconfirmed, "read the value back before you write again"),
                (axis.read, NoReply, "flow control holds the port or the adapter is stuck"),
            ):
                transport_of(bus).hold()
                arguments = (1, 6) if kind is WriteUnconfirmed else (1,)
                first = asyncio.ensure_future(request(*arguments, finish_within=time))
                await asyncio.sleep(0)
                second = asyncio.ensure_future(axis.read(2, finish_within=time))
                milliseconds = f"{time * 1000:.0f} ms"
                assert await failed(first) == (kind, f"the port did not send it within its time: {milliseconds}", hint)
                told = await failed(second)
                assert told[:2] == (NotStarted, f"not sent within its time: it waited {milliseconds} for the line")
                assert told[2] == "flow control holds the port or the adapter is stuck"
                transport_of(bus).release()
                await in_sync(axis)
            late = asyncio.ensure_future(axis.read(1, finish_within=0.001))
            assert (await failed(late))[1] == "sent, but not answered within its time: 1 ms"

    run_in_virtual_time(main())

    run_in_virtual_time(main())


# -- on real ports ---------------------------------------------------------------------------------------------------


@pytest.fixture
def pty_master() -> Iterator[PtyMaster]:
    with plugged() as end:
        yield end


@pytest.mark.asyncio
async def test_a_tty_stopped_for_longer_than_any_window_delays_its_replies_and_mixes_none(
    pty_master: PtyMaster,
) -> None:
    async def said() -> bytes:
        while not (data := await asyncio.to_thread(pty_master.read, 0.05)):
            pass
        return data

    # Longer than the document's: the test itself has to reply within them, also on a busy machine.
    read = replace(hcp2.PROFILE.timings.read, window=0.4, max_reply_delay=0.45)
    async with Bus(SerialPort(pty_master.path, baudrate=57600)) as bus:
        axis = Hcp2Controller(bus, 1, timings=replace(hcp2.PROFILE.timings, read=read))
        transport: Any = bus._pump._transport
        termios.tcflow(transport._fd, termios.TCOOFF)
        readings = [asyncio.ensure_future(axis.read(1, retries=0)) for _ in range(3)]
        while transport.get_write_buffer_size() == 0:  # noqa: ASYNC110  # the line resynchronises first
            await asyncio.sleep(0.001)
        requested = transport.get_write_buffer_size()
        await asyncio.sleep(read.max_reply_delay + read.window)
        assert transport.get_write_buffer_size() == requested
        termios.tcflow(transport._fd, termios.TCOON)
        for value in (1, 2, 3):
            assert len(await said()) == requested
            pty_master.write(reply(value))
        assert await asyncio.gather(*readings) == [1, 2, 3]


@pytest.mark.asyncio
async def test_a_tty_stopped_for_good_takes_the_line_down_in_words(
    pty_master: PtyMaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pump_module, "STUCK_AFTER", 0.1)
    async with Bus(SerialPort(pty_master.path, baudrate=57600)) as bus:
        axis = Hcp2Controller(bus, 1)
        transport: Any = bus._pump._transport
        termios.tcflow(transport._fd, termios.TCOOFF)
        with pytest.raises(
            LineDown,
            match=f"no byte has left {pty_master.path} for 0.1 s: flow control holds it or the adapter is stuck; "
            "check CTS, replug",
        ):
            await axis.read(1, retries=0)
        while bus._pump._transport in (None, transport):  # noqa: ASYNC110  # reopened by itself
            await asyncio.sleep(0.001)
        assert pty_master.read(patience=0.01) == b""


@pytest.mark.asyncio
async def test_a_write_that_a_stopped_tty_never_sent_is_unconfirmed_and_says_so_when_the_bus_is_left() -> None:
    with serve_pty(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)], paced=False)) as server:
        port = SerialPort(server.path, baudrate=57600)
        async with Bus(port) as bus:
            axis = Hcp2Controller(bus, 1)
            await axis.write(1, 5)
            transport: Any = bus._pump._transport
            termios.tcflow(transport._fd, termios.TCOOFF)
            writing = asyncio.ensure_future(axis.write(1, 6))
            while transport.get_write_buffer_size() == 0:  # noqa: ASYNC110  # nothing tells
                await asyncio.sleep(0.001)
        with pytest.raises(WriteUnconfirmed, match="the port had not sent it when the bus was closed, 1 attempt"):
            await writing
        async with Bus(port) as bus:
            transport = bus._pump._transport
            termios.tcflow(transport._fd, termios.TCOON)
            assert await Hcp2Controller(bus, 1).read(1) == 5


class Server:
    """A serial server and the node behind it: each request of the same length is answered by a count."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.setblocking(False)
        self.port = self.listener.getsockname()[1]
        self.connection = socket.socket()

    async def answer(self) -> None:
        loop = asyncio.get_running_loop()
        self.connection.close()
        self.connection, _ = await loop.sock_accept(self.listener)
        value = 0
        while data := await loop.sock_recv(self.connection, 100):
            for _ in range(data.count(b"\x05")):
                value += 1
                await loop.sock_sendall(self.connection, reply(value))


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.connection.close()
    made.listener.close()


@pytest.mark.asyncio
async def test_a_network_that_stands_still_delays_its_replies_and_mixes_none(server: Server) -> None:
    serving = asyncio.ensure_future(server.answer())
    async with Bus(TcpPort("127.0.0.1", server.port, baudrate=57600)) as bus:
        axis = Hcp2Controller(bus, 1)
        assert [await axis.read(1) for _ in range(3)] == [1, 2, 3]
        with standing_still(server.connection):
            readings = [asyncio.ensure_future(axis.read(1, retries=0)) for _ in range(3)]
            await asyncio.sleep(MAX_REPLY_DELAY + 2 * WINDOW)
        assert await asyncio.gather(*readings) == [4, 5, 6]
    serving.cancel()


@pytest.mark.asyncio
async def test_a_network_that_stands_still_for_good_takes_the_line_down_in_words(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pump_module, "STUCK_AFTER", 0.1)
    serving = asyncio.ensure_future(server.answer())
    async with Bus(TcpPort("127.0.0.1", server.port, baudrate=57600)) as bus:
        axis = Hcp2Controller(bus, 1)
        assert await axis.read(1) == 1
        with (
            standing_still(server.connection),
            pytest.raises(LineDown, match=f"no byte has left 127.0.0.1:{server.port} for 0.1 s: the network or the s"),
        ):
            await axis.read(1, retries=0)
    serving.cancel()


@pytest.mark.parametrize(
    ("cause", "said"),
    [
        (None, "it was closed"),
        (OSError("gone"), "gone"),
        (OSError(), "OSError"),
        (OSError(5, "Input/output error"), "Input/output error"),
        (LineDown("the adapter is gone"), "the adapter is gone"),
    ],
)
def test_a_lost_port_is_told_with_its_cause(cause: Exception | None, said: str) -> None:
    async def story() -> None:
        events: list[Any] = []
        arbiter = Arbiter(TAU)
        pump = Pump(arbiter, on_sample=lambda *_: None, on_cycle=lambda _: None, on_event=events.append)
        pump.clock = asyncio.get_running_loop().time
        arbiter.line_up(pump.clock())
        pump.connection_lost(cause)
        downs = [event for event in events if isinstance(event, LineChanged) and event.change is LineChange.DOWN]
        assert [event.cause for event in downs] == [said]

    run_in_virtual_time(story())
