"""The exchange on the wire: its steps, its reader, its output and echo, and what it leaves overdue. The states of the
line are in arbiter.py.

The times of one step of an exchange (R2-R4): when its reply may begin, how long it may last, when it is past.

All of R3's calculation is here. Assumed of a node: its reply's *start bit* falls within `max_reply_delay` of the last
byte sent, and a pause within it ends, with the next start bit, within `inter_byte_timeout`. What is received of it
comes later than that:

===============================  ===============================================================================
what was said last               when the last byte that it caused can have been received, at the latest
===============================  ===============================================================================
a request, one step              a silence of `quiet()` that ends at or after `end + max_reply_delay + latency`
                                 plus a byte time
a request whose ACK was heard    likewise from the end of that ACK, with the packet's `max_reply_delay` (MSC)
a request whose ACK was not      likewise; the packet's `max_reply_delay` counts from the request's end, and anew
heard (MSC: it may be lost)      from each unexpected byte, and what came for it: either may be the ACK, damaged
a request on an echoing port     likewise, `end` being the last byte of its echo
a closing ACK                    when it is out; nothing answers it
a broadcast                      when it is out, and `driver_release_time` later
===============================  ===============================================================================

`latency` is what an adapter or a server may hold bytes back; one byte time is added because a start bit in time is
received as a byte only that much later; and the silence includes both, since a pause within a frame looks longer
by them. `end` is when the last byte said is on the wire, behind all that was said before it and had not left.
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
    """Takes the echo of what was sent off the front of what comes, byte for byte, across exchanges.

    MSC's closing ACK echoes into the next exchange, so the pending echo outlives an exchange.
    """

    __slots__ = ("astray", "declared", "pending")

    def __init__(self, declared: bool) -> None:
        self.declared = declared
        self.pending = b""
        self.astray = False
        """An echo did not come whole, nor did one after it: what comes may be our own words, which can look like
        somebody's reply."""

    def sent(self, data: bytes) -> None:
        """Expect what was sent to come back, if the line is `declared` to echo."""
        if self.declared:
            self.pending += data

    def strip(self, data: bytes) -> bytes | None:
        """Return what came after the echo; None where the echo differs from what was sent: a collision."""
        # Compared as far as both go: an adapter may hand over the echo in pieces.
        pending = self.pending
        length = min(len(pending), len(data))
        if data[:length] != pending[:length]:
            # Nothing after this can be told from echo: who else was talking changed, ate or added bytes. Looking for
            # where the echo goes on would be searching, and might find it in somebody's reply.
            self.forget()
            return None
        self.pending = pending[length:]
        if not self.pending:  # echoes come in order: nothing is to come of those before
            self.astray = False
        return data[length:]

    def forget(self) -> None:
        """Expect no more echo: the line resynchronises, and what is still pending would be discarded anyway."""
        if self.pending:
            self.pending = b""
            self.astray = True


UNKNOWN_MAX_REPLY_DELAY = 0.150
"""Assumed of an earlier master's nodes while none is known."""
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
        self.begun = False
        self.begun_at = -inf
        """When the first byte of its reply was received."""
        self.first_bytes = b""
        """What came then, at once."""
        self.pause = 0.0
        """The longest pause, in seconds, between two arrivals of its bytes."""
        self.went_on_at = -inf
        """When bytes of it came that did not complete it."""
        self.end = -inf
        """When the last byte of the request is on the wire: maximum reply delay counts from there."""
        self.out = -inf
        """When all that was said is on the wire, a closing ACK too."""
        self.latency = latency
        self.byte_time = byte_time
        self._follows: ReplyTiming | None = None
        self._follows_until = -inf
        self.longest = 0
        """Bytes that its reply can have."""
        self.paced = False
        """Bytes leave at the baud rate, and no echo of them comes: what comes too early cannot be a reply (R4)."""
        self.taint_until = -inf
        """What comes before cannot be its reply."""

    def say(self, count: int, now: float) -> None:
        """Note that the host says so many bytes, behind what it has said already."""
        self.out = max(self.out, now) + count * self.byte_time

    def begin(self, timing: ReplyTiming, said: int, longest: int, now: float) -> float:
        """Begin a step of `said` bytes, a reply of at most `longest`, and return when the reply must have begun."""
        self.timing = timing
        self.longest = longest
        self.begun = False
        self.pause = 0.0
        out = self.out
        # no calls of `max`: this is done for every request
        self.out = self.end = end = (out if out > now else now) + said * self.byte_time
        if self.paced and said:  # where nothing is said the node goes on by itself: MSC's packet follows its ACK
            self.taint_until = now + TAINT_SHARE * said * self.byte_time
        return end + timing.window + self.latency

    def gap_over(self, now: float) -> float:
        """Return when the reply, of which a byte came now, must go on; a trickle cannot hold the line."""
        timing, latency, byte_time = self.timing, self.latency, self.byte_time
        # A byte is received when it is over, and it may lie in the adapter: both are added to the pause that is
        # allowed.
        due = now + timing.inter_byte_timeout + latency + byte_time
        latest = self.end + timing.window + latency
        if self.begun_at > latest:  # it began late
            latest = self.begun_at
        limit = latest + self.longest * byte_time + timing.inter_byte_timeout
        return due if due < limit else limit

    def note_pause(self, now: float) -> None:
        """Note that bytes of the reply came now, which do not complete it, where its node's times are learned."""
        if self.went_on_at >= self.begun_at and now - self.went_on_at > self.pause:
            self.pause = now - self.went_on_at
        self.went_on_at = now

    def echoed(self, now: float) -> float:
        """Start the step's times here, where the last byte of its echo came. Returns when its reply must begin."""
        self.shift(now - self.end)
        return now + self.timing.window + self.latency

    def shift(self, seconds: float) -> None:
        """Note that what was said is out so many seconds later than was thought."""
        self.end += seconds
        self.out += seconds
        self.taint_until += seconds

    def quiet(self) -> float:
        """Return the silence, in seconds, after which nothing more of a frame can come, or is awaited."""
        silence = self.timing.silence
        if silence is None:
            silence = max(QUIET, self.timing.inter_byte_timeout)
        return silence + self.latency + self.byte_time

    def give_up(self, later: Sequence[LaterStep]) -> None:
        """Stop waiting for the reply. It may still come; then its node goes on by itself with those of the `later`
        steps that need no word from the host (MSC: the packet after its ACK)."""
        # An MSC that has sent its ACK sends its packet too, although the host has given the exchange up.
        self._follows = later[0].timing if later and not later[0].sent else None
        if self._follows is not None:
            self._follows_until = self._past(self.end, self._follows)

    def answered(self) -> None:
        """Note that what was answered has left, whatever the baud rate says: not every port keeps to it."""
        if self.end > self.begun_at:
            self.end = self.out = self.begun_at

    def came_unexpected(self, now: float) -> float:
        """Note that something came: perhaps the reply that was given up, and its next step begins here. Or it was
        noise, and the next step is still to come after that: what is known of it is kept until the line has
        resynchronised. Returns `past`."""
        if self._follows is not None:
            self._follows_until = max(self._follows_until, self._past(now, self._follows))
        return self.past()

    def resynchronised(self) -> None:
        """Note that nothing of the step can come any more."""
        self._follows = None

    def last_begin(self) -> float:
        """Return from when on a reply that has not begun never comes: a later step may follow it all the same."""
        return self._past(self.end, self.timing)

    def past(self) -> float:
        """Return from when on no byte of a reply to it can be the first one that is received (R3), and the driver of
        the node has let go of the line (R1), also behind a reply that was lost."""
        past = self.last_begin()
        if self.longest:
            past += self.timing.driver_release_time
        return past if self._follows is None else max(past, self._follows_until)

    def _past(self, end: float, timing: ReplyTiming) -> float:
        return end + timing.max_reply_delay + self.latency + self.byte_time


HELD_LOOK = 0.002
"""Seconds after which a port that holds what was said is asked again."""


class Output:
    """The bytes to be sent on one line, and the times of its step that follow from when they leave."""

    __slots__ = ("_echo", "_step", "begins", "held", "said_at", "waiting")

    def __init__(self, step: Step, echo: Echo) -> None:
        self.waiting = b""
        """What the port has not been handed yet."""
        self._step = step
        self._echo = echo
        self.held = False
        """The port had not sent all of it when it was asked last."""
        self.said_at = -inf
        """The time from which the step of what was said last is calculated."""
        self.begins = False
        """What was said last holds a request: it starts when the port takes it."""

    def add(self, data: bytes, now: float) -> None:
        """Say these bytes next."""
        self.begins = self.begins and bool(self.waiting)
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
        # Not more often than every 2 ms: with flow control off for a second that would be thousands of calls.
        if count:
            self.held = True
            return now + max(count * self._step.byte_time, HELD_LOOK)
        if not self.held:
            return None
        self.held = False
        self._step.shift(max(0.0, now - self._step.out))
        return inf


class OnWire:
    """Of one line. `transaction` and `exchange` are None while nothing is asked; `step` and `output` outlive them."""

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
        """An answer to `exchange` is due: it is no broadcast."""
        self.step = step
        self.output = Output(step, echo)
        self.came_unexpected = False
        """Bytes came though no answer was due (a broadcast's)."""
        self._echo = echo
        self._deadlines = deadlines
        self._in_sync = in_sync
        self._urgent_waits = urgent_waits
        self._is_wanted = is_wanted

    def begin(self, transaction: Transaction, exchange: Exchange[Any], now: float) -> None:
        """Say its request, and set the deadline of its first step."""
        self.transaction = transaction
        self.exchange = exchange
        self.answered = answered = exchange.answered
        self.came_unexpected = False
        step = self.step
        request, timing = exchange.request, exchange.timing
        due = step.begin(timing, len(request), exchange.sizes.longest, now)
        self._deadlines.line = due if answered else step.end + timing.driver_release_time
        output = self.output  # as output.add does: this is done for every request
        # nearly always nothing waits, and to add to nothing takes longer than to ask
        output.waiting = output.waiting + request if output.waiting else request
        output.said_at = now
        output.begins = True
        if self._echo.declared:
            self._echo.sent(request)

    def gap_over(self, now: float) -> float:
        """Return when the reply, of which a byte came now, must go on."""
        assert self.transaction is not None
        if self.transaction.node.learning is not None:
            self.step.note_pause(now)
        return self.step.gap_over(now)

    def learn(self, now: float) -> None:
        """Let its node's times be learned from the reply to this step, which is over."""
        transaction, exchange, step = self.transaction, self.exchange, self.step
        assert transaction is not None
        assert exchange is not None
        learning = transaction.node.learning
        if learning is None or not step.begun:
            return
        heard = max(0.0, step.begun_at - step.end - step.latency)
        # An adapter may hand over a whole reply at once: its first byte came so much earlier.
        begun = max(0.0, heard - (len(step.first_bytes) - 1) * step.byte_time)
        pause = step.pause if step.went_on_at < step.begun_at else max(step.pause, now - step.went_on_at)
        packet = step.timing is not exchange.timing
        # Only a learned window that is nearly missed says that the node has become slower; the document's says nothing,
        # not even where what was learned comes to as much: the node is as slow as it has always been.
        document = transaction.node.timings
        longest = (document.packet if packet else document.write if transaction.writes else document.read).window
        # A reply later than that teaches nothing: no learned window exceeds the document's. So a node that is always as
        # late is never trusted, has the document's times for good, and its late replies are delivered.
        if heard <= longest:
            learning.note(transaction.command, packet, begun, heard, max(0.0, pause - step.latency), step.byte_time)
        if step.timing.silence is not None and LATE_SHARE * step.timing.window < heard and step.timing.window < longest:
            learning.was_late()

    def without_noise(self, data: bytes) -> bytes:
        """Return what is left of the first bytes of a reply where the profile tolerates noise before it."""
        assert self.exchange is not None
        return without_noise(self.exchange, data)

    def follow(self, progress: Expect, now: float) -> Progress[Any]:
        """Go from step to step for as long as the reader says so. Raises what the reader raises."""
        assert self.exchange is not None
        return follow(self.exchange, progress, self._next_step, now)

    def say(self, send: bytes, now: float) -> None:
        """Say what closes an exchange, or answers a packet that nobody asked for."""
        self.output.add(send, now)
        self.step.say(len(send), now)

    def due_anew(self, now: float) -> float:
        """Return the deadline of the step, where what was said has left only now."""
        step = self.step
        if step.begun:
            return self.gap_over(now)
        return now + (step.timing.window + step.latency if self.answered else step.timing.driver_release_time)

    def _next_step(self, progress: Expect, now: float) -> None:
        """Begin the next step. Raises FrameError or Refused instead, where a repeat would hold the line past its limit
        or an urgent command (R9), or where the request may not be sent again."""
        transaction = self.transaction
        assert transaction is not None
        limit = transaction.node.profile.exchange_limit
        self.learn(now)  # before the next step begins, which takes the place of this one's times
        if progress.send and limit is not None:
            too_long = now - transaction.started > limit or self._urgent_waits()
            if too_long or not self._may_send_again(progress, transaction, now):
                raise cast("Abandonable", self.exchange).abandon()
        self._deadlines.line = self.step.begin(progress.timing, len(progress.send), progress.sizes.longest, now)
        if progress.send:
            self.output.add(progress.send, now)

    def _may_send_again(self, progress: Expect, transaction: Transaction, now: float) -> bool:
        """Return whether the exchange may send this, as far as it is its request: a NAK came.

        While a reply is overdue, the NAK may be that one (R15). Then this request has a reply under way, a second
        request would cause a second reply, and only one is accounted for: the other would confirm the next write, to
        whichever node. That holds for an idempotent write and for a read too. And a request is not repeated for a
        caller that has gone (R6): its write was reported as unconfirmed, or was overtaken by another one.
        """
        assert self.exchange is not None
        if progress.send != self.exchange.request:
            return True
        return self._is_wanted(transaction) and not self._in_sync.refusals_are_ambiguous(now)
