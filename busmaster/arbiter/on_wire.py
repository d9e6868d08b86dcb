"""The exchange on the wire: its legs, its reader, and what it leaves owed. The line's states are line_machine.py's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.echo import Echo
from busmaster.arbiter.leg import Leg
from busmaster.arbiter.output import Output
from busmaster.arbiter.transaction import Transaction
from busmaster.contract.exchange import Abandonable, Exchange, Expect, Step
from busmaster.contract.timing import ReplyTiming


class OnWire:
    """Of one line. `transaction` and `exchange` are None while nothing is asked; `leg` and `output` outlive them."""

    __slots__ = ("_deadlines", "_echo", "_urgent_waits", "exchange", "leg", "output", "paced", "strayed", "transaction")

    def __init__(self, leg: Leg, echo: Echo, deadlines: Deadlines, urgent_waits: Callable[[], bool]) -> None:
        self.transaction: Transaction | None = None
        self.exchange: Exchange[Any] | None = None
        self.leg = leg
        self.output = Output(leg, echo)
        self.paced = False
        """Bytes leave at the baud rate (R4)."""
        self.strayed = False
        """Bytes came though no answer was due (a broadcast's)."""
        self._echo = echo
        self._deadlines = deadlines
        self._urgent_waits = urgent_waits

    def begin(self, transaction: Transaction, exchange: Exchange[Any], now: float) -> None:
        """Say its request, and set the deadline of its first leg."""
        self.transaction = transaction
        self.exchange = exchange
        self.strayed = False
        self._begin_leg(exchange.timing, exchange.sizes.longest, exchange.request, now)
        if not exchange.answered:
            self._deadlines.line = self.leg.end + exchange.timing.turnaround

    def without_noise(self, data: bytes) -> bytes:
        """Return what is left of the first bytes of a reply where the profile tolerates noise before it."""
        exchange = self.exchange
        assert exchange is not None
        return data.lstrip(bytes(set(data) - set(exchange.starts)))

    def follow(self, step: Expect, now: float) -> Step[Any]:
        """Go from leg to leg for as long as the reader says so. Raises what the reader raises."""
        exchange = self.exchange
        assert exchange is not None
        following: Step[Any] = step
        while type(following) is Expect:
            self._next_leg(following, now)
            following = exchange.feed(b"")
        return following

    def say(self, send: bytes, now: float) -> None:
        """Say what closes an exchange, or answers a stray packet."""
        self.output.add(send, now)
        self.leg.say(len(send), now)

    def due_anew(self, now: float) -> float:
        """The deadline of the leg, where what was said has left only now."""
        leg, exchange = self.leg, self.exchange
        if leg.begun:
            return leg.gap_over(now)
        answered = exchange is not None and exchange.answered
        return now + (leg.timing.window + leg.latency if answered else leg.timing.turnaround)

    def _begin_leg(self, timing: ReplyTiming, longest: int, send: bytes, now: float) -> None:
        """Say `send`; its reply must begin within the window, and end within the bound of R2."""
        said = len(send)
        self._deadlines.line = self.leg.begin(timing, said, longest, now)
        if send:
            output = self.output
            output.waiting += send
            output.said_at = now
            if self._echo.declared:
                self._echo.sent(send)
            elif self.paced:
                self.leg.taint(said, now)

    def _next_leg(self, step: Expect, now: float) -> None:
        """Raises FrameError instead, where a repeat would hold the line past its limit or an urgent command (R9)."""
        transaction = self.transaction
        assert transaction is not None
        limit = transaction.node.profile.exchange_limit
        if step.send and limit is not None and (now - transaction.started > limit or self._urgent_waits()):
            raise cast("Abandonable", self.exchange).abandon()
        self._begin_leg(step.timing, step.sizes.longest, step.send, now)
