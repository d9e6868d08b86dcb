"""An exchange in the hands of a host that has no clock: what it hears, what it says, and how it ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from busmaster.contract.exchange import Done, Exchange, Expect, FrameError, Refused, Step

PATIENCE = 64
"""Legs after which an exchange that still wants another one is taken to have no end."""


class Endless(Exception):
    """An exchange that wants one leg after the other."""


@dataclass(frozen=True, slots=True)
class Ending:
    """How an exchange ended: with `value`, or with `error`."""

    value: Any = None
    send: bytes = b""
    rest: bytes = b""
    error: Exception | None = None

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
        mine, theirs = (replace(ending, error=None) for ending in (self, other))
        return mine == theirs and type(self.error) is type(other.error)

    def __str__(self) -> str:
        if self.error is not None:
            return f"{type(self.error).__name__}({str(self.error)!r})"
        return f"the value {self.value!r}" + (f" and {self.rest.hex(' ')} left over" if self.rest else "")


class Listening:
    """Feeds an exchange as the arbiter does. `said` is what the host said after the request; `ending`, how it ended."""

    def __init__(self, exchange: Exchange[Any]) -> None:
        self.exchange = exchange
        self.said: list[bytes] = []
        self.ending: Ending | None = None
        self._begun = False

    def feed(self, *chunks: bytes) -> Listening:
        """What comes after a reply is left over, as it is for the arbiter."""
        for chunk in chunks:
            ending = self.ending
            if ending is None:
                self._begun = self._begun or bool(chunk)
                self._follow(self.exchange.feed, chunk)
            elif ending.delivered:
                self.ending = replace(ending, rest=ending.rest + chunk)
        return self

    def expire(self) -> Ending:
        """Nothing more comes: one window or byte gap after the other runs out, until the exchange ends."""
        for _ in range(PATIENCE):
            if self.ending is not None:
                return self.ending
            self._follow(self.exchange.expired, self._begun)
        return Ending(error=Endless(f"another leg after {PATIENCE} that expired"))

    def _follow(self, call: Callable[[Any], Step[Any]], argument: object) -> None:
        try:
            step = call(argument)
            for _ in range(PATIENCE):
                if not isinstance(step, Expect):
                    break
                self._begun = False
                if step.send:
                    self.said.append(step.send)
                step = self.exchange.feed(b"")
            else:
                raise Endless(f"another leg after {PATIENCE} of one chunk")
        except Exception as error:
            self.ending = Ending(error=error)
            return
        if isinstance(step, Done):
            self.ending = Ending(step.value, step.send, step.rest)
