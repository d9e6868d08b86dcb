"""The exchanges on a line, for clients that watch it. Without such clients, it costs nothing."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Callable
from typing import Any

from busmaster import Bus, ext
from busmaster.app.service.messages import encode
from busmaster.app.service.owner_messages import ExchangeForm, ExchangesBody, Transmission, UnexpectedBytes
from busmaster.app.service.streams import Broadcast
from busmaster.app.service.typed import Raw
from busmaster.app.service.values import value_text
from busmaster.ext import Attempt

INTERVAL = 0.2
"""Seconds between two messages."""
ENCODED_AT_ONCE = 40
"""Exchanges that are put into words in one turn of the line's loop: a fifth of a millisecond at most."""
MOST_KEPT = 500
"""Exchanges between two messages: of more, the oldest are left out, and counted."""
MOST_BYTES = 256
"""Maximum number of bytes that are reported for one exchange, or for unexpected bytes."""
LONGEST_RESULT = 200
RECEIVED_AT_ONCE = 200
"""Pieces of what passes that are put into their order at once."""


class TracedExchange:
    """One attempt at a command with all of its bytes; or, without an attempt, unexpected bytes."""

    __slots__ = ("attempt", "bytes", "transmissions")

    def __init__(self, attempt: Attempt | None) -> None:
        self.attempt = attempt
        self.transmissions: list[Transmission] = []
        self.bytes = 0

    def add(self, now: float, by_master: bool, data: bytes) -> None:
        """Add bytes that were sent or received."""
        if self.bytes < MOST_BYTES:
            text = data[: MOST_BYTES - self.bytes].hex()
            self.transmissions.append(Transmission(round(now * 1e6), "master" if by_master else "node", text))
        self.bytes += len(data)

    @property
    def is_over(self) -> bool:
        return self.attempt is None or self.attempt.verdict is not None


class Listener:
    """The tap: it stores exchanges until they are taken.

    It is called between a reply and the next request, so it only stores the bytes.
    """

    def __init__(self) -> None:
        self._lost = 0
        self._received: list[tuple[float, bool, bytes, Attempt | None]] = []
        self._exchanges: deque[TracedExchange] = deque()
        self._last: TracedExchange | None = None
        self._has_begun = False
        """An attempt has begun. Earlier bytes can be the reply to an attempt that was not recorded."""

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Store bytes of the master: the request of a new attempt, or without one the end of the attempt before."""
        self._received.append((now, True, data, attempt))
        if len(self._received) == RECEIVED_AT_ONCE:
            self._put_in_order()

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Store received bytes."""
        self._received.append((now, False, data, attempt))
        if len(self._received) == RECEIVED_AT_ONCE:
            self._put_in_order()

    def attempted(self, attempt: Attempt, /) -> None:
        """Do nothing: an attempt has its own end."""

    def take(self) -> tuple[list[TracedExchange], int]:
        """Return the completed exchanges in their order, and the number of all that were dropped."""
        self._put_in_order()
        over: list[TracedExchange] = []
        while self._exchanges and self._exchanges[0].is_over:
            over.append(self._exchanges.popleft())
        if not self._exchanges:
            self._last = None
        return over, self._lost

    def _put_in_order(self) -> None:
        received, self._received = self._received, []
        for now, by_master, data, attempt in received:
            exchange = self._last
            if attempt is not None or (self._has_begun and not by_master):
                if exchange is None or exchange.attempt is not attempt:
                    exchange = self._begin(attempt)
            elif exchange is None:
                continue
            exchange.add(now, by_master, data)

    def _begin(self, attempt: Attempt | None) -> TracedExchange:
        self._has_begun = True
        self._last = exchange = TracedExchange(attempt)
        self._exchanges.append(exchange)
        if len(self._exchanges) > MOST_KEPT:
            self._exchanges.popleft()
            self._lost += 1
        return exchange


class ExchangesBroadcast(Broadcast):
    """What passes on one line."""

    def __init__(self, bus: Bus, on_end: Callable[[], None]) -> None:
        super().__init__(on_end)
        self._bus = bus

    async def _bodies(self) -> AsyncGenerator[tuple[str, Raw], None]:
        listener = Listener()
        ext.add_tap(self._bus, listener)
        try:
            while True:
                parts: list[Any] = []
                exchanges, left_out = listener.take()
                for number, exchange in enumerate(exchanges):
                    if number and number % ENCODED_AT_ONCE == 0:
                        await asyncio.sleep(0)
                    parts.append(Raw(encode(encode_exchange(exchange))))
                yield "exchanges", Raw(encode(ExchangesBody(self._bus.now(), left_out, parts)))
                await asyncio.sleep(INTERVAL)
        finally:
            ext.remove_tap(self._bus, listener)


def encode_exchange(exchange: TracedExchange) -> UnexpectedBytes | ExchangeForm:
    """Return a completed exchange, or unexpected bytes, in the form of a message: values in a fixed order, times in
    whole microseconds. Names would be repeated for each exchange, and floats are longer.
    """
    attempt = exchange.attempt
    if attempt is None or attempt.verdict is None:
        return UnexpectedBytes(exchange.transmissions, exchange.bytes)
    return ExchangeForm(
        exchange.transmissions,
        exchange.bytes,
        round(attempt.ended_at * 1e6),
        attempt.protocol,
        attempt.address,
        str(attempt.command),
        attempt.command.writes,
        attempt.purpose,
        attempt.transaction,
        attempt.number,
        attempt.verdict.value,
        _result(attempt.result),
        attempt.late,
        round(attempt.quiet_time * 1e6),
    )


def _result(result: Any) -> str:
    text = "" if result is None else value_text(result)
    return text if len(text) <= LONGEST_RESULT else f"{text[:LONGEST_RESULT]}..."
