"""The exchange on the wire: its steps, reader, output and echo, and the replies it leaves overdue.

Calculates the times of one step of an exchange (R2 to R4). They are the latest begin of its reply, the longest reply,
and the time after which no byte of it can arrive. The states of the line are in arbiter.py.

All calculations of R3 are here. A node must meet two conditions. The *start bit* of its reply falls within
`max_reply_delay` of the last byte sent. A pause within the reply ends, with the next start bit, within
`inter_byte_timeout`. Bytes are received later than they start:

===============================  ===============================================================================
last transmission                latest time at which the last byte that it caused can be received
===============================  ===============================================================================
a request, one step              a silence of `quiet()` that ends at or after `end + max_reply_delay + latency`
                                 plus a byte time
a request, ACK received          the same from the end of that ACK, with the packet's `max_reply_delay` (MSC)
a request, ACK not received      the same; the packet's `max_reply_delay` counts from the request's end, and again
(MSC: it may be lost)            from each unexpected byte or failed reply: either may be the ACK, damaged
a request on an echoing port     the same; `end` is the last byte of its echo
a closing ACK                    when it is out; it has no reply
a broadcast                      when it is out, and `driver_release_time` later
===============================  ===============================================================================

`latency` is the time for which an adapter or a serial server can hold received bytes. One byte time is added because a
byte is received one byte time after its start bit. The silence includes both, because a pause within a frame looks
longer by them. `end` is the time at which the last sent byte is on the wire, behind all bytes that had not left before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from typing import Any, cast

from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.in_sync import InSync
from busmaster.arbiter.learned import LATE_SHARE
from busmaster.arbiter.transaction import Transaction
from busmaster.arbiter.unexpected import QUIET
from busmaster.contract.driver import follow, without_noise
from busmaster.contract.exchange import Abandonable, Exchange, Expect, LaterStep, Progress
from busmaster.contract.timing import ReplyTiming


class Echo:
    """Removes the echo of sent bytes from the input, byte by byte, across exchanges.

    MSC's closing ACK is echoed during the next exchange, so the pending echo outlives an exchange.
    """

    __slots__ = ("astray", "declared", "pending")

    def __init__(self, declared: bool) -> None:
        self.declared = declared
        self.pending = b""
        self.astray = False
        """An echo was incomplete and none has been complete since. Received bytes may be our own, which can look like a
        reply."""

    def sent(self, data: bytes) -> None:
        """Expect these bytes as echo, if the line is `declared` to echo."""
        if self.declared:
            self.pending += data

    def strip(self, data: bytes) -> bytes | None:
        """Return the bytes after the echo, or None if the echo differs from the sent bytes (a collision)."""
        # Compared up to the shorter length: an adapter may deliver the echo in pieces.
        pending = self.pending
        length = min(len(pending), len(data))
        if data[:length] != pending[:length]:
            # After a mismatch nothing can be separated from the echo: the other sender changed, removed or added bytes.
            # A search for the rest of the echo might find it in another node's reply.
            self.forget()
            return None
        self.pending = pending[length:]
        if not self.pending:  # echoes arrive in order, so no earlier echo is missing any more
            self.astray = False
        return data[length:]

    def forget(self) -> None:
        """Expect no further echo: the line resynchronises, which would discard it anyway."""
        if self.pending:
            self.pending = b""
            self.astray = True


UNKNOWN_MAX_REPLY_DELAY = 0.150
"""Assumed maximum reply delay, in seconds, of an earlier master's nodes while no node is known."""
TAINT_SHARE = 0.9
"""A reply cannot begin before this share of its request's own wire time (R4)."""


class Step:
    """The step on the wire, or the last one.

    `latency`: how long received bytes may lie in an adapter, in seconds. `byte_time` is tau, in seconds per byte.
    """

    __slots__ = (
        "_follows",
        "_follows_until",
        "begun",
        "begun_at",
        "byte_time",
        "end",
        "first_bytes",
        "heard",
        "latency",
        "longest",
        "out",
        "paced",
        "pause",
        "taint_until",
        "timing",
        "went_on_at",
    )

    def __init__(self, timing: ReplyTiming, latency: float, byte_time: float) -> None:
        self.timing = timing
        self.heard = False
        """Bytes may have been received since it was started, other than its echo."""
        self.begun = False
        self.begun_at = -inf
        """When the first byte of its reply was received."""
        self.first_bytes = b""
        """The bytes received at that moment."""
        self.pause = 0.0
        """The longest pause, in seconds, between two arrivals of its bytes."""
        self.went_on_at = -inf
        """When bytes were last received that did not complete the reply."""
        self.end = -inf
        """When the last byte of the request is on the wire. The maximum reply delay counts from here."""
        self.out = -inf
        """When all sent bytes are on the wire, including a closing ACK."""
        self.latency = latency
        self.byte_time = byte_time
        self._follows: ReplyTiming | None = None
        self._follows_until = -inf
        self.longest = 0
        """Maximum length of its reply, in bytes."""
        self.paced = False
        """Bytes leave at the baud rate and are not echoed. Bytes that arrive too early cannot be a reply (R4)."""
        self.taint_until = -inf
        """Bytes received before this time cannot be its reply."""

    def add_sent(self, count: int, now: float) -> None:
        """Add the wire time of `count` bytes, sent behind all earlier ones."""
        # Behind all earlier bytes: MSC's closing ACK and the next request are written in one call.
        self.out = max(self.out, now) + count * self.byte_time

    def begin(self, timing: ReplyTiming, sent: int, longest: int, now: float) -> float:
        """Start a step: `sent` bytes sent, at most `longest` bytes of reply. Returns when the reply must have begun."""
        self.timing = timing
        self.longest = longest
        self.heard = False
        self.begun = False
        self.pause = 0.0
        out = self.out
        # no calls of `max`: this runs for every request
        self.out = self.end = end = (out if out > now else now) + sent * self.byte_time
        if self.paced and sent:  # if nothing is sent, the node continues by itself: MSC's packet follows its ACK
            self.taint_until = now + TAINT_SHARE * sent * self.byte_time
        return end + timing.window + self.latency

    def gap_over(self, now: float) -> float:
        """Return when the reply must continue after a byte received now. A slow stream of bytes cannot hold the
        line."""
        timing, latency, byte_time = self.timing, self.latency, self.byte_time
        # A byte is received at its end and may be held in the adapter, so both times are added to the allowed pause.
        due = now + timing.inter_byte_timeout + latency + byte_time
        latest = self.end + timing.window + latency
        if self.begun_at > latest:  # a reply that began after its window has its length counted from its first byte
            latest = self.begun_at
        # R2: without this limit, a node that sends one byte per 20 ms would hold the line for ever.
        limit = latest + self.longest * byte_time + timing.inter_byte_timeout
        return due if due < limit else limit

    def note_pause(self, now: float) -> None:
        """Record bytes that did not complete the reply, for a node whose times are learned."""
        if self.went_on_at >= self.begun_at and now - self.went_on_at > self.pause:
            self.pause = now - self.went_on_at
        self.went_on_at = now

    def echoed(self, now: float) -> float:
        """Restart the step's times at the end of its echo. Returns when the reply must begin."""
        # The echo shows when the request was really on the wire, which is more exact than the calculation.
        self.shift(now - self.end)
        return now + self.timing.window + self.latency

    def shift(self, seconds: float) -> None:
        """Move the step's times: the sent bytes left this many seconds later than calculated."""
        self.end += seconds
        self.out += seconds
        self.taint_until += seconds

    def wire_time(self) -> float:
        """Return the time, in seconds, that the longest reply needs on the wire."""
        return self.longest * self.byte_time

    def quiet(self) -> float:
        """Return the silence, in seconds, after which no further byte of a frame can arrive."""
        timing = self.timing
        # The documented pause, also where a shorter one was learned: the rest of a reply could otherwise arrive in the
        # next reply, and the two could make a frame whose checksum is right (docs/proof.md, 23).
        pause = timing.inter_byte_timeout if timing.silence is None else timing.silence
        return max(QUIET, pause) + self.latency + self.byte_time

    def silent_at(self, last_byte: float) -> float:
        """Return when no further byte of a frame can arrive. `last_byte`: when the last byte was received."""
        # Our own bytes count as well: a two-wire adapter does not receive while it transmits.
        if self.heard or self.timing.silence is None:
            return max(last_byte, self.out) + self.quiet()
        # What may still arrive is a whole reply, and that is tracked as overdue (R15).
        return max(last_byte, self.out) + self.timing.inter_byte_timeout + self.latency + self.byte_time

    def give_up(self, later: Sequence[LaterStep]) -> None:
        """Stop waiting for the reply, which may still arrive.

        Its node then continues with those `later` steps that need no transmission by the host (MSC: the packet after
        its ACK).
        """
        # An MSC that has sent its ACK also sends its packet, although the host has given up the exchange.
        self._follows = later[0].timing if later and not later[0].sent else None
        if self._follows is not None:
            self._follows_until = self._past(self.end, self._follows)

    def answered(self) -> None:
        """Correct the end of the request if the reply began earlier: some ports do not keep to the baud rate."""
        if self.end > self.begun_at:
            self.end = self.out = self.begun_at

    def came_unexpected(self, now: float) -> float:
        """Handle unexpected bytes, and return `past`.

        They may be the reply that was given up, after which its next step begins. Or they are noise, and the next step
        is still to come. Both are possible until the line has resynchronised.
        """
        if self._follows is not None:
            self._follows_until = max(self._follows_until, self._past(now, self._follows))
        return self.past()

    def resynchronised(self) -> None:
        """Note that no byte of the step can arrive any more."""
        self._follows = None

    def last_begin(self) -> float:
        """Return the latest time at which the reply to this step can begin. A later step may still follow it."""
        return self._past(self.end, self.timing)

    def past(self) -> float:
        """Return the time after which no reply to the step can begin (R3) and the node has released the line (R1).

        This holds even if the reply was lost.
        """
        past = self.last_begin()
        if self.longest:
            # R1: the driver of the node holds the line even if its reply was lost on the way.
            past += self.timing.driver_release_time
        return past if self._follows is None else max(past, self._follows_until)

    def _past(self, end: float, timing: ReplyTiming) -> float:
        return end + timing.max_reply_delay + self.latency + self.byte_time


HELD_LOOK = 0.002
"""Seconds between two queries of a port that holds sent bytes back."""


class Output:
    """The bytes to send on one line, and how the times of its step depend on when they leave."""

    __slots__ = ("_echo", "_step", "begins", "held", "sent_at", "waiting")

    def __init__(self, step: Step, echo: Echo) -> None:
        self.waiting = b""
        """Bytes not handed to the port yet."""
        self._step = step
        self._echo = echo
        self.held = False
        """The port had not sent all bytes when it was last queried."""
        self.sent_at = -inf
        """The time from which the step of the last transmission is calculated."""
        self.begins = False
        """The last transmission contains a request, which starts when the port takes it."""

    def add(self, data: bytes, now: float) -> None:
        """Append bytes to the output."""
        # A closing ACK alone starts no request; in front of one it does not hide it.
        self.begins = self.begins and bool(self.waiting)
        self.waiting += data
        self.sent_at = now
        if self._echo.declared:
            self._echo.sent(data)

    def discard(self) -> None:
        """Drop bytes that were not handed over. Bytes held by the port are lost with it."""
        self.waiting = b""
        self.held = False

    def unsent(self, count: int, now: float) -> float | None:
        """Record how many bytes have not left. Returns when to query again; None if all had left before, inf if just
        now."""
        # At most every 2 ms: with flow control off for a second, more would be thousands of calls.
        if count:
            self.held = True
            return now + max(count * self._step.byte_time, HELD_LOOK)
        if not self.held:
            return None
        self.held = False
        # R2: the windows of this request count from now. It was held back for an unknown part of the time since the
        # write.
        self._step.shift(max(0.0, now - self._step.out))
        return inf


class OnWire:
    """The exchange of one line. `transaction` and `exchange` are None between requests; `step` and `output` persist."""

    __slots__ = (
        "_deadlines",
        "_echo",
        "_in_sync",
        "_is_wanted",
        "_urgent_waits",
        "answered",
        "came_unexpected",
        "exchange",
        "output",
        "step",
        "transaction",
    )

    def __init__(
        self,
        step: Step,
        echo: Echo,
        deadlines: Deadlines,
        in_sync: InSync,
        urgent_waits: Callable[[], bool],
        is_wanted: Callable[[Transaction], bool],
    ) -> None:
        self.transaction: Transaction | None = None
        self.exchange: Exchange[Any] | None = None
        self.answered = True
        """A reply to `exchange` is expected: it is not a broadcast."""
        self.step = step
        self.output = Output(step, echo)
        self.came_unexpected = False
        """Bytes were received during a broadcast, which has no reply."""
        self._echo = echo
        self._deadlines = deadlines
        self._in_sync = in_sync
        self._urgent_waits = urgent_waits
        self._is_wanted = is_wanted

    def begin(self, transaction: Transaction, exchange: Exchange[Any], now: float) -> None:
        """Send the request of an exchange and set the deadline of its first step."""
        self.transaction = transaction
        self.exchange = exchange
        self.answered = answered = exchange.answered
        self.came_unexpected = False
        step = self.step
        request, timing = exchange.request, exchange.timing
        due = step.begin(timing, len(request), exchange.sizes.longest, now)
        self._deadlines.line = due if answered else step.end + timing.driver_release_time
        output = self.output  # same as `output.add`, written out: this runs for every request
        # `waiting` is nearly always empty, and the test is faster than adding to it
        output.waiting = output.waiting + request if output.waiting else request
        output.sent_at = now
        output.begins = True
        if self._echo.declared:
            self._echo.sent(request)

    def gap_over(self, now: float) -> float:
        """Return when the reply must continue after a byte received now."""
        assert self.transaction is not None
        if self.transaction.node.learning is not None:
            self.step.note_pause(now)
        return self.step.gap_over(now)

    def learn(self, now: float) -> None:
        """Update the node's learned times from the reply to the finished step."""
        transaction, exchange, step = self.transaction, self.exchange, self.step
        assert transaction is not None
        assert exchange is not None
        learning = transaction.node.learning
        if learning is None or not step.begun:
            return
        heard = max(0.0, step.begun_at - step.end - step.latency)
        # An adapter may deliver a whole reply at once: its first byte arrived earlier by the others' wire time.
        begun = max(0.0, heard - (len(step.first_bytes) - 1) * step.byte_time)
        pause = step.pause if step.went_on_at < step.begun_at else max(step.pause, now - step.went_on_at)
        packet = step.timing is not exchange.timing
        # Only a reply near the end of a learned window shows that the node has become slower. The documented window
        # shows nothing, even if the learned value reaches it: the node is as slow as before.
        document = transaction.node.timings
        longest = (document.packet if packet else document.write if transaction.writes else document.read).window
        # A later reply is not used: a learned window never exceeds the documented one. A node that is always this late
        # keeps the documented times, and its late replies are delivered.
        if heard <= longest:
            learning.note(transaction.command, packet, begun, heard, max(0.0, pause - step.latency), step.byte_time)
        if step.timing.silence is not None and LATE_SHARE * step.timing.window < heard and step.timing.window < longest:
            learning.was_late()

    def without_noise(self, data: bytes) -> bytes:
        """Return the first bytes of a reply without leading noise, if the profile tolerates noise."""
        assert self.exchange is not None
        return without_noise(self.exchange, data)

    def follow(self, progress: Expect, now: float) -> Progress[Any]:
        """Run the steps that follow as long as the reader continues. Raises what the reader raises."""
        assert self.exchange is not None
        return follow(self.exchange, progress, self._next_step, now)

    def send(self, send: bytes, now: float) -> None:
        """Send bytes that close an exchange, or acknowledge an unexpected packet."""
        self.output.add(send, now)
        self.step.add_sent(len(send), now)

    def due_anew(self, now: float) -> float:
        """Return the deadline of the step, counted from now, because the sent bytes have only just left."""
        step = self.step
        if step.begun:
            return self.gap_over(now)
        return now + (step.timing.window + step.latency if self.answered else step.timing.driver_release_time)

    def _next_step(self, progress: Expect, now: float) -> None:
        """Start the next step.

        Raises FrameError or Refused if a repetition would exceed the exchange limit or delay an urgent command (R9), or
        if the request must not be sent again.
        """
        transaction = self.transaction
        assert transaction is not None
        limit = transaction.node.profile.exchange_limit
        self.learn(now)  # before the next step begins, which overwrites this one's times
        if progress.send and limit is not None:
            too_long = now - transaction.started > limit or self._urgent_waits()
            if too_long or not self._may_send_again(progress, transaction, now):
                raise cast("Abandonable", self.exchange).abandon()
        self._deadlines.line = self.step.begin(progress.timing, len(progress.send), progress.sizes.longest, now)
        self.step.heard = True  # its first bytes may have arrived with the last of the step before
        if progress.send:
            self.output.add(progress.send, now)

    def _may_send_again(self, progress: Expect, transaction: Transaction, now: float) -> bool:
        """Return True if the exchange may send this. It matters only for its request, repeated after a NAK.

        While a reply is overdue, the NAK may be that reply (R15). Then the first request still has a reply on the way,
        and a second request causes a second one. Only one is accounted for; the other would confirm the next write to
        any node. That applies to idempotent writes and to reads too. A request is also not repeated if its caller was
        cancelled (R6): its write was reported as unconfirmed, or was overtaken.
        """
        assert self.exchange is not None
        if progress.send != self.exchange.request:
            return True
        return self._is_wanted(transaction) and not self._in_sync.refusals_are_ambiguous(now)
