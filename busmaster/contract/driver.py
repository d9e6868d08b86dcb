"""Runs an exchange: the calls of feed, expired and the handling of Expect, in one place.

`follow` is the loop itself; the arbiter uses it with its own clock. `Driver` is a host without a clock, for code that
runs a single exchange: replaying a capture, testing a protocol, or examining a line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

from busmaster.contract.exchange import Abandonable, Done, Exchange, Expect, FrameError, Progress
from busmaster.contract.timing import ReplyTiming
from busmaster.errors import Refused

MOST_STEPS = 64
"""Consecutive steps without a byte between them after which an exchange is considered endless."""


class EndlessExchange(Exception):
    """An exchange requests one step after the other although no byte arrives: a bug of its protocol."""


def follow(
    exchange: Exchange[Any], progress: Expect, begin: Callable[[Expect, float], object], now: float
) -> Progress[Any]:
    """Run the steps as long as the reader returns Expect, and return its final result.

    `begin` is called with each step and with `now`; it sends the host's bytes. Raises what `begin` and the reader
    raise, and EndlessExchange.
    """
    for _ in range(MOST_STEPS):
        begin(progress, now)
        following = exchange.feed(b"")
        if type(following) is not Expect:
            return following
        progress = following
    raise EndlessExchange(f"another step after {MOST_STEPS} of one chunk")


def without_noise(exchange: Exchange[Any], data: bytes) -> bytes:
    """Return the first bytes of a reply without leading noise, for a profile that tolerates noise."""
    return data.lstrip(bytes(set(data) - set(exchange.starts)))


@dataclass(frozen=True, slots=True)
class Ending:
    """The result of an exchange: `value` or `error`. `send`: the host's last bytes. `rest`: bytes after the reply.

    `silent`: it failed because no byte of the expected step arrived.
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
        """True if it raised an exception that an exchange must not raise."""
        return self.error is not None and not isinstance(self.error, (FrameError, Refused))

    @property
    def is_whole(self) -> bool:
        """True if it reports that nothing more can arrive (R3)."""
        return isinstance(self.error, FrameError) and self.error.whole

    def same_as(self, other: Ending) -> bool:
        """Compare values, sent and remaining bytes, and kinds of errors, but not their texts."""
        mine, theirs = (replace(ending, error=None) for ending in (self, other))
        return mine == theirs and type(self.error) is type(other.error)

    def __str__(self) -> str:
        if self.error is not None:
            return f"{type(self.error).__name__}({str(self.error)!r})"
        return f"the value {self.value!r}" + (f" and {self.rest.hex(' ')} left over" if self.rest else "")


class Driver:
    """One exchange, run by a host without a clock: the caller reports when a window or an inter-byte timeout has
    expired.

    `sent`: bytes that the host sends after the request, per step. `timing`: that of the current step; `begun`: True if
    a byte of it was received. `ending`: the result, None before the end. `noise_tolerant`: that of the profile; bytes
    before a reply that cannot begin one are skipped.
    """

    def __init__(self, exchange: Exchange[Any], *, noise_tolerant: bool = False) -> None:
        self.exchange = exchange
        self._noise_tolerant = noise_tolerant
        self._silent = False
        self.timing: ReplyTiming = exchange.timing
        self.sent: list[bytes] = []
        self.begun = False
        self.ending: Ending | None = None

    def feed(self, *chunks: bytes) -> Driver:
        """Pass received bytes in the chunks in which they arrived. Bytes after the reply are kept as its `rest`."""
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
        """Report that the window of the step has expired, or the inter-byte timeout if the reply has begun."""
        if self.ending is None:
            self._silent = not self.begun
            self._take(self.exchange.expired, self.begun)

    def run_out(self) -> Ending:
        """Return the result if nothing more arrives: all windows and inter-byte timeouts expire."""
        for _ in range(MOST_STEPS):
            self.expire()
            if self.ending is not None:
                return self.ending
        return Ending(error=EndlessExchange(f"another step after {MOST_STEPS} that expired"))

    def fail(self, error: Exception) -> None:
        """End it with an error, which may be the host's own. Later bytes are ignored."""
        send = error.send if isinstance(error, FrameError) else b""
        self.ending = Ending(error=error, send=send, silent=self._silent)

    def abandon(self) -> None:
        """End it instead of sending its next bytes (see `Abandonable`)."""
        self.sent.clear()
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
            self.sent.append(step.send)


__all__ = ["MOST_STEPS", "Driver", "Ending", "EndlessExchange", "follow", "without_noise"]
