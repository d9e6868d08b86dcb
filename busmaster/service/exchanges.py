"""What passes on a line, exchange by exchange, told to those who look; while nobody does it costs nothing."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Callable
from typing import Any

from busmaster.arbiter.tap import Attempt
from busmaster.bus.bus import Bus
from busmaster.outputs.values import value_text
from busmaster.service.messages import encoded
from busmaster.service.streams import Broadcast

INTERVAL = 0.2
"""Seconds between two messages."""
ENCODED_AT_ONCE = 10
"""Exchanges that are put into words in one turn of the line's loop."""
MOST_KEPT = 500
"""Exchanges between two messages: of more, the oldest are left out, and counted."""
MOST_BYTES = 256
"""Of one exchange, or of what came unasked, that are told."""
LONGEST_RESULT = 200

Said = tuple[float, bool, bytes]
"""When, whether it was the master, and what."""


class Passage:
    """One attempt at a command with all that was said; without an attempt, bytes that nobody had asked for."""

    __slots__ = ("attempt", "bytes", "said")

    def __init__(self, attempt: Attempt | None) -> None:
        self.attempt = attempt
        self.said: list[Said] = []
        self.bytes = 0

    def add(self, now: float, by_master: bool, data: bytes) -> None:
        """Add what was said."""
        if self.bytes < MOST_BYTES:
            self.said.append((now, by_master, data[: MOST_BYTES - self.bytes]))
        self.bytes += len(data)

    @property
    def is_over(self) -> bool:
        return self.attempt is None or self.attempt.verdict is not None


class Listener:
    """The tap: it keeps what passes until it is taken."""

    def __init__(self) -> None:
        self.lost = 0
        """Exchanges that were left out."""
        self._passages: deque[Passage] = deque()
        self._last: Passage | None = None
        self._has_begun = False
        """An attempt began: what came before that may be the answer to one that nobody listened to."""

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Hear what the master says: with a new attempt its request, with none what closes the attempt before."""
        if attempt is None and self._last is not None:
            self._last.add(now, True, data)
        elif attempt is not None:
            self._has_begun = True
            self._passage(attempt).add(now, True, data)

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Hear what comes."""
        if self._has_begun:
            self._passage(attempt).add(now, False, data)

    def attempted(self, attempt: Attempt, /) -> None:
        """Hear that an attempt is over, which it says itself."""

    def _passage(self, attempt: Attempt | None) -> Passage:
        if self._last is None or self._last.attempt is not attempt:
            self._last = Passage(attempt)
            self._passages.append(self._last)
            if len(self._passages) > MOST_KEPT:
                self._passages.popleft()
                self.lost += 1
        return self._last

    def take(self) -> list[Passage]:
        """Return what is over, in its order; what is still on the wire is kept."""
        over: list[Passage] = []
        while self._passages and self._passages[0].is_over:
            over.append(self._passages.popleft())
        if self._last is not None and not self._passages:
            self._last = None
        return over


class ExchangesBroadcast(Broadcast):
    """What passes on one line."""

    def __init__(self, bus: Bus, on_end: Callable[[], None]) -> None:
        super().__init__(on_end)
        self._bus = bus

    async def _bodies(self) -> AsyncGenerator[tuple[str, str], None]:
        listener = Listener()
        self._bus.taps.add(listener)
        try:
            while True:
                parts: list[str] = []
                passages = listener.take()
                for first in range(0, len(passages), ENCODED_AT_ONCE):
                    some = [said_passage(one) for one in passages[first : first + ENCODED_AT_ONCE]]
                    parts.append(encoded(some)[1:-1])
                    await asyncio.sleep(0)
                head = encoded({"now": self._bus.now(), "left_out": listener.lost})
                yield "exchanges", f'{head[:-1]},"exchanges":[{",".join(parts)}]}}'
                await asyncio.sleep(INTERVAL)
        finally:
            self._bus.taps.remove(listener)


def said_passage(passage: Passage) -> dict[str, Any]:
    """Return an exchange as it is said. Bytes are in hexadecimal digits."""
    attempt, said = passage.attempt, passage.said
    told: dict[str, Any] = {
        "begun": said[0][0],
        "ended": said[-1][0],
        "bytes": passage.bytes,
        "said": [[when, "master" if by_master else "node", data.hex()] for when, by_master, data in said],
    }
    if attempt is None or attempt.verdict is None:
        return told
    return told | {
        "ended": attempt.ended_at,
        "protocol": attempt.protocol,
        "address": attempt.address,
        "command": str(attempt.command),
        "writes": attempt.command.writes,
        "purpose": attempt.purpose,
        "request": attempt.transaction,
        "attempt": attempt.number,
        "verdict": attempt.verdict.value,
        "result": _result(attempt.result),
        "late": attempt.late,
        "settled": attempt.settled,
    }


def _result(result: Any) -> str:
    text = "" if result is None else value_text(result)
    return text if len(text) <= LONGEST_RESULT else f"{text[:LONGEST_RESULT]}..."
