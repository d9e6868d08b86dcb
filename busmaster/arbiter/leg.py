"""The times of one leg of an exchange (R2-R4): when its reply may begin, how long it may last, when it is past."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from busmaster.arbiter.strays import QUIET
from busmaster.exchange import Leg as LaterLeg
from busmaster.exchange import ReplyTiming

TAINT_SHARE = 0.9
"""A reply cannot begin before this share of its request's own wire time (R4)."""


class Leg:
    """The leg on the wire, or the last one. `latency`: how long received bytes may lie in an adapter, in seconds."""

    __slots__ = ("_follows", "_limit", "begun", "end", "late_after", "latency", "taint_until", "timing")

    def __init__(self, timing: ReplyTiming, latency: float) -> None:
        self.timing = timing
        self.begun = False
        self.end = -inf
        """When the last byte sent is on the wire."""
        self.latency = latency
        self._follows: ReplyTiming | None = None
        self._limit = inf
        self.taint_until = -inf
        """What comes before cannot be its reply."""
        self.late_after = -inf
        """A reply that begins then is late, and counts all the same."""

    def begin(self, timing: ReplyTiming, said: float, longest: float, now: float) -> float:
        """The host says something that takes `said` seconds; the longest reply takes `longest`. When it must begin."""
        self.timing = timing
        self.begun = False
        self._follows = None
        self.end = end = now + said
        latency = self.latency
        self.late_after = end + timing.nominal + latency
        due = end + timing.window + latency
        self._limit = due + longest + timing.byte_gap
        return due

    def taint(self, said: float, now: float) -> None:
        """On a paced line: bytes that come before most of the request is out cannot be its reply."""
        self.taint_until = now + TAINT_SHARE * said

    def gap_over(self, now: float) -> float:
        """When the reply, of which a byte came now, must go on; a trickle cannot hold the line."""
        due = now + self.timing.byte_gap + self.latency
        return due if due < self._limit else self._limit

    def echoed(self, now: float) -> float:
        """The last byte of its echo came: its times start here. When its reply must begin."""
        self._limit += now - self.end
        self.late_after += now - self.end
        self.end = now
        return now + self.timing.window + self.latency

    def quiet(self) -> float:
        """The silence, in seconds, after which nothing more of a frame can come."""
        return max(QUIET, self.timing.byte_gap)

    def give_up(self, later: Sequence[LaterLeg]) -> None:
        """Its reply may still come; then its node goes on by itself with those of the `later` legs that need no word
        from the host (MSC: the packet after its ACK)."""
        self._follows = later[0].timing if later and not later[0].sent else None

    def strayed(self, now: float) -> None:
        """Something came: perhaps the reply that was given up, and its next leg begins here."""
        if self._follows is not None:
            self.timing, self.end, self._follows = self._follows, now, None

    def past(self) -> float:
        """From then on, no reply to it can begin (R3)."""
        return self.end + self.timing.lateness + self.latency
