"""What passes on a line, exchange by exchange, told to those who look; while nobody does it costs nothing."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Callable
from typing import Any

from busmaster import Bus, ext
from busmaster.app.service.messages import encoded
from busmaster.app.service.streams import Broadcast
from busmaster.app.service.values import value_text
from busmaster.ext import Attempt

INTERVAL = 0.2
"""Seconds between two messages."""
ENCODED_AT_ONCE = 40
"""Exchanges that are put into words in one turn of the line's loop: a fifth of a millisecond at most."""
MOST_KEPT = 500
"""Exchanges between two messages: of more, the oldest are left out, and counted."""
MOST_BYTES = 256
"""Of one exchange, or of what came unexpected, that are told."""
LONGEST_RESULT = 200
HEARD_AT_ONCE = 200
"""Pieces of what passes that are put into their order at once."""


class Passage:
    """One attempt at a command with all that was said; without an attempt, bytes that nobody had asked for."""

    __slots__ = ("attempt", "bytes", "said")

    def __init__(self, attempt: Attempt | None) -> None:
        self.attempt = attempt
        self.said: list[list[Any]] = []
        """When, by whom, and what, as it is told."""
        self.bytes = 0

    def add(self, now: float, by_master: bool, data: bytes) -> None:
        """Add what was said."""
        if self.bytes < MOST_BYTES:
            told = data[: MOST_BYTES - self.bytes].hex()
            self.said.append([round(now * 1e6), "master" if by_master else "node", told])
        self.bytes += len(data)

    @property
    def is_over(self) -> bool:
        return self.attempt is None or self.attempt.verdict is not None


class Listener:
    """The tap: it keeps what passes until it is taken.

    It is told between a reply and the next request, so it makes nothing of it then.
    """

    def __init__(self) -> None:
        self._lost = 0
        self._heard: list[tuple[float, bool, bytes, Attempt | None]] = []
        self._passages: deque[Passage] = deque()
        self._last: Passage | None = None
        self._has_begun = False
        """An attempt began: what came before that may be the answer to one that nobody listened to."""

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Hear what the master says: with a new attempt its request, with none what closes the attempt before."""
        self._heard.append((now, True, data, attempt))
        if len(self._heard) == HEARD_AT_ONCE:
            self._put_in_order()

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Hear what comes."""
        self._heard.append((now, False, data, attempt))
        if len(self._heard) == HEARD_AT_ONCE:
            self._put_in_order()

    def attempted(self, attempt: Attempt, /) -> None:
        """Hear that an attempt is over, which it says itself."""

    def take(self) -> tuple[list[Passage], int]:
        """Return what is over, in its order, and how many exchanges were ever left out; what is on the wire is kept."""
        self._put_in_order()
        over: list[Passage] = []
        while self._passages and self._passages[0].is_over:
            over.append(self._passages.popleft())
        if not self._passages:
            self._last = None
        return over, self._lost

    def _put_in_order(self) -> None:
        heard, self._heard = self._heard, []
        for now, by_master, data, attempt in heard:
            passage = self._last
            if attempt is not None or (self._has_begun and not by_master):
                if passage is None or passage.attempt is not attempt:
                    passage = self._begin(attempt)
            elif passage is None:
                continue
            passage.add(now, by_master, data)

    def _begin(self, attempt: Attempt | None) -> Passage:
        self._has_begun = True
        self._last = passage = Passage(attempt)
        self._passages.append(passage)
        if len(self._passages) > MOST_KEPT:
            self._passages.popleft()
            self._lost += 1
        return passage


class ExchangesBroadcast(Broadcast):
    """What passes on one line."""

    def __init__(self, bus: Bus, on_end: Callable[[], None]) -> None:
        super().__init__(on_end)
        self._bus = bus

    async def _bodies(self) -> AsyncGenerator[tuple[str, str], None]:
        listener = Listener()
        ext.add_tap(self._bus, listener)
        try:
            while True:
                parts: list[str] = []
                passages, left_out = listener.take()
                for first in range(0, len(passages), ENCODED_AT_ONCE):
                    if first:
                        await asyncio.sleep(0)
                    parts.append(encoded(list(map(said_passage, passages[first : first + ENCODED_AT_ONCE])))[1:-1])
                head = encoded({"now": self._bus.now(), "left_out": left_out})
                yield "exchanges", f'{head[:-1]},"exchanges":[{",".join(parts)}]}}'
                await asyncio.sleep(INTERVAL)
        finally:
            ext.remove_tap(self._bus, listener)


def said_passage(passage: Passage) -> list[Any]:
    """Return an exchange that is over as it is said: values in an order that is fixed, times in whole microseconds,
    bytes in hexadecimal digits. It is said of each, so its names are not, and floats take ten times as long.
    """
    attempt = passage.attempt
    if attempt is None or attempt.verdict is None:
        return [passage.said, passage.bytes]
    return [
        passage.said,
        passage.bytes,
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
    ]


def _result(result: Any) -> str:
    text = "" if result is None else value_text(result)
    return text if len(text) <= LONGEST_RESULT else f"{text[:LONGEST_RESULT]}..."
