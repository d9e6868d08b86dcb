"""asyncio meets the arbiter: bytes and time in, bytes and events out.

The hot path: a reply arrives, the arbiter completes it and encodes the next request, and that request is written
in the same callback. Only then are futures resolved. No task runs between a reply and the next request, and no
user code runs in here.
"""

from __future__ import annotations

import asyncio
import select
import time
from collections.abc import Callable
from math import inf
from typing import Any, Protocol, cast

import anyio

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.events import Completed, Event, Polled, Sampled
from busmaster.arbiter.schedule import Poll
from busmaster.arbiter.state import LineState
from busmaster.arbiter.transaction import Transaction
from busmaster.errors import LineDown
from busmaster.transport.clock import clock_of


class Tap(Protocol):
    """Sees what passes (a capture). Must not block, nor raise."""

    def transmitted(self, now: float, data: bytes) -> None: ...

    def received(self, now: float, data: bytes) -> None: ...

    def completed(self, transaction: Transaction) -> None: ...


class Pump(asyncio.Protocol):
    """Owns the arbiter of one line. `on_sample`, `on_cycle` and `on_event` are the library's own and return at once."""

    def __init__(
        self,
        arbiter: Arbiter,
        *,
        on_sample: Callable[[Poll, Transaction], None],
        on_cycle: Callable[[Poll], None],
        on_event: Callable[[Event], None],
        on_written: Callable[[Transaction], None] = lambda _: None,
        paced: Callable[[asyncio.BaseTransport], bool] = lambda _: False,
        tap: Tap | None = None,
    ) -> None:
        self.arbiter = arbiter
        self.clock: Callable[[], float] = time.monotonic
        self.tap = tap
        self._on_sample = on_sample
        self._on_cycle = on_cycle
        self._on_event = on_event
        self._on_written = on_written
        self._paced = paced
        self._loop: asyncio.AbstractEventLoop | None = None
        self._transport: asyncio.Transport | None = None
        self._input: Callable[[], bool] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._armed = inf
        self._run_out: anyio.Event | None = None

    def bind(self, loop: asyncio.AbstractEventLoop) -> None:
        """Keep this loop's time."""
        self._loop = loop
        self.clock = clock_of(loop)

    # what the bus calls

    def transact(self, transaction: Transaction) -> asyncio.Future[Any]:
        """Submit it; the future gets its value or its error."""
        assert self._loop is not None
        future: asyncio.Future[Any] = self._loop.create_future()
        transaction.waiter = future
        if self.arbiter.submit(transaction, self.clock()):
            self.turn()
        return future

    def cancel(self, transaction: Transaction) -> None:
        self.arbiter.cancel(transaction, self.clock())

    def turn(self) -> None:
        """Send what is to be sent, tell what has happened, and arm the one timer."""
        arbiter = self.arbiter
        data = arbiter.poll_transmit()
        if data is not None and self._transport is not None:
            self._transport.write(data)
            if self.tap is not None:
                self.tap.transmitted(self.clock(), data)
        while (event := arbiter.poll_event()) is not None:
            if type(event) is Completed:
                self._resolve(event.transaction)
            elif type(event) is Sampled:
                self._on_sample(event.poll, event.transaction)
            elif type(event) is Polled:
                self._on_cycle(event.poll)
            else:
                self._on_event(event)
        due = arbiter.poll_timeout()
        if due < self._armed:
            self._arm(due)
        if self._run_out is not None and arbiter.state is not LineState.EXCHANGE:
            self._run_out.set()

    async def run_out(self) -> None:
        """Return when nothing is on the wire: within one exchange."""
        if self.arbiter.state is LineState.EXCHANGE:
            self._run_out = anyio.Event()
            await self._run_out.wait()

    def stop(self) -> None:
        """No timer any more: the bus is closed."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._loop = None

    # what asyncio calls

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        self._input = input_of(self._transport)
        self.arbiter.line_up(self.clock(), paced=self._paced(transport))
        self.turn()

    def data_received(self, data: bytes) -> None:
        now = self.clock()
        if self.tap is not None:
            self.tap.received(now, data)
        self.arbiter.data_received(data, now)
        self.turn()

    def connection_lost(self, cause: Exception | None) -> None:
        self._transport = None
        self._input = None
        what = cause.what if isinstance(cause, LineDown) else str(cause or "it was closed")
        self.arbiter.line_down(what, self.clock())
        self.turn()

    # inside

    def _resolve(self, transaction: Transaction) -> None:
        if self.tap is not None:
            self.tap.completed(transaction)
        if transaction.writes and transaction.attempts:
            self._on_written(transaction)
        future = transaction.waiter
        if future is None or future.done():
            return
        if transaction.error is None:
            future.set_result(transaction.value)
        else:
            future.set_exception(transaction.error)

    def _arm(self, due: float) -> None:
        if self._loop is None:
            return
        if self._timer is not None:
            self._timer.cancel()
        self._armed = due
        self._timer = self._loop.call_at(self._loop.time() + max(0.0, due - self.clock()), self._on_time)

    def _on_time(self) -> None:
        self._timer = None
        self._armed = inf
        now = self.clock()
        self.arbiter.handle_timeout(now, unread=self._input is not None and self._input())
        self.turn()


def input_of(transport: asyncio.BaseTransport) -> Callable[[], bool] | None:
    """Tells whether bytes lie unread, without reading them; None where the transport has no descriptor.

    A loop that was blocked may run a timer before it reads: a late reply would lie there, and the silence that R3
    waits for would be a mistake.
    """
    for name in ("serial", "socket"):
        port = transport.get_extra_info(name)
        if port is not None:
            poller = select.poll()
            poller.register(port.fileno(), select.POLLIN)
            return lambda: any(events & select.POLLIN for _, events in poller.poll(0))
    return None
