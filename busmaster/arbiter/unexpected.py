"""Bytes that belong to no request: counted, attributed to a late node, and acknowledged where the protocol needs it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import inf

from busmaster.arbiter.counters import LineCounters
from busmaster.arbiter.events import CameUnexpected, Event, MaxReplyDelayRaised, RepliesLate
from busmaster.arbiter.health import NodeRecord
from busmaster.contract.exchange import Done, FrameError, Listener, Need
from busmaster.contract.timing import ReplyTiming

QUIET = 0.020
"""Shortest silence, in seconds, that ends a resynchronisation."""
NOISY_AFTER = 1.0
"""Seconds without such a silence after which the line is NOISY."""
LATE_REPLY_SHARE = 0.75
LATE_REPLY_MARGIN = 1.6
LONGEST_MAX_REPLY_DELAY = 0.5
LATE_REPLY_MEMORY = 1.0
"""Seconds after which unexpected bytes are no longer attributed to the last unanswered request."""
REPORT_AGAIN = 1.25
"""A late reply is reported again if it is this many times as late as the last one reported."""
LOOKS = 10
"""Number of times per maximum reply delay that the line is read while an overdue reply may arrive."""
LOOK_SLACK = 0.005
"""Seconds by which a read of the line may be late. Beyond that, bytes may have lain unread in the meantime."""
LONGEST_RUN = 512
"""Maximum number of bytes stored between two silences. More is noise."""


class UnexpectedBytes:
    """The bytes of one line between exchanges."""

    def __init__(self, events: deque[Event], counters: LineCounters) -> None:
        self.last_byte = -inf
        self.run = bytearray()
        """Bytes received since the last silence, or in place of a reply."""
        self._looked = self._look_at = -inf
        self.listener: Listener | None = None
        self._events = events
        self._counters = counters
        self._noise_since = inf
        self._listening = False
        self.unanswered_one: tuple[NodeRecord, float, float] | None = None
        """The unanswered request: node, end of the request, maximum reply delay. The next bytes may be its reply."""
        self._overdue_reply: tuple[tuple[NodeRecord, float, float], float, float, float] | None = None
        """The first bytes after that request: the request, when they arrived, and how exactly that time is known."""

    def note(self, data: bytes, now: float, quiet: float) -> None:
        """Count these bytes. `quiet`: silence, in seconds, that ends a run of noise."""
        self._counters.unexpected_bytes += len(data)
        # R12: a node that transmits without a pause would fill the memory.
        if len(self.run) < LONGEST_RUN:
            self.run += data
        self._events.append(CameUnexpected(data))
        if now - self.last_byte > quiet or self._noise_since == inf:
            # A silence in between starts the count again, so a line with a burst per second is not noisy.
            self._noise_since = now
        self.last_byte = now
        self.came(now)

    def babbling(self, now: float) -> bool:
        """Return True if unexpected bytes have not paused for NOISY_AFTER seconds, so that nothing can be sent."""
        return now - self._noise_since >= NOISY_AFTER

    def silent(self) -> bytes:
        """Handle a silence. Returns the bytes received before it."""
        self._noise_since = inf
        run = bytes(self.run)
        self.run.clear()
        if not run:
            self._overdue_reply = None
        return run

    # overdue replies (R3)

    def unanswered(self, node: NodeRecord, asked: float, max_reply_delay: float) -> None:
        """Record a request without a reply in its window; the next bytes may be its reply. `asked`: end of the
        request."""
        self.unanswered_one = (node, asked, max_reply_delay)

    def forget(self) -> None:
        """Discard all state after the port was lost: the next port does not continue its data."""
        self.answered()
        self.silent()
        # The result is dropped: there is no port to send it to.
        self.reply_to_silence()  # half a packet, which cannot be acknowledged any more

    def answered(self) -> None:
        """Note that no request is unanswered: the next bytes are not an overdue reply."""
        self.unanswered_one = None

    def looked(self, now: float, due: float) -> None:
        """Note that all input was read, and that the next read follows by `due`. This limits the error of a reply's
        age."""
        self._looked = now
        self._look_at = due

    def look_before(self, due: float, now: float) -> float:
        """Return when to read the line again; at the latest at `due`."""
        if self.unanswered_one is not None and now - self.unanswered_one[1] > LATE_REPLY_MEMORY:
            self.unanswered_one = None
        if self.unanswered_one is not None:
            # A late reply lies unread until the next read. Ten reads per maximum reply delay measure its age to within
            # a tenth.
            due = min(due, now + self.unanswered_one[2] / LOOKS)
            self.looked(now, due)
        return due

    def note_late(self, node: NodeRecord, timing: ReplyTiming, asked: float, first_byte: float) -> None:
        """Record a correct reply that began after its window. It is reported once, and again if a later one is
        slower."""
        self.unanswered(node, asked, timing.max_reply_delay)
        age = self.blame(first_byte)
        # R14: a node that is always late is reported once, not with every reply.
        if age > timing.window and age > REPORT_AGAIN * node.reported_late:
            node.reported_late = age
            self._events.append(RepliesLate(node, age, timing.window))

    def came(self, now: float) -> None:
        """Record when bytes were received. If they contain the reply to the unanswered request, it began now."""
        if self.unanswered_one is not None:
            self._overdue_reply = (self.unanswered_one, now, self._looked, self._look_at)
            self.unanswered_one = None

    def blame_overdue_reply(self, nodes_overdue: Sequence[NodeRecord | None]) -> None:
        """Attribute the reply that was found to the last unanswered node, if that is one of these nodes.

        Other bytes raise no maximum reply delay: noise would make healthy nodes slow.
        """
        overdue, self._overdue_reply = self._overdue_reply, None
        if overdue is not None and overdue[0][0] in nodes_overdue:
            self.unanswered_one, first_byte, self._looked, self._look_at = overdue
            self.blame(first_byte)

    def blame(self, first_byte: float) -> float:
        """Raise a node's maximum reply delay if its reply came late. Returns the reply's age in seconds, 0 if not
        known."""
        if self.unanswered_one is None:
            return 0.0
        node, asked, max_reply_delay = self.unanswered_one
        self.unanswered_one = None
        stalled = first_byte > self._look_at + LOOK_SLACK  # the bytes may have lain unread for as long
        age = (self._looked if stalled else first_byte) - asked
        # Bounded: each failed attempt costs this time, so one delayed reply must not make a line unusable.
        raised = min(LATE_REPLY_MARGIN * age, LONGEST_MAX_REPLY_DELAY)
        # Raised before the maximum reply delay is exceeded: beyond it, a reply could be taken for another node's. Bytes
        # later than LATE_REPLY_MEMORY are noise, or an overdue reply (R15).
        if LATE_REPLY_SHARE * max_reply_delay < age <= LATE_REPLY_MEMORY and raised > max_reply_delay:
            node.raise_max_reply_delay(raised, first_byte)
            self._events.append(MaxReplyDelayRaised(node, age, raised))
        return age

    def blame_for(self, node: NodeRecord, asked: float, first_byte: float) -> None:
        """Attribute a reply to an earlier request of this node, received although the line had continued."""
        self.unanswered(node, asked, node.timings.read.max_reply_delay)
        self.looked(first_byte, first_byte)  # its time is known: it did not lie unread
        self.blame(first_byte)

    # packets that need an acknowledgement: MSC repeats a packet until it is ACKed

    def reply_to(self, data: bytes, noisy: bool) -> bytes:
        """Return the bytes to send in reply to these bytes now, if any.

        On a `noisy` line nothing is sent, not even an ACK. The bytes may belong to a packet, which would be repeated;
        it is answered after the next silence.
        """
        if self.listener is None:
            return b""
        if noisy:
            self._listening = True
            return b""
        try:
            step = self.listener.feed(data)
        except FrameError as error:
            self._listening = False
            return error.send
        self._listening = step is Need.MORE
        return step.send if isinstance(step, Done) else b""

    def reply_to_silence(self) -> bytes:
        """Return the bytes to send in reply to a packet that was cut off or arrived in noise, if any."""
        # After noise a packet may have been missed. Its unit would send it again into the next exchange, where it could
        # make a value (docs/proof.md, 13).
        if self.listener is None or not self._listening:
            return b""
        self._listening = False
        return self.listener.expired().send
