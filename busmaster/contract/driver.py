"""Driving an exchange: what is done with feed, expired and Expect, in one place.

`follow` is the loop itself; the arbiter uses it with clocks of its own. `Driver` is a host without a clock, for whoever
holds one exchange in his hands: who replays a recording, tests a protocol, or examines a line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

from busmaster.contract.exchange import Abandonable, Done, Exchange, Expect, FrameError, Progress
from busmaster.contract.timing import ReplyTiming
from busmaster.errors import Refused

MOST_STEPS = 64
"""Steps in a row, without a byte between them, after which an exchange that wants another one has no end."""


class EndlessExchange(Exception):
    """An exchange wants one step after the other though nothing comes: a bug of its protocol."""


def follow(
    exchange: Exchange[Any], progress: Expect, begin: Callable[[Expect, float], object], now: float
) -> Progress[Any]:
    """Go from step to step for as long as the reader says so, and return what it says then.

    `begin` is called with each step, and with `now`; it says what the host says first. Raises what `begin` and the
    reader raise, and EndlessExchange.
    """
    for _ in range(MOST_STEPS):
        begin(progress, now)
        following = exchange.feed(b"")
        if type(following) is not Expect:
            return following
        progress = following
    raise EndlessExchange(f"another step after {MOST_STEPS} of one chunk")


def without_noise(exchange: Exchange[Any], data: bytes) -> bytes:
    """Return what is left of the first bytes of a reply, for a profile that tolerates noise before it."""
    return data.lstrip(bytes(set(data) - set(exchange.starts)))


@dataclass(frozen=True, slots=True)
class Ending:
    """How an exchange ended: with `value`, or with `error`. `send` is what the host says last; `rest` came after.

    `silent`: it failed because nothing came of the step that was awaited.
    """

    value: Any = None
    send: bytes = b""
    rest: bytes = b""
    error: Exception | None = None
    silent: bool = False

    @property
    def delivered(self) -> bool:
        return self.error is None

    @property
    def is_bug(self) -> bool:
        """It raised what no exchange may raise."""
        return self.error is not None and not isinstance(self.error, (FrameError, Refused))

    @property
    def is_whole(self) -> bool:
        """It claims that nothing more can come (R3)."""
        return isinstance(self.error, FrameError) and self.error.whole

    def same_as(self, other: Ending) -> bool:
        """Compare values, what is said and left over, and the kinds of errors; not their words."""
        mine, theirs = (replace(ending, error=None) for ending in (self, other))
        return mine == theirs and type(self.error) is type(other.error)

    def __str__(self) -> str:
        if self.error is not None:
            return f"{type(self.error).__name__}({str(self.error)!r})"
        return f"the value {self.value!r}" + (f" and {self.rest.hex(' ')} left over" if self.rest else "")


class Driver:
    """One fresh exchange, as a host drives it that has no clock: somebody else knows when a window or gap is over.

    `said` is what the host says after the request, step by step. `timing` is that of the step which is awaited, and
    `begun` tells whether a byte of it has come. `ending` is how it ended, None until it has. `noise_tolerant` is the
    profile's: bytes that begin no reply are left out before one.
    """

    def __init__(self, exchange: Exchange[Any], *, noise_tolerant: bool = False) -> None:
        self.exchange = exchange
        self._noise_tolerant = noise_tolerant
        self._silent = False
        self.timing: ReplyTiming = exchange.timing
        self.said: list[bytes] = []
        self.begun = False
        self.ending: Ending | None = None

    def feed(self, *chunks: bytes) -> Driver:
        """Hand over bytes of the line, in the chunks in which they came. What comes after a reply is left over."""
        for chunk in chunks:
            ending = self.ending
            if ending is None:
                data = chunk if self.begun or not self._noise_tolerant else without_noise(self.exchange, chunk)
                self.begun = self.begun or bool(data)
                self._silent = False
                if data or not chunk:
                    self._take(self.exchange.feed, data)
            elif ending.delivered:
                self.ending = replace(ending, rest=ending.rest + chunk)
        return self

    def expire(self) -> None:
        """Tell that the window of the step is over, or the inter-byte timeout where it has begun."""
        if self.ending is None:
            self._silent = not self.begun
            self._take(self.exchange.expired, self.begun)

    def run_out(self) -> Ending:
        """Return how it ends if nothing more comes: one window or inter-byte timeout after the other is over."""
        for _ in range(MOST_STEPS):
            self.expire()
            if self.ending is not None:
                return self.ending
        return Ending(error=EndlessExchange(f"another step after {MOST_STEPS} that expired"))

    def fail(self, error: Exception) -> None:
        """End it with an error, the host's own too: whatever is still heard does not count."""
        send = error.send if isinstance(error, FrameError) else b""
        self.ending = Ending(error=error, send=send, silent=self._silent)

    def abandon(self) -> None:
        """End it where it would say something again, which is then not said (see `Abandonable`)."""
        self.said.clear()
        self.fail(cast("Abandonable", self.exchange).abandon())

    def _take(self, call: Callable[[Any], Progress[Any]], argument: object) -> None:
        try:
            progress = call(argument)
            if isinstance(progress, Expect):
                progress = follow(self.exchange, progress, self._begin, 0.0)
        except Exception as error:
            self.fail(error)
            return
        if isinstance(progress, Done):
            self.ending = Ending(progress.value, progress.send, progress.rest)

    def _begin(self, step: Expect, _now: float) -> None:
        self.timing = step.timing
        self.begun = False
        if step.send:
            self.said.append(step.send)


__all__ = ["MOST_STEPS", "Driver", "Ending", "EndlessExchange", "follow", "without_noise"]
