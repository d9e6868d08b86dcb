"""asyncio meets the arbiter: bytes and time in, bytes and events out.

The hot path: a reply arrives, the arbiter completes it and encodes the next request, and that request is written
in the same callback. Only then are those told who wait. No task runs between a reply and the next request, and no
user code runs in here.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from math import inf
from typing import Any, Protocol, cast

import anyio

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.counters import DriverErrors, LineState, Mark
from busmaster.arbiter.events import Event, Overdue, Polled, Sampled
from busmaster.arbiter.tap import Attempt, Tap
from busmaster.arbiter.transaction import Poll, Transaction
from busmaster.errors import BusError, cause_text
from busmaster.transport.alarm import Alarm
from busmaster.transport.clock import clock_of
from busmaster.transport.kernel import OpenPort, open_port

STUCK_AFTER = 5.0
"""Seconds after which output that has not left is discarded with its connection. Flow control, a busy adapter and a
network that lost a segment let go within one or two; whatever holds it longer does not fix by itself, and a request
that old may move a machine when nobody expects it any more."""


class Waiter(Protocol):
    """Who waits for what becomes of a transaction: a future, or what has more haste, is told at once, and is the
    library's own. Nothing of it may raise, or ask anything of the line.
    """

    def done(self) -> bool:
        """Return whether it was told already, or waits no longer."""
        ...

    def set_result(self, value: Any, /) -> None: ...

    def set_exception(self, error: BusError, /) -> None: ...


class Pump(asyncio.Protocol):
    """Owns the arbiter of one line. `on_sample`, `on_cycle` and `on_event` are the library's own and return at once.

    `name` is how errors call the port.
    """

    def __init__(
        self,
        arbiter: Arbiter,
        *,
        on_sample: Callable[[Poll, Transaction], None],
        on_cycle: Callable[[Poll], None],
        on_event: Callable[[Event], None],
        on_written: Callable[[Transaction, float], None] = lambda *_: None,
        paced: Callable[[asyncio.BaseTransport], bool] = lambda _: False,
        name: str = "the port",
    ) -> None:
        self.arbiter = arbiter
        self.clock: Callable[[], float] = time.monotonic
        self.tap: Tap | None = None
        """Who hears every byte; the arbiter is to be tapped while there is one."""
        self._on_sample = on_sample
        self._on_cycle = on_cycle
        self._on_event = on_event
        self._on_written = on_written
        self._paced = paced
        self._loop: asyncio.AbstractEventLoop | None = None
        self._transport: asyncio.Transport | None = None
        self._name = name
        self._port: OpenPort | None = None
        self._written = -inf
        self._all_has_left = False
        """The port was asked already: it holds nothing of what was written."""
        self._paused = False
        self._may_hold = False
        self._look: asyncio.TimerHandle | None = None
        self._held_since = inf
        self._gave_up = ""
        self._alarm: Alarm | None = None
        self._armed = inf
        self._run_out: anyio.Event | None = None

    def bind(self, loop: asyncio.AbstractEventLoop) -> None:
        """Keep this loop's time."""
        self._loop = loop
        self.clock = clock_of(loop)
        self._alarm = Alarm(loop, self._on_time)

    # what the bus calls

    def begin(self, transaction: Transaction, waiter: Waiter | None) -> None:
        """Submit a transaction; `waiter` gets its value or its error, perhaps before this returns.

        Without a waiter, the transaction's tag becomes a future, which gets them.
        """
        assert self._loop is not None
        transaction.tag = self._loop.create_future() if waiter is None else waiter
        # A request that only waits changes nothing that is to be sent, reported or timed.
        if self.arbiter.submit(transaction, self.clock()):
            self.turn()

    def cancel(self, transaction: Transaction) -> None:
        """Cancel a transaction, at the time it is now."""
        self.arbiter.cancel(transaction, self.clock())

    def turn(self) -> None:
        """Send what is to be sent, tell what has happened, and arm the one timer."""
        arbiter = self.arbiter
        data = arbiter.poll_transmit()
        if data is not None and self._transport is not None:
            self._transport.write(data)
            self._all_has_left = False
            self._written = now = self.clock()  # again: the process may have stood still before it got here
            arbiter.transmitted(now)
            if self.tap is not None:
                self.tap.transmitted(now, data, arbiter.attempt)
            if self._may_hold:
                self._look_after(now)
        event = arbiter.poll_event()
        while event is not None:
            if type(event) is Transaction:
                if event.writes and event.attempts:
                    self._on_written(event, event.ended_at)  # before its caller wakes: no snapshot slips in between
                waiter = event.tag
                if waiter is None or waiter.done():
                    pass  # nobody waits for it any more
                elif event.error is None:
                    waiter.set_result(event.value)
                else:
                    waiter.set_exception(event.error)
            elif type(event) is Sampled:
                self._on_sample(event.poll, event.transaction)
            elif type(event) is Polled:
                self._on_cycle(event.poll)
            elif type(event) is Overdue:
                self._give_up_on(event)
            elif type(event) is Attempt:
                if self.tap is not None:
                    self.tap.attempted(event)
            else:
                self._on_event(event)
            event = arbiter.poll_event() if arbiter.events else None  # a call less on the way of a reply
        due = arbiter.poll_timeout()
        # An alarm that rings too early changes nothing, so one is never moved to a later time.
        if due < self._armed:
            self._arm(due)
        if self._run_out is not None and not self._runs():
            self._run_out.set()

    async def run_out(self) -> None:
        """Return when nothing is on the wire, within one exchange, and whoever waited has been told."""
        if self._runs():
            self._run_out = anyio.Event()
            await self._run_out.wait()

    def driver_errors(self) -> DriverErrors | None:
        """Return what the driver of the port that is open has counted: the arbiter does not know of it."""
        return None if self._port is None else self._port.errors()

    def reset_driver_errors(self) -> None:
        """Start the counts of the driver of the port again, if one is open."""
        if self._port is not None:
            self._port.reset()

    def stop(self) -> None:
        """Stop the timer: the bus is closed. Whoever still waits is told now, where nobody saw `run_out` through."""
        while self.arbiter.failing:  # a few at a time: a thousand callers told in one turn held the loop for 5 ms
            self.arbiter.handle_timeout(self.clock())
            self.turn()
        if self._alarm is not None:
            self._alarm.close()
            self._alarm = None
        if self._look is not None:
            self._look.cancel()
        self._loop = None

    # what asyncio calls

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self._port = open_port(self._transport)
        self._may_hold = self._may_hold or self._port.flow_controlled
        self._paused = self._all_has_left = False
        self._held_since = inf
        self.arbiter.line_up(self.clock(), paced=self._paced(transport))
        self.turn()

    def data_received(self, data: bytes) -> None:
        now = self.clock()
        if self.tap is not None:
            self.tap.received(now, data, self.arbiter.attempt)
        if self._held_since < inf:  # what was held may have left since: only then can this be its answer
            self._check_output(now)
        self.arbiter.data_received(data, now)
        self.turn()

    def byte_marked(self, byte: bytes, mark: Mark) -> None:
        """Take a byte that the UART found damaged; none where a serial server reports the error apart from its byte."""
        now = self.clock()
        if mark is Mark.BREAK and self._port is not None and not self._port.is_break():
            mark = Mark.DAMAGED
        if self.tap is not None and byte:
            self.tap.received(now, byte, self.arbiter.attempt)
        self.arbiter.byte_marked(mark, now)
        self.turn()

    def pause_writing(self) -> None:
        """Note that the transport could not hand over all that was written: nothing runs out until it has."""
        self._paused = self._may_hold = True

    def resume_writing(self) -> None:
        """Note that the transport has handed over what was written."""
        self._paused = False
        self._look_again()

    def connection_lost(self, cause: Exception | None) -> None:
        self._transport = None
        self._port = None
        what = self._gave_up or cause_text(cause, "it was closed")
        self._gave_up = ""
        self.arbiter.line_down(what, self.clock())
        self.turn()

    # inside

    def _runs(self) -> bool:
        return self.arbiter.state is LineState.EXCHANGE or self.arbiter.failing

    def _give_up_on(self, late: Overdue) -> None:
        """Let its caller go and keep the exchange: a write on the wire is over before anything else can be read."""
        transaction = late.transaction
        if transaction.writes:
            self._on_written(transaction, self.clock())
        waiter = transaction.tag
        if waiter is not None and not waiter.done():
            waiter.set_exception(late.error)

    def _arm(self, due: float) -> None:
        if self._alarm is not None:
            self._armed = due
            self._alarm.set(due)
        if self.arbiter.state is LineState.HOLDOFF and self._port is not None and not self._all_has_left:
            # It would be asked when the hold is over, when the next request waits for that. `inf`: nothing may be under
            # way either, however short a time ago it was said, or it is asked again then.
            self._all_has_left = self._port.unsent(inf) == 0

    def _on_time(self) -> None:
        self._armed = inf
        now = self.clock()
        unread = False
        if self._port is not None:
            # The kernel is asked only now, and before anything runs out: a blocked loop may run timers before it reads.
            line_due = self.arbiter.line_due(now)
            caller_due = self.arbiter.answer_counts(now)
            if line_due or caller_due:
                unread = self._port.unread()
            if (line_due or caller_due) and not self._all_has_left:
                self._check_output(now)  # report held output before a request expires
        self.arbiter.handle_timeout(now, unread=unread)
        self.turn()

    def _look_after(self, now: float) -> None:
        """See to it that what a port holds is noticed, be it let go before a deadline: it is asked when what was said
        just now should have left."""
        if self._paused:
            self._check_output(now)
        elif self._loop is not None:
            if self._look is not None:
                self._look.cancel()
            self._look = self._loop.call_later(self.arbiter.said_until - now, self._look_again)

    def _look_again(self) -> None:
        self._check_output(self.clock())
        due = self.arbiter.poll_timeout()
        if due < self._armed:
            self._arm(due)

    def _check_output(self, now: float) -> None:
        """Tell the arbiter how much has not left yet, and give the port up where that is so for too long."""
        if self._port is None:
            return
        count = self._port.unsent(now - self._written)
        if count is None:
            return
        self.arbiter.unsent(count, now)
        if not count:
            self._held_since = inf
        elif self._held_since == inf:
            self._held_since = now
            self._may_hold = True
        elif now - self._held_since >= STUCK_AFTER:
            self._give_up(self._port)

    def _give_up(self, port: OpenPort) -> None:
        """Take the line down, and with it what has not left. The port is opened again as after any loss."""
        self._gave_up = f"nothing has left {self._name} for {STUCK_AFTER:g} s: {port.stuck_because}"
        self._port = None
        port.discard_unsent()  # before the abort, which would leave it to the kernel to send on
        if self._transport is not None:
            self._transport.abort()
