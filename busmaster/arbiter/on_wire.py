"""The exchange on the wire: its legs, its reader, and what it leaves owed. The line's states are line_machine.py's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.echo import Echo
from busmaster.arbiter.in_step import InStep
from busmaster.arbiter.learned import LATE_SHARE
from busmaster.arbiter.leg import Leg
from busmaster.arbiter.output import Output
from busmaster.arbiter.transaction import Transaction
from busmaster.contract.driver import follow, without_noise
from busmaster.contract.exchange import Abandonable, Exchange, Expect, Step


class OnWire:
    """Of one line. `transaction` and `exchange` are None while nothing is asked; `leg` and `output` outlive them."""

    __slots__ = (
        "_deadlines",
        "_echo",
        "_in_step",
        "_is_wanted",
        "_urgent_waits",
        "answered",
        "came_unasked",
        "exchange",
        "leg",
        "output",
        "transaction",
    )

    def __init__(
        self,
        leg: Leg,
        echo: Echo,
        deadlines: Deadlines,
        in_step: InStep,
        urgent_waits: Callable[[], bool],
        is_wanted: Callable[[Transaction], bool],
    ) -> None:
        self.transaction: Transaction | None = None
        self.exchange: Exchange[Any] | None = None
        self.answered = True
        """An answer to `exchange` is due: it is no broadcast."""
        self.leg = leg
        self.output = Output(leg, echo)
        self.came_unasked = False
        """Bytes came though no answer was due (a broadcast's)."""
        self._echo = echo
        self._deadlines = deadlines
        self._in_step = in_step
        self._urgent_waits = urgent_waits
        self._is_wanted = is_wanted

    def begin(self, transaction: Transaction, exchange: Exchange[Any], now: float) -> None:
        """Say its request, and set the deadline of its first leg."""
        self.transaction = transaction
        self.exchange = exchange
        self.answered = answered = exchange.answered
        self.came_unasked = False
        leg = self.leg
        request, timing = exchange.request, exchange.timing
        due = leg.begin(timing, len(request), exchange.sizes.longest, now)
        self._deadlines.line = due if answered else leg.end + timing.turnaround
        output = self.output  # as output.add does: this is done for every request
        # nearly always nothing waits, and to add to nothing takes longer than to ask
        output.waiting = output.waiting + request if output.waiting else request
        output.said_at = now
        if self._echo.declared:
            self._echo.sent(request)

    def gap_over(self, now: float) -> float:
        """Return when the reply, of which a byte came now, must go on."""
        assert self.transaction is not None
        if self.transaction.node.learning is not None:
            self.leg.note_pause(now)
        return self.leg.gap_over(now)

    def learn(self, now: float) -> None:
        """Let its node's times be learned from the reply to this leg, which is over."""
        transaction, exchange, leg = self.transaction, self.exchange, self.leg
        assert transaction is not None
        assert exchange is not None
        learning = transaction.node.learning
        if learning is None or not leg.begun:
            return
        heard = max(0.0, leg.begun_at - leg.end - leg.latency)
        # An adapter may hand over a whole reply at once: its first byte came so much earlier.
        begun = max(0.0, heard - (len(leg.first_bytes) - 1) * leg.byte_time)
        pause = leg.pause if leg.went_on_at < leg.begun_at else max(leg.pause, now - leg.went_on_at)
        packet = leg.timing is not exchange.timing
        # Only a learned window that is nearly missed says that the node has become slower; the document's says nothing,
        # not even where what was learned comes to as much: the node is as slow as it has always been.
        document = transaction.node.timings
        longest = (document.packet if packet else document.write if transaction.writes else document.read).window
        # A reply later than that teaches nothing: no learned window exceeds the document's. So a node that is always as
        # late is never trusted, has the document's times for good, and its late replies are delivered.
        if heard <= longest:
            learning.note(transaction.command, packet, begun, heard, max(0.0, pause - leg.latency), leg.byte_time)
        if leg.timing.silence is not None and LATE_SHARE * leg.timing.window < heard and leg.timing.window < longest:
            learning.was_late()

    def without_noise(self, data: bytes) -> bytes:
        """Return what is left of the first bytes of a reply where the profile tolerates noise before it."""
        assert self.exchange is not None
        return without_noise(self.exchange, data)

    def follow(self, step: Expect, now: float) -> Step[Any]:
        """Go from leg to leg for as long as the reader says so. Raises what the reader raises."""
        assert self.exchange is not None
        return follow(self.exchange, step, self._next_leg, now)

    def say(self, send: bytes, now: float) -> None:
        """Say what closes an exchange, or answers a packet that nobody asked for."""
        self.output.add(send, now)
        self.leg.say(len(send), now)

    def due_anew(self, now: float) -> float:
        """Return the deadline of the leg, where what was said has left only now."""
        leg = self.leg
        if leg.begun:
            return self.gap_over(now)
        return now + (leg.timing.window + leg.latency if self.answered else leg.timing.turnaround)

    def _next_leg(self, step: Expect, now: float) -> None:
        """Begin the next leg. Raises FrameError or Refused instead, where a repeat would hold the line past its limit
        or an urgent command (R9), or where the request may not be sent again."""
        transaction = self.transaction
        assert transaction is not None
        limit = transaction.node.profile.exchange_limit
        self.learn(now)  # before the next leg begins, which takes the place of this one's times
        if step.send and limit is not None:
            too_long = now - transaction.started > limit or self._urgent_waits()
            if too_long or not self._may_send_again(step, transaction, now):
                raise cast("Abandonable", self.exchange).abandon()
        self._deadlines.line = self.leg.begin(step.timing, len(step.send), step.sizes.longest, now)
        if step.send:
            self.output.add(step.send, now)

    def _may_send_again(self, step: Expect, transaction: Transaction, now: float) -> bool:
        """Return whether the exchange may send this, as far as it is its request: a NAK came.

        While a reply is overdue, the NAK may be that one (R15). Then this request has a reply under way, a second
        request would cause a second reply, and only one is accounted for: the other would confirm the next write, to
        whichever node. That holds for an idempotent write and for a read too. And a request is not repeated for a
        caller that has gone (R6): its write was reported as unconfirmed, or was overtaken by another one.
        """
        assert self.exchange is not None
        if step.send != self.exchange.request:
            return True
        return self._is_wanted(transaction) and not self._in_step.doubts_refusals(now)
