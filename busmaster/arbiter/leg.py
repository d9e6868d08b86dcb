"""The times of one leg of an exchange (R2-R4): when its reply may begin, how long it may last, when it is past.

All of R3's reckoning is here. Assumed of a node: its reply's *start bit* falls within `lateness` of the last byte sent,
and a pause within it ends, with the next start bit, within `byte_gap`. What is received of it comes later than that:

===============================  ==========================================================================
what was said last               when the last byte that it caused can have been received, at the latest
===============================  ==========================================================================
a request, one leg               a silence of `quiet()` that ends at or after `end + lateness + latency + byte time`
a request whose ACK was heard    likewise from the end of that ACK, with the packet's lateness (MSC)
a request whose ACK was not      likewise; the packet's lateness counts from the request's end, and anew from
heard (MSC: it may be lost)      each unasked byte, and what came for it: either may be the ACK, damaged
a request on an echoing port     likewise, `end` being the last byte of its echo
a closing ACK                    when it is out; nothing answers it
a broadcast                      when it is out, and `turnaround` later
===============================  ==========================================================================

`latency` is what an adapter or a server may hold bytes back; one byte time is added because a start bit in time is
received as a byte only that much later; and the silence reckons with both, since a pause within a frame looks longer
by them. `end` is when the last byte said is on the wire, behind all that was said before it and had not left.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from busmaster.arbiter.unasked import QUIET
from busmaster.contract.exchange import LaterLeg
from busmaster.contract.timing import ReplyTiming

UNKNOWN_LATENESS = 0.150
"""Assumed of an earlier master's nodes while none is known."""
TAINT_SHARE = 0.9
"""A reply cannot begin before this share of its request's own wire time (R4)."""


class Leg:
    """The leg on the wire, or the last one.

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
        """When the last byte of the request is on the wire: lateness counts from there."""
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
        """Begin a leg of `said` bytes, a reply of at most `longest`, and return when the reply must have begun."""
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
        due = now + timing.byte_gap + latency + byte_time
        latest = self.end + timing.window + latency
        if self.begun_at > latest:  # it began late
            latest = self.begun_at
        limit = latest + self.longest * byte_time + timing.byte_gap
        return due if due < limit else limit

    def note_pause(self, now: float) -> None:
        """Note that bytes of the reply came now, which do not complete it, where its node's times are learned."""
        if self.went_on_at >= self.begun_at and now - self.went_on_at > self.pause:
            self.pause = now - self.went_on_at
        self.went_on_at = now

    def echoed(self, now: float) -> float:
        """Start the leg's times here, where the last byte of its echo came. Returns when its reply must begin."""
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
            silence = max(QUIET, self.timing.byte_gap)
        return silence + self.latency + self.byte_time

    def give_up(self, later: Sequence[LaterLeg]) -> None:
        """Stop waiting for the reply. It may still come; then its node goes on by itself with those of the `later` legs
        that need no word from the host (MSC: the packet after its ACK)."""
        self._follows = later[0].timing if later and not later[0].sent else None
        if self._follows is not None:
            self._follows_until = self._past(self.end, self._follows)

    def answered(self) -> None:
        """Note that what was answered has left, whatever the baud rate says: not every port keeps to it."""
        if self.end > self.begun_at:
            self.end = self.out = self.begun_at

    def came_unasked(self, now: float) -> float:
        """Note that something came: perhaps the reply that was given up, and its next leg begins here. Or it was noise,
        and the next leg is still to come after that: what is known of it is kept until the line has settled. Returns
        `past`."""
        if self._follows is not None:
            self._follows_until = max(self._follows_until, self._past(now, self._follows))
        return self.past()

    def settled(self) -> None:
        """Note that nothing of the leg can come any more."""
        self._follows = None

    def last_begin(self) -> float:
        """Return from when on a reply that has not begun never comes: a later leg may follow it all the same."""
        return self._past(self.end, self.timing)

    def past(self) -> float:
        """Return from when on no byte of a reply to it can be the first one that is received (R3)."""
        past = self.last_begin()
        return past if self._follows is None else max(past, self._follows_until)

    def _past(self, end: float, timing: ReplyTiming) -> float:
        return end + timing.lateness + self.latency + self.byte_time
