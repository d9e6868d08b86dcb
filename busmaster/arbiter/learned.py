"""Reply windows that are learned from a node's own replies.

The documents' windows are made for the slowest node that there may be: a reply that is lost costs a node which answers
in 2 ms as much as one which takes 100 ms. Where learning is asked for, a read that will be repeated is awaited for only
as long as this node has needed of late, with a good margin; then the line goes on, though the reply may still come.

What makes that safe is R15, not the window: the reply is *overdue* from then on, for as long as the document's maximum
reply delay and beyond it, and nothing that it could counterfeit is believed, no write and no broadcast is sent, until
the node has answered something else. Nothing that is told to a caller rests on a learned time, either: writes and the
last attempt of a read have the document's window, and go only when nothing is awaited any more; probes and all that is
asked of a node that has failed, and not answered since, have the document's times altogether.

The rule, for each kind of command (its type) and each of the node's two steps (the answer; MSC's packet after its
ACK) on its own: the window is one and a half times the largest reply time of the last 500 to 1000 replies, or the
largest until the first bytes were handed over if that is more (an adapter may hand over a whole reply at once), plus
2 ms; at least 5 ms, at most the document's. It is trusted after 200 replies.
The second attempt of a read has twice that. The silence after which a reply is over is twice the longest pause
within one of those replies, but 17 bytes at least. (A smoothed mean and deviation, as TCP has it, follows the usual
reply too closely: of 76,000 replies it missed 1236, the largest none.)

A node that was later than three quarters of a learned window (one shorter than the document's), or whose reply came
after it, has the document's times again for 20 replies: enough to tell one that has become slower from one that was
late once. One that was away has them for 200, for it may be another device.

Of times nothing is done here but to add, subtract, compare and multiply by a constant.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import inf

from busmaster.contract.timing import ReplyTiming, Timings

TRUSTED_AFTER = 200
"""Replies of a kind after which its times are trusted."""
TRUSTED_AGAIN_AFTER = 20
"""As many where times of an earlier run are known, or after one that was late."""
EPOCH = 500
"""Replies after which an epoch ends: the largest of this one and the last count."""
MARGIN = 0.002
"""Seconds added to what was ever needed."""
SLOWER = 1.5
"""How many times its slowest reply is awaited of a node: more costs each lost frame the difference, and less would call
replies lost that only came a little later than any before."""
LEAST = 0.005
"""The shortest window, in seconds: less than a process is held up for."""
AT_FIRST, AGAIN, AT_LAST, NEVER = 1, 2, 10**9, 0
"""How many times the learned window an attempt is awaited, but no longer than the document says. AT_LAST is the attempt
on which an outcome rests: the document's window. NEVER: neither its window nor its silence is learned."""
LATE_SHARE = 0.75
"""The share of a learned window after which a reply says that the node has become slower."""
LEAST_SILENCE = 17
"""The shortest silence that ends a reply, in bytes: a UART hands over up to 16 at once."""


@dataclass(frozen=True, slots=True)
class LearnedTimes:
    """What is known of the replies of one node to one kind of command; in seconds.

    `slowest` is the largest reply time of the last 500 to 1000 replies, to the first byte; `received` the largest until
    the first bytes were handed over; `pause` the longest within a reply. `window` is what is awaited, once `trusted`.
    """

    kind: str
    packet: bool
    slowest: float
    received: float
    pause: float
    window: float
    trusted: bool


def window_of(slowest: float, heard: float) -> float:
    """Return the seconds in which a reply of such a node begins: see `LearnedTimes` for what is given, in seconds."""
    return max(LEAST, max(SLOWER * slowest, heard) + MARGIN)


class _Largest:
    """The largest of the last one or two epochs."""

    __slots__ = ("before", "now")

    def __init__(self) -> None:
        self.now = self.before = 0.0

    @property
    def value(self) -> float:
        """The largest of both epochs."""
        return max(self.now, self.before)

    def turn(self) -> None:
        """Begin the next epoch."""
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
        """Note one reply. Returns whether what is known has changed."""
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
        """Seconds in which a reply begins, by all that is known."""
        return window_of(self.slowest.value, self.heard.value)

    def timing(self, document: ReplyTiming, byte_time: float, patience: int) -> ReplyTiming:
        """Return what is awaited: the document's while too little is known."""
        window = min(patience * self.window, document.window)
        if self.doubts:
            return document
        # Twice the longest pause seen, since a pause depends on the scheduler of the adapter more than a reply time
        # does.
        gap = min(document.inter_byte_timeout, max(LEAST_SILENCE * byte_time, 2 * self.pause.value))
        return replace(
            document, late_after=min(document.late_after, window), window=window, inter_byte_timeout=gap, silence=gap
        )


class Kind:
    """One kind of command of one node, and the times that its next exchange is opened with."""

    __slots__ = ("_byte_time", "_document", "_given", "first", "packet")

    def __init__(self) -> None:
        self.first = StepTimes()
        self.packet = StepTimes()
        self._byte_time = 0.0
        self._document: Timings | None = None
        self._given: dict[int, Timings] | None = None

    def timings(self, document: Timings, hurry: int) -> Timings:
        """Return what an exchange is to be opened with: AT_FIRST, AGAIN, AT_LAST or NEVER."""
        if self._given is None or document is not self._document:
            self._document = document
            own = replace(
                document, packet=replace(document.packet)
            )  # so that a packet's step can be told by its timing
            self._given = {patience: self._learned(own, patience) for patience in (AT_FIRST, AGAIN, AT_LAST)}
            self._given[NEVER] = own
        return self._given[hurry]

    def note(self, packet: bool, begun: float, heard: float, pause: float, byte_time: float) -> None:
        """Note the reply to one of its steps."""
        step = self.packet if packet else self.first
        if step.note(begun, heard, pause) or byte_time != self._byte_time:
            self._byte_time = byte_time
            self._given = None

    def doubt(self, replies: int) -> None:
        """Go back to the document's times for at least so many replies."""
        for step in (self.first, self.packet):
            step.doubts = max(step.doubts, replies)
        self._given = None

    def _learned(self, own: Timings, patience: int) -> Timings:
        first = self.first.timing(own.read, self._byte_time, patience)
        # Longer for a write: when its window is over it is unconfirmed, while a read is only sent again.
        write = self.first.timing(own.write, self._byte_time, AT_LAST)
        return Timings(first, write, self.packet.timing(own.packet, self._byte_time, patience))


class Learning:
    """What is learned of one node."""

    __slots__ = ("_known", "kinds", "returns")

    def __init__(self) -> None:
        self.kinds: dict[type, Kind] = {}
        self._known: dict[tuple[str, bool], LearnedTimes] = {}
        self.returns = 0
        """How often the document's times were gone back to."""

    def timings(self, command: object, document: Timings, hurry: int) -> Timings:
        """Return the times with which `command` is to be opened, see `Kind.timings`."""
        kind = self.kinds.get(type(command))
        if kind is None:
            kind = self.kinds[type(command)] = self._begin(type(command).__name__)
        return kind.timings(document, hurry)

    def note(self, command: object, packet: bool, begun: float, heard: float, pause: float, byte_time: float) -> None:
        """Note a reply: begun after so many seconds, its first bytes handed over after `heard`, with that `pause`."""
        # A kind that was never opened with `timings` cannot have a reply.
        kind = self.kinds.get(type(command))
        if kind is not None:
            kind.note(packet, begun, heard, pause, byte_time)

    def was_late(self) -> None:
        """Go back to the document's times until it has shown whether it has become slower."""
        self._doubt(TRUSTED_AGAIN_AFTER)

    def was_away(self) -> None:
        """Go back to the document's times until enough is known of what may be another device."""
        # Another device may answer at this address now, so the times of an earlier run are void too.
        self._known = {}
        self._doubt(TRUSTED_AFTER)

    def times(self, document: Timings) -> tuple[LearnedTimes, ...]:
        """Return what is known, a step at a time."""
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
        """Start from what an earlier run has learned: it is trusted after fewer replies."""
        self._known = {(times.kind, times.packet): times for times in known}

    def to_keep(self, document: Timings) -> tuple[LearnedTimes, ...]:
        """Return what the next run may begin with: what is trusted, and what this one began with and never
        ambiguous."""
        trusted = {(times.kind, times.packet): times for times in self.times(document) if times.trusted}
        return tuple({**self._known, **trusted}.values())

    def _doubt(self, replies: int) -> None:
        self.returns += 1
        for kind in self.kinds.values():
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
