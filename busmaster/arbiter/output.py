"""What the host says: gathered until the port takes it, and when it has left."""

from __future__ import annotations

from math import inf

from busmaster.arbiter.echo import Echo
from busmaster.arbiter.leg import Leg

HELD_LOOK = 0.002
"""Seconds after which a port that holds what was said is asked again."""


class Output:
    """The bytes to be sent on one line, and the times of its leg that follow from when they leave."""

    __slots__ = ("_echo", "_leg", "held", "said_at", "waiting")

    def __init__(self, leg: Leg, echo: Echo) -> None:
        self.waiting = b""
        """What the port has not been handed yet."""
        self._leg = leg
        self._echo = echo
        self.held = False
        """The port had not sent all of it when it was asked last."""
        self.said_at = -inf
        """The time from which the leg of what was said last is reckoned."""

    def add(self, data: bytes, now: float) -> None:
        """Say these bytes next."""
        self.waiting += data
        self.said_at = now
        if self._echo.declared:
            self._echo.sent(data)

    def discard(self) -> None:
        """Drop what has not been handed over: it is not said, and what the port holds goes with it."""
        self.waiting = b""
        self.held = False

    def unsent(self, count: int, now: float) -> float | None:
        """Note how many bytes have not left. Returns when to ask again; None if all left earlier, inf if just now."""
        if count:
            self.held = True
            return now + max(count * self._leg.byte_time, HELD_LOOK)
        if not self.held:
            return None
        self.held = False
        self._leg.shift(max(0.0, now - self._leg.out))
        return inf
