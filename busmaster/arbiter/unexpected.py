"""What came though nobody asked for it: counted, blamed on the node that was slow, answered where that is overdue."""

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
"""The least silence, in seconds, that ends a resynchronisation."""
NOISY_AFTER = 1.0
"""Seconds without such a silence after which the line is NOISY."""
LATE_REPLY_SHARE = 0.75
LATE_REPLY_MARGIN = 1.6
LONGEST_MAX_REPLY_DELAY = 0.5
LATE_REPLY_MEMORY = 1.0
"""Seconds after which an unexpected byte is no longer blamed on the last unanswered request."""
TOLD_AGAIN = 1.25
"""How many times as late as the latest reply that was told one must be to be told, too."""
LOOKS = 10
"""In so many parts of a maximum reply delay the line is looked at while an overdue reply may come."""
LOOK_SLACK = 0.005
"""Seconds by which a look may be late before it is thought that nobody looked at the line meanwhile."""
LONGEST_RUN = 512
"""Bytes between two silences that are kept to be told apart; more is noise."""


class UnexpectedBytes:
    """The bytes between exchanges, of one line."""

    def __init__(self, events: deque[Event], counters: LineCounters) -> None:
        self.last_byte = -inf
        self.run = bytearray()
        """What came since the line was last silent, or in place of a reply."""
        self._looked = self._look_at = -inf
        self.listener: Listener | None = None
        self._events = events
        self._counters = counters
        self._noise_since = inf
        self._listening = False
        self.unanswered_one: tuple[NodeRecord, float, float] | None = None
        """The request that was not answered: its node, when it was out, its maximum reply delay. What comes may be its
        reply."""
        self._overdue_reply: tuple[tuple[NodeRecord, float, float], float, float, float] | None = None
        """What came first behind that request: the request, when it came, and how well that is known."""

    def note(self, data: bytes, now: float, quiet: float) -> None:
        """Count these bytes; `quiet` is the silence, in seconds, after which a run of noise is over."""
        self._counters.unexpected_bytes += len(data)
        if len(self.run) < LONGEST_RUN:
            self.run += data
        self._events.append(CameUnexpected(data))
        if now - self.last_byte > quiet or self._noise_since == inf:
            self._noise_since = now
        self.last_byte = now
        self.came(now)

    def babbling(self, now: float) -> bool:
        """Return whether unexpected bytes have not paused for so long (NOISY_AFTER) that nothing can be sent."""
        return now - self._noise_since >= NOISY_AFTER

    def silent(self) -> bytes:
        """Note that the line is silent. Returns what came before."""
        self._noise_since = inf
        run = bytes(self.run)
        self.run.clear()
        if not run:
            self._overdue_reply = None
        return run

    # overdue replies (R3)

    def unanswered(self, node: NodeRecord, asked: float, max_reply_delay: float) -> None:
        """Note that a request, out since `asked`, got no reply in its window; what comes next may be its overdue
        reply."""
        self.unanswered_one = (node, asked, max_reply_delay)

    def forget(self) -> None:
        """Forget what came: the port is lost, and nothing that comes through the next one goes on with it."""
        self.answered()
        self.silent()
        self.reply_to_silence()  # half a packet, which cannot be acknowledged any more

    def answered(self) -> None:
        """Note that no request is unanswered any more: what comes next is nobody's overdue reply."""
        self.unanswered_one = None

    def looked(self, now: float, due: float) -> None:
        """Note that nothing lies unread, and the next look is due by `due`: so well is an overdue reply's age known."""
        self._looked = now
        self._look_at = due

    def look_before(self, due: float, now: float) -> float:
        """Return when to look at the line again, where nothing is to be done before `due`."""
        if self.unanswered_one is not None and now - self.unanswered_one[1] > LATE_REPLY_MEMORY:
            self.unanswered_one = None
        if self.unanswered_one is not None:
            due = min(due, now + self.unanswered_one[2] / LOOKS)
            self.looked(now, due)
        return due

    def note_late(self, node: NodeRecord, timing: ReplyTiming, asked: float, first_byte: float) -> None:
        """Note that a reply was right, and began after its window: that is told once, and again where it is slower."""
        self.unanswered(node, asked, timing.max_reply_delay)
        age = self.blame(first_byte)
        if age > timing.window and age > TOLD_AGAIN * node.told_late:
            node.told_late = age
            self._events.append(RepliesLate(node, age, timing.window))

    def came(self, now: float) -> None:
        """Note that bytes came. If the unanswered request's reply is among them, it began now."""
        if self.unanswered_one is not None:
            self._overdue_reply = (self.unanswered_one, now, self._looked, self._look_at)
            self.unanswered_one = None

    def blame_overdue_reply(self, nodes_overdue: Sequence[NodeRecord | None]) -> None:
        """Blame the node that did not answer last, if it is one of those who overdue the reply that was found.
        Other bytes raise nothing: noise would make healthy nodes slow."""
        overdue, self._overdue_reply = self._overdue_reply, None
        if overdue is not None and overdue[0][0] in nodes_overdue:
            self.unanswered_one, first_byte, self._looked, self._look_at = overdue
            self.blame(first_byte)

    def blame(self, first_byte: float) -> float:
        """Raise the maximum reply delay of a node whose reply came long after its request: it is slower than was
        believed. Returns how long after it, in seconds, as far as is known: 0 if it is not."""
        if self.unanswered_one is None:
            return 0.0
        node, asked, max_reply_delay = self.unanswered_one
        self.unanswered_one = None
        stalled = first_byte > self._look_at + LOOK_SLACK  # it may have lain unread for as long
        age = (self._looked if stalled else first_byte) - asked
        raised = min(LATE_REPLY_MARGIN * age, LONGEST_MAX_REPLY_DELAY)
        # Before its maximum reply delay is exceeded, not after: by then it can be taken for somebody's answer. What
        # comes later than the memory is nobody's overdue reply any more, but noise, or overdue (R15).
        if LATE_REPLY_SHARE * max_reply_delay < age <= LATE_REPLY_MEMORY and raised > max_reply_delay:
            node.raise_max_reply_delay(raised, first_byte)
            self._events.append(MaxReplyDelayRaised(node, age, raised))
        return age

    def blame_for(self, node: NodeRecord, asked: float, first_byte: float) -> None:
        """Blame the node whose reply to an earlier request came, though the line had gone on."""
        self.unanswered(node, asked, node.timings.read.max_reply_delay)
        self.looked(first_byte, first_byte)  # its time is known: it did not lie unread
        self.blame(first_byte)

    # what may be overdue an answer: MSC sends a packet again until it is ACKed

    def reply_to(self, data: bytes, noisy: bool) -> bytes:
        """Return what must be said to these bytes now, if anything. On a `noisy` line nothing is, not even an ACK, but
        they may be a packet's, which would come again: it is answered when the line is silent."""
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
        """Return what must be said to a packet that was cut off, or came in noise, if anything."""
        if self.listener is None or not self._listening:
            return b""
        self._listening = False
        return self.listener.expired().send
