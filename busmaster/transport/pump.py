"""Connects asyncio to the arbiter: passes bytes and time in, and bytes and events out.

The hot path: a reply arrives, the arbiter completes it and encodes the next request, and that request is written in the
same callback. Only then are the callers notified. No task runs between a reply and the next request, and no user code
runs in this module.
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
from busmaster.arbiter.transaction import Poll, Transaction
from busmaster.contract.tap import Attempt, Tap
from busmaster.errors import BusError
from busmaster.transport.alarm import Alarm
from busmaster.transport.clock import clock_of
from busmaster.transport.kernel import OpenPort, cause_text, open_port

STUCK_AFTER = 5.0
"""Seconds after which unsent output is discarded together with its connection. Flow control, a busy adapter or a lost
TCP segment block for one or two seconds. A longer block does not resolve itself, and a request that old could move a
machine unexpectedly."""


class Waiter(Protocol):
    """Receives the result of a transaction immediately: a future or an internal object. It must not raise or use the
    line."""

    def done(self) -> bool:
        """Return True if it has its result, or no longer waits."""
        ...

    def set_result(self, value: Any, /) -> None: ...

    def set_exception(self, error: BusError, /) -> None: ...


class Pump(asyncio.Protocol):
    """Owns the arbiter of one line. `on_sample`, `on_cycle` and `on_event` are internal and return immediately.

    `name` is the port's name in errors.
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
        """Receives every byte. The arbiter must be tapped while this is set."""
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
        """The port has already reported that it holds no written byte."""
        self._paused = False
        self._may_hold = False
        self._look: asyncio.TimerHandle | None = None
        self._held_since = inf
        self._gave_up = ""
        self._alarm: Alarm | None = None
        self._armed = inf
        self._run_out: anyio.Event | None = None

    def bind(self, loop: asyncio.AbstractEventLoop) -> None:
        """Use the clock and the timers of this loop."""
        self._loop = loop
        self.clock = clock_of(loop)
        self._alarm = Alarm(loop, self._on_time)

    # what the bus calls

    def begin(self, transaction: Transaction, waiter: Waiter | None) -> None:
        """Submit a transaction; `waiter` gets its value or its error, possibly before this returns.

        Without a waiter, the transaction's tag becomes a future for them.
        """
        assert self._loop is not None
        # An internal waiter needs no future: its result is set without a turn of the loop.
        transaction.tag = self._loop.create_future() if waiter is None else waiter
        # A request that was only queued changes nothing that must be sent, reported or timed.
        if self.arbiter.submit(transaction, self.clock()):
            self.turn()

    def cancel(self, transaction: Transaction) -> None:
        """Cancel a transaction, at the time it is now."""
        self.arbiter.cancel(transaction, self.clock())

    def turn(self) -> None:
        """Send pending output, report events, and set the timer."""
        arbiter = self.arbiter
        data = arbiter.poll_transmit()
        if data is not None and self._transport is not None:
            # R2: reply windows count from the time at which the port has the bytes, so the clock is read again after
            # the write.
            self._transport.write(data)
            self._all_has_left = False
            self._written = now = self.clock()  # read again: the process may have been stopped in between
            arbiter.transmitted(now)
            if self.tap is not None:
                self.tap.transmitted(now, data, arbiter.attempt)
            # Only for a port that held bytes once, or has flow control: otherwise it would cost a timer per request.
            if self._may_hold:
                self._look_after(now)
        event = arbiter.poll_event()
        while event is not None:
            # `type` and not `isinstance`: this chain runs for every event, and no event has subclasses.
            if type(event) is Transaction:
                if event.writes and event.attempts:
                    # before its caller wakes, so that no snapshot comes in between
                    self._on_written(event, event.ended_at)
                waiter = event.tag
                if waiter is None or waiter.done():
                    pass  # the caller has gone
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
            # After the write: the next request is on the wire before a caller wakes.
            event = arbiter.poll_event() if arbiter.events else None  # a call less on the way of a reply
        due = arbiter.poll_timeout()
        # An early timer changes nothing, so it is never moved to a later time: that saves a system call per reply.
        if due < self._armed:
            self._arm(due)
        if self._run_out is not None and not self._runs():
            self._run_out.set()

    async def run_out(self) -> None:
        """Return when the line is idle, within one exchange, and all callers have been notified."""
        if self._runs():
            self._run_out = anyio.Event()
            await self._run_out.wait()

    def driver_errors(self) -> DriverErrors | None:
        """Return the driver's counters of the open port. The arbiter has no access to them."""
        return None if self._port is None else self._port.errors()

    def reset_driver_errors(self) -> None:
        """Reset the driver's counters of the open port, if any."""
        if self._port is not None:
            self._port.reset()

    def stop(self) -> None:
        """Stop the timer, because the bus is closed. If `run_out` was cancelled, remaining callers are notified now."""
        while self.arbiter.failing:  # in batches: notifying a thousand callers in one turn blocked the loop for 5 ms
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
        # After `_port` is set: the first deadline already queries it.
        self.arbiter.line_up(self.clock(), paced=self._paced(transport))
        self.turn()

    def data_received(self, data: bytes) -> None:
        now = self.clock()
        if self.tap is not None:
            self.tap.received(now, data, self.arbiter.attempt)
        # Bytes that were held may have left since the last query. Only then can these bytes be the reply (R2).
        if self._held_since < inf:  # query again
            self._check_output(now)
        self.arbiter.data_received(data, now)
        self.turn()

    def byte_marked(self, byte: bytes, mark: Mark) -> None:
        """Process a byte that the UART marked as damaged; none if a serial server reports the error separately."""
        now = self.clock()
        # A tty has one mark for a break and a damaged byte 00.
        if mark is Mark.BREAK and self._port is not None and not self._port.is_break():
            mark = Mark.DAMAGED
        if self.tap is not None and byte:
            self.tap.received(now, byte, self.arbiter.attempt)
        self.arbiter.byte_marked(mark, now)
        self.turn()

    def pause_writing(self) -> None:
        """Note that the transport could not pass on all bytes: no deadline expires until it has."""
        self._paused = self._may_hold = True

    def resume_writing(self) -> None:
        """Note that the transport has passed on all bytes."""
        self._paused = False
        self._look_again()

    def connection_lost(self, cause: Exception | None) -> None:
        self._transport = None
        self._port = None
        # An aborted transport reports no cause: the reason for the abort is more useful.
        what = self._gave_up or cause_text(cause, "it was closed")
        self._gave_up = ""
        self.arbiter.line_down(what, self.clock())
        self.turn()

    # inside

    def _runs(self) -> bool:
        return self.arbiter.state is LineState.EXCHANGE or self.arbiter.failing

    def _give_up_on(self, late: Overdue) -> None:
        """Fail the caller and keep the exchange: a write on the wire ends before anything else can be read."""
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
            # Queried here and not when the holdoff ends, because the next request waits for that. `inf`:
            # acknowledgements may not be outstanding either, however recent the write is; otherwise it is queried again
            # then.
            self._all_has_left = self._port.unsent(inf) == 0

    def _on_time(self) -> None:
        self._armed = inf
        now = self.clock()
        unread = False
        if self._port is not None:
            # The kernel is queried only now, before any deadline expires: a blocked loop may run timers before it
            # reads.
            line_due = self.arbiter.line_due(now)
            caller_due = self.arbiter.answer_counts(now)
            if line_due or caller_due:
                unread = self._port.unread()
            if (line_due or caller_due) and not self._all_has_left:
                self._check_output(now)  # report held output before a request expires
        self.arbiter.handle_timeout(now, unread=unread)
        self.turn()

    def _look_after(self, now: float) -> None:
        """Query the port when the sent bytes should have left, so that a port that holds bytes back is noticed."""
        # The transport still has bytes that the kernel did not accept: the calculated time does not apply.
        if self._paused:
            self._check_output(now)
        elif self._loop is not None:
            if self._look is not None:
                self._look.cancel()
            self._look = self._loop.call_later(self.arbiter.sent_until - now, self._look_again)

    def _look_again(self) -> None:
        self._check_output(self.clock())
        due = self.arbiter.poll_timeout()
        if due < self._armed:
            self._arm(due)

    def _check_output(self, now: float) -> None:
        """Report the number of unsent bytes to the arbiter, and close the port if they do not leave for too long."""
        if self._port is None:
            return
        count = self._port.unsent(now - self._written)
        # Unknown: the transport has neither a descriptor nor a buffer size. Windows then count from the write.
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
        """Close the port, which discards its unsent bytes. It is reopened as after any loss."""
        # A reply window that starts when the bytes leave would never start, so every caller would wait.
        self._gave_up = f"no byte has left {self._name} for {STUCK_AFTER:g} s: {port.stuck_because}"
        self._port = None
        port.discard_unsent()  # before the abort, after which the kernel would continue to send
        if self._transport is not None:
            self._transport.abort()
