"""Reply windows that are learned from a node's own replies.

Documented windows suit the slowest possible node: a lost reply costs as much on a node that answers in 2 ms as on one
that takes 100 ms. If learning is enabled, a read that can be repeated waits only as long as this node has recently
needed, with a good margin. Then the line continues, although the reply may still arrive.

R15 makes this safe, not the window: from then on the reply is *overdue*, for the documented maximum reply delay and
longer. Until the node has answered another request, no reply that could be mistaken for it is delivered, and no write
and no broadcast is sent. No result that a caller gets depends on a learned time either. Writes and the last attempt of
a read have the documented window, and are sent only when no reply is awaited any more. Probes, and all requests to a
node that has failed and not answered since, have the documented times.

The window is calculated for each kind of command (its type) and for each of its two steps (the reply; MSC's packet
after its ACK). It is 1.5 times the longest reply time of the last 500 to 1000 replies plus 2 ms. If the longest time
until the first bytes were delivered is more than those 1.5 times, that time is used (an adapter may deliver a whole
reply at once). It is at least 5 ms and at most the documented window. It is trusted after 200 replies. The second
attempt of a read has twice that window. The silence after which a reply has ended incomplete is twice the longest pause
within those replies, and at least 17 bytes. The next request then still waits for the documented silence. (A smoothed
mean and deviation, as in TCP, follows the usual reply too closely: of 76,000 replies it missed 1236, the maximum none.)

The documented times apply again for 20 replies if a node replied after three quarters of a learned window that is
shorter than the documented one, or after that window. That is enough to distinguish a node that has become slower from
one late reply. A node that was away has them for 200 replies, because it may be another device.

Times are only added, subtracted, compared and multiplied by constants here.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import inf

from busmaster.contract.timing import ReplyTiming, Timings

TRUSTED_AFTER = 200
"""Replies of a kind after which its times are trusted."""
TRUSTED_AGAIN_AFTER = 20
"""The same if times of an earlier run are known, or after a late reply."""
EPOCH = 500
"""Replies per epoch. The maximum of the current and the last epoch counts."""
MARGIN = 0.002
"""Seconds added to the longest observed time."""
SLOWER = 1.5
"""Factor on the slowest reply time. A larger one makes each lost frame cost more; a smaller one gives up replies that
are only slightly later than any before."""
LEAST = 0.005
"""Shortest window, in seconds: a process can be suspended for longer than anything below it."""
AT_FIRST, AGAIN, AT_LAST, NEVER = 1, 2, 10**9, 0
"""Factor on the learned window for an attempt; the documented window is the maximum. AT_LAST: the last attempt, with
the documented window. NEVER: documented window and silence."""
LATE_SHARE = 0.75
"""Share of a learned window after which a reply shows that the node has become slower."""
LEAST_SILENCE = 17
"""Shortest silence that ends a reply, in bytes: a UART delivers up to 16 at once."""


@dataclass(frozen=True, slots=True)
class LearnedTimes:
    """Learned times of one node for one kind of command, in seconds.

    `slowest`: longest reply time to the first byte in the last 500 to 1000 replies. `received`: longest time until the
    first bytes were delivered. `pause`: longest pause within a reply. `window`: the window used once it is `trusted`.
    """

    kind: str
    packet: bool
    slowest: float
    received: float
    pause: float
    window: float
    trusted: bool


def window_of(slowest: float, heard: float) -> float:
    """Return the window, in seconds, for these times; see `LearnedTimes`."""
    return max(LEAST, max(SLOWER * slowest, heard) + MARGIN)


class _Largest:
    """Maximum of the current and the last epoch."""

    __slots__ = ("before", "now")

    def __init__(self) -> None:
        self.now = self.before = 0.0

    @property
    def value(self) -> float:
        """The largest of both epochs."""
        return max(self.now, self.before)

    def turn(self) -> None:
        """Begin the next epoch."""
        # The maximum of an epoch counts for one more epoch, so an unusually late reply is forgotten after 1000 replies
        # at most.
        self.before, self.now = self.now, 0.0


class StepTimes:
    """The reply times of one step of one kind of command."""

    __slots__ = ("_left", "doubts", "heard", "pause", "slowest")

    def __init__(self) -> None:
        self.slowest = _Largest()
        self.heard = _Largest()
        self.pause = _Largest()
        self._left = EPOCH
        self.doubts = TRUSTED_AFTER
        """Replies until it is trusted."""

    def note(self, begun: float, heard: float, pause: float) -> bool:
        """Record one reply. Returns True if the times have changed."""
        slowest, whole, pauses = self.slowest, self.heard, self.pause
        changed = False
        # Compared one by one, without `max`: this runs for every reply, and seldom changes anything.
        if begun > slowest.now:
            changed = begun > slowest.before
            slowest.now = begun
        if heard > whole.now:
            changed = changed or heard > whole.before
            whole.now = heard
        if pause > pauses.now:
            changed = changed or pause > pauses.before
            pauses.now = pause
        if self.doubts:
            self.doubts -= 1
            changed = changed or not self.doubts
        # Two epochs and not a sliding window: the largest of the last 500 to 1000 replies costs two numbers.
        self._left -= 1
        if not self._left:
            self._left = EPOCH
            for largest in (slowest, whole, pauses):
                largest.turn()
            changed = True
        return changed

    @property
    def window(self) -> float:
        """Learned window, in seconds."""
        return window_of(self.slowest.value, self.heard.value)

    def timing(self, document: ReplyTiming, byte_time: float, patience: int) -> ReplyTiming:
        """Return the timing to use: the documented one until there are enough replies."""
        window = min(patience * self.window, document.window)
        if self.doubts:
            return document
        # Twice the longest pause: a pause depends more on the adapter's scheduling than a reply time does.
        gap = min(document.inter_byte_timeout, max(LEAST_SILENCE * byte_time, 2 * self.pause.value))
        return replace(
            document,
            late_after=min(document.late_after, window),
            window=window,
            inter_byte_timeout=gap,
            silence=document.inter_byte_timeout,
        )


class Kind:
    """One kind of command of one node, and the times for its next exchange."""

    __slots__ = ("_byte_time", "_document", "_given", "first", "packet")

    def __init__(self) -> None:
        self.first = StepTimes()
        self.packet = StepTimes()
        self._byte_time = 0.0
        self._document: Timings | None = None
        self._given: dict[int, Timings] | None = None

    def timings(self, document: Timings, hurry: int) -> Timings:
        """Return the times to open an exchange with. `hurry`: AT_FIRST, AGAIN, AT_LAST or NEVER."""
        # Cached: it is called for every attempt, and the times change with few replies. `document` changes if the
        # maximum reply delay was raised.
        if self._given is None or document is not self._document:
            self._document = document
            own = replace(
                document, packet=replace(document.packet)
            )  # a copy of its own, so that a packet's step is recognised by its timing
            self._given = {patience: self._learned(own, patience) for patience in (AT_FIRST, AGAIN, AT_LAST)}
            self._given[NEVER] = own
        return self._given[hurry]

    def note(self, packet: bool, begun: float, heard: float, pause: float, byte_time: float) -> None:
        """Record the reply to one of its steps."""
        step = self.packet if packet else self.first
        # The byte time of the line becomes known here with the first reply.
        if step.note(begun, heard, pause) or byte_time != self._byte_time:
            self._byte_time = byte_time
            self._given = None

    def doubt(self, replies: int) -> None:
        """Use the documented times for at least this many replies."""
        for step in (self.first, self.packet):
            # Never fewer: a late reply during the first 200 must not shorten them to 20.
            step.doubts = max(step.doubts, replies)
        self._given = None

    def _learned(self, own: Timings, patience: int) -> Timings:
        first = self.first.timing(own.read, self._byte_time, patience)
        # Longer for a write: after its window it is unconfirmed, while a read is repeated.
        write = self.first.timing(own.write, self._byte_time, AT_LAST)
        return Timings(first, write, self.packet.timing(own.packet, self._byte_time, patience))


class Learning:
    """Learned times of one node."""

    __slots__ = ("_known", "kinds", "returns")

    def __init__(self) -> None:
        self.kinds: dict[type, Kind] = {}
        self._known: dict[tuple[str, bool], LearnedTimes] = {}
        self.returns = 0
        """How often the documented times were restored."""

    def timings(self, command: object, document: Timings, hurry: int) -> Timings:
        """Return the times to open `command` with; see `Kind.timings`."""
        kind = self.kinds.get(type(command))
        if kind is None:
            kind = self.kinds[type(command)] = self._begin(type(command).__name__)
        return kind.timings(document, hurry)

    def note(self, command: object, packet: bool, begun: float, heard: float, pause: float, byte_time: float) -> None:
        """Record a reply. `begun`, `heard`, `pause`: times in seconds to its first byte, to its delivery, and within
        it."""
        # A kind that was never opened with `timings` cannot have a reply.
        kind = self.kinds.get(type(command))
        if kind is not None:
            kind.note(packet, begun, heard, pause, byte_time)

    def was_late(self) -> None:
        """Use the documented times until it is known whether the node has become slower."""
        self._doubt(TRUSTED_AGAIN_AFTER)

    def was_away(self) -> None:
        """Use the documented times until enough is known about what may be another device."""
        # Another device may answer at this address now, so the times of an earlier run are void too.
        self._known = {}
        self._doubt(TRUSTED_AFTER)

    def times(self, document: Timings) -> tuple[LearnedTimes, ...]:
        """Return the learned times of each step."""
        found = []
        for command, kind in self.kinds.items():
            for step, limit, packet in ((kind.first, document.read, False), (kind.packet, document.packet, True)):
                if step.heard.value:
                    slowest, heard, pause = step.slowest.value, step.heard.value, step.pause.value
                    window = min(step.window, limit.window)
                    trusted = not step.doubts
                    found.append(LearnedTimes(command.__name__, packet, slowest, heard, pause, window, trusted))
        return tuple(found)

    def begin_with(self, known: Iterable[LearnedTimes]) -> None:
        """Start with the times of an earlier run: they are trusted after fewer replies."""
        self._known = {(times.kind, times.packet): times for times in known}

    def to_keep(self, document: Timings) -> tuple[LearnedTimes, ...]:
        """Return the times to store for the next run: the trusted ones, and initial ones that were not replaced."""
        # Untrusted times of this run do not replace trusted ones of the last run.
        trusted = {(times.kind, times.packet): times for times in self.times(document) if times.trusted}
        return tuple({**self._known, **trusted}.values())

    def _doubt(self, replies: int) -> None:
        self.returns += 1
        for kind in self.kinds.values():
            # All kinds: a drive that has become slower is slower for each of them.
            kind.doubt(replies)

    def _begin(self, name: str) -> Kind:
        kind = Kind()
        for step, packet in ((kind.first, False), (kind.packet, True)):
            times = self._known.get((name, packet))
            if times is not None and times.trusted and max(times.slowest, times.received, times.pause) < inf:
                # As the epoch before: it counts until this run has an epoch of its own, and is forgotten then.
                step.slowest.before, step.heard.before, step.pause.before = times.slowest, times.received, times.pause
                step.doubts = TRUSTED_AGAIN_AFTER
        return kind
