"""Detects when requests and replies are out of sync (rule R15).

Replies carry neither an address nor a number. A reply that was not received can still arrive after its maximum reply
delay: a network or a stopped process can hold it. Such a reply is *overdue*. While a reply is overdue, a reply that
could be mistaken for it is not delivered.

For each overdue reply the line stores how it would begin (its key), its node, and until when it could be on time. If
other bytes arrived in place of a whole reply, the key is ANY_BYTE: the rest of that reply, a single byte, can look like
an ACK.

An overdue reply is cleared when one of these happens:

- It is received while no request is open, or in place of another reply. If the line continued after a learned window,
  only a whole reply counts: two replies may have collided, and the remains of a collision can begin with any byte.
- The same node correctly answers a later request: a node answers in order.
- Its maximum reply delay has passed, its node has been silent since, and another node has correctly answered a later
  request: a channel keeps order. The entry stays until its node can no longer answer, because delayed replies arrive
  together and the slower node answers last. Until then only a reply of that node can be the overdue one, and a similar
  reply of another node is ambiguous for three times its maximum reply delay.
- LAPSE seconds have passed.

If each request that could prove something is overdue itself, an overdue reply is *forgiven*: the request is sent
although its reply could be the overdue one. Its reply is held until the maximum reply delay has passed. If a second one
arrives, neither is delivered.

A master that stopped in the middle of a frame leaves a node waiting for the rest. The next frame may be for any node,
but that node interprets its first bytes as the rest. It replies with a NAK (or an ACK) of its own, up to its maximum
reply delay later. Until that time has passed after the first frame on a new line, no NAK is trusted and each ACK is
held.

A reply that is not overdue but looks like the reply to one of the last exchanges is a duplicate. After a duplicate,
replies like recent ones are ambiguous for a while. If there is a choice, requests whose replies could be confused are
then not sent one after the other.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

from busmaster.arbiter.health import NodeRecord
from busmaster.contract.exchange import Command, Done

ANY_BYTE = b""
"""Key of an overdue reply that any single byte can clear."""
LAPSE = 10.0
"""Seconds after its request for which a reply is overdue. TCP closes most connections that stall for longer."""
AMBIGUOUS_DELAYS = 3.0
"""A reply like one that was considered overtaken is ambiguous for this many maximum reply delays."""
AMBIGUITY_PERIOD = 30.0
"""Seconds after a duplicate reply for which replies like recent ones are ambiguous."""
ANSWER_MEMORY = 0.5
"""Seconds after a delivered reply in which a duplicate of it can arrive."""
RECENT = 128
"""Number of exchanges whose replies may be duplicated: about as many as fit into the longest maximum reply delay."""
MOST_UNHEARD = 4
"""Consecutive learned windows without a reply before a node is considered silent."""
MOST_OVERDUE = 400
"""Maximum number of overdue replies. More than fit into LAPSE with any window in use; the oldest is dropped."""
MOST_REMEMBERED = 512
"""Maximum number of keys of delivered replies. More than fit into ANSWER_MEMORY; the oldest is dropped."""


@dataclass(frozen=True, slots=True)
class Awaited:
    """A reply that may still be on time although the line has continued.

    `command`: its request. `window`: the learned window that ended the wait. `silence`: the documented silence after
    which the reply is over. `lasts`: the longest time from its first to its last byte. Times in seconds.
    """

    command: Command[Any]
    window: float
    silence: float
    lasts: float = 0.0


@dataclass(slots=True)
class OverdueReply:
    """A reply that may still arrive. `node` is None if it is not known which node will send it."""

    key: bytes
    node: NodeRecord | None
    asked: float
    over: float
    """From this time on it is later than its node's maximum reply delay."""
    until: float = inf
    """From this time on only replies of its own node can be it, because another node has correctly answered."""
    awaited: Awaited | None = None
    """Set if the line continued after a learned window: the reply may still arrive and collide with the next
    request."""

    def is_of(self, node: NodeRecord) -> bool:
        """Return True if this node will send it. A node that was removed and added again counts as the same node."""
        own = self.node
        return own is node or (
            own is not None and own.address == node.address and own.profile.name == node.profile.name
        )


class InSync:
    """The overdue replies of one line, and which replies are ambiguous. Times are in seconds, on the caller's clock."""

    __slots__ = (
        "_ambiguous",
        "_ambiguous_until",
        "_answered",
        "_forgiven",
        "alert",
        "last",
        "lone_bytes_until",
        "overdue_replies",
        "recent",
    )

    def __init__(self, strict: bool = False) -> None:
        """Start with no overdue replies. `strict`: behave at all times as if a duplicate had just been received."""
        self.alert = strict
        """True if replies must be examined. While it is False, nothing else in this object matters."""
        self.overdue_replies: list[OverdueReply] = []
        self.last: Sequence[bytes] = ()
        """Keys of the replies to the last exchange."""
        self.recent: deque[Sequence[bytes]] = deque(maxlen=RECENT)
        """Keys of the replies to recent exchanges. A reply with one of these keys that is not overdue is a
        duplicate."""
        self._ambiguous: list[tuple[bytes, float]] = []
        self._forgiven: list[tuple[bytes, float]] = []
        self.lone_bytes_until = -inf
        """Until this time a single byte may be the reply to a frame that an earlier master left unfinished; inf until
        the first frame was sent."""
        self._answered: dict[bytes, float] = {}
        """When a reply with each of these keys was delivered last, the oldest first."""
        self._ambiguous_until = inf if strict else -inf

    # overdue replies

    def add_overdue(
        self,
        keys: Iterable[bytes],
        node: NodeRecord | None,
        asked: float,
        over: float,
        awaited: Awaited | None = None,
    ) -> None:
        """Add an overdue reply for each key; see `OverdueReply`."""
        self.overdue_replies += [OverdueReply(key, node, asked, over, inf, awaited) for key in keys]
        # Bounded: a line without any reply for ten seconds must not use more and more memory (R12).
        # The oldest are dropped: they lapse first.
        del self.overdue_replies[:-MOST_OVERDUE]
        self.alert = True

    def lapse(self, now: float) -> None:
        """Remove expired entries. Clears `alert` if none are left."""
        # Counted from the end of the request and not from the end of its window: a reply is never older than its
        # request.
        if self.overdue_replies:  # most of these lists are empty, and this runs for every request while `alert` is True
            self.overdue_replies = [overdue for overdue in self.overdue_replies if now - overdue.asked <= LAPSE]
        if self._ambiguous:
            self._ambiguous = [entry for entry in self._ambiguous if entry[1] > now]
        if self._forgiven:
            self._forgiven = [entry for entry in self._forgiven if entry[1] > now]
        # Only here is `alert` cleared: it is set wherever something becomes uncertain, and tested for every reply.
        unsure = self.overdue_replies or self._ambiguous or self._forgiven
        self.alert = bool(unsure or self._ambiguous_until > now or self.lone_bytes_until > now)

    def clashes(self, answers: Sequence[bytes], now: float, node: NodeRecord | None = None) -> bool:
        """Return True if a reply with one of these keys to a request that is sent now could be an overdue one.

        `node`: the node that replies; None: any node.
        """
        # Not limited to the nodes' own replies: without an address in it, any node's reply could be any other node's.
        # Most often there are none, and this runs up to five times per request while `alert` is True.
        if not self.overdue_replies:
            return False
        return any(
            (now < overdue.until or (node is not None and overdue.is_of(node))) and _could_be(overdue, answers)
            for overdue in self.overdue_replies
        )

    def over(self, answers: Sequence[bytes]) -> float:
        """Return the time after which each overdue reply with such a key is later than its maximum reply delay."""
        return max((overdue.over for overdue in self.overdue_replies if _could_be(overdue, answers)), default=-inf)

    def awaited_until(self, last_byte: float, answers: Sequence[bytes] | None = None) -> float:
        """Return until when a reply (with one of these keys) may arrive on time although the line has continued, or
        -inf.

        `last_byte`: when the last byte was received.
        """
        until = -inf
        for overdue in self.overdue_replies:
            if overdue.awaited is not None and (answers is None or _could_be(overdue, answers)):
                # A reply can begin at the last moment and pause for longer than the learned silence: its end is known
                # only by the document's silence. A write that left in such a pause met the rest of the reply.
                over, awaited = overdue.over, overdue.awaited
                until = max(until, over, last_byte + awaited.silence if last_byte < over + awaited.lasts else over)
        return until

    def nodes_overdue(self, answers: Sequence[bytes] | None, now: float) -> Iterator[NodeRecord]:
        """Yield the nodes that have an overdue reply with one of these keys (None: any key) and are not known to be
        silent.

        Removed and suspended nodes are skipped, because no request is sent to them.
        """
        for overdue in self.overdue_replies:
            if (
                overdue.node is None
                or overdue.node.is_left_alone(now)
                or now >= overdue.until
                or not (answers is None or _could_be(overdue, answers))
            ):
                continue
            if not _is_silent(overdue, now) or (
                overdue.awaited is not None and now < overdue.over and overdue.node.unheard <= MOST_UNHEARD
            ):
                yield overdue.node

    def overdue(self) -> list[tuple[NodeRecord | None, bytes]]:
        """Return the node and the key of each overdue reply."""
        return [(overdue.node, overdue.key) for overdue in self.overdue_replies]

    def lone_byte_is_overdue(self) -> bool:
        """Return True if a one-byte reply is overdue, or a reply of which any byte may be left."""
        return any(len(overdue.key) < 2 for overdue in self.overdue_replies)

    def ends(self, answers: Sequence[bytes], now: float) -> float:
        """Return the time from which overdue replies with such a key can only come from their own nodes; inf if
        unknown."""
        return max((d.until for d in self.overdue_replies if now < d.until and _could_be(d, answers)), default=inf)

    def forgive(self, answers: Sequence[bytes]) -> None:
        """Forgive overdue replies with these keys: no request with a distinct reply is available, so R3 and holding
        must do."""
        # They stay ambiguous until they lapse: forgiven means that a request may be sent, not that its reply is
        # trusted.
        self._forgiven += [
            (overdue.key, overdue.asked + LAPSE) for overdue in self.overdue_replies if _could_be(overdue, answers)
        ]
        self.overdue_replies = [overdue for overdue in self.overdue_replies if not _could_be(overdue, answers)]

    def answered(self, node: NodeRecord, asked: float, now: float, patience: float) -> None:
        """Record a correct reply of `node`, to a request sent at `asked`, that cannot be another node's.

        `patience`: assumed reply time, in seconds, of a node whose replies were never timed.
        """
        # A node answers in order: a reply to an earlier request cannot come after this one.
        if self.overdue_replies:
            self.overdue_replies = [overdue for overdue in self.overdue_replies if not overdue.is_of(node)]
        for overdue in self.overdue_replies:
            # Only a request sent after the maximum reply delay proves something. Before that, both replies can be on
            # the way.
            if overdue.over <= asked and overdue.until == inf and _is_silent(overdue, now):
                # Delayed replies arrive together, and that of the slower node arrives last.
                overdue.until = now + (0.0 if overdue.node is None else overdue.node.latest(patience))
                self._ambiguous.append(
                    (
                        overdue.key,
                        overdue.until + AMBIGUOUS_DELAYS * (overdue.over - overdue.asked),
                    )
                )

    def heard(self, run: bytes, now: float) -> OverdueReply | None:
        """Process all bytes received before a silence, unexpected or in place of a reply. Returns the overdue reply
        found.

        A reply that is not overdue but looks like a recent one is a duplicate. If the bytes are more than one reply,
        part of a reply may still be missing, which can be any byte.
        """
        # After a learned window two nodes may have transmitted at the same time, so stricter rules apply.
        awaited = [overdue for overdue in self.overdue_replies if overdue.awaited is not None]
        if awaited:
            return self._heard_late(awaited, run, now)
        payers: list[OverdueReply] = []
        # Single bytes first: a run of ACKs may hold the replies to several writes.
        rest = run
        while (overdue := self._overdue_byte(rest)) is not None:
            payers.append(overdue)
            self._pay(overdue)
            rest = rest[1:]
        # Anywhere in the run: noise may stand before a reply, and two replies may arrive as one run.
        for overdue in [overdue for overdue in self.overdue_replies if len(overdue.key) > 1]:
            place = rest.find(overdue.key)
            if place >= 0:
                payers.append(overdue)
                self._pay(overdue)
                rest = rest[:place] + rest[place + len(overdue.key) :]
        # Overdue replies account for all bytes: no duplicate is suspected.
        if payers and not rest:
            return payers[0]
        if not payers and any(until > now and _is(run, key) for key, until in (*self._ambiguous, *self._forgiven)):
            # It has arrived after all, so replies like it are not ambiguous any more.
            self._ambiguous = [entry for entry in self._ambiguous if not _is(run, entry[0])]
            self._forgiven = [entry for entry in self._forgiven if not _is(run, entry[0])]
            return None
        # Built here and not stored: unexpected bytes are rare, exchanges are not.
        recent = {key for answers in self.recent for key in answers}
        # Not for keys of one byte: an ACK may be any byte of noise.
        contained = any(len(key) > 1 and key in rest for key in recent)
        alike = any(_is(rest, key) for key in recent)
        if contained or (alike and not payers):
            self.answered_twice(now)
        # The rest is part of an unknown reply, whose last byte may still arrive and look like an ACK.
        if payers or not alike:
            self.add_overdue((ANY_BYTE,), None, now, now)
        return payers[0] if payers else None

    def _heard_late(self, awaited: list[OverdueReply], run: bytes, now: float) -> OverdueReply | None:
        """Variant of `heard` for when the line has continued before a reply was over.

        Two replies may have collided, and the remains can begin with any byte. So only a whole reply clears an entry,
        and only if no other node has an overdue reply: the bytes could be that one. Returns the apparent sender's
        entry.
        """
        first = None
        while found := next(
            ((overdue, rest) for overdue in awaited if (rest := _behind(overdue, run)) is not None),
            None,
        ):
            overdue, run = found
            first = first or overdue
            awaited.remove(overdue)
            request = (overdue.node, overdue.asked)
            # With two requests open at the same node the reply may answer either: the entry of the other one stays.
            if all((other.node, other.asked) == request for other in self.overdue_replies if other.awaited is not None):
                # also removes the ANY_BYTE entry of the same request, which stood for a part of this reply
                self.overdue_replies = [other for other in self.overdue_replies if (other.node, other.asked) != request]
        # The remains of a collision: their last bytes may still be in the adapter.
        if run:
            self.add_overdue((ANY_BYTE,), None, now, now)
        return first

    def _overdue_byte(self, run: bytes) -> OverdueReply | None:
        """Return the overdue reply that the first byte clears.

        The byte must stand alone, or be followed by equal bytes or by another overdue reply.
        """
        more = run[1:]
        if (
            more
            and more != run[:1] * len(more)
            and not any(len(d.key) > 1 and more.startswith(d.key) for d in self.overdue_replies)
        ):
            return None
        return next(
            (overdue for overdue in self.overdue_replies if overdue.key and overdue.key == run[:1]),
            None,
        )

    def _pay(self, paid: OverdueReply) -> None:
        """Clear an overdue reply. If other nodes have one with the same key, the sender is uncertain, so theirs lose
        their node."""
        self.overdue_replies.remove(paid)
        for overdue in self.overdue_replies:
            # Two nodes with the same key: either may have sent this reply, so a later one cannot be attributed to its
            # node.
            if overdue.key == paid.key and overdue.node is not paid.node:
                overdue.node = None

    # ambiguous replies

    def answered_twice(self, now: float) -> None:
        """Record a duplicate reply: for AMBIGUITY_PERIOD, replies like recent ones are ambiguous."""
        # `max`: in a strict bus it is infinite.
        self._ambiguous_until = max(self._ambiguous_until, now + AMBIGUITY_PERIOD)
        self.alert = True

    def note_answered(self, answers: Sequence[bytes], now: float) -> None:
        """Remember a delivered reply, to recognise a duplicate of it."""
        # Remembered only after a first duplicate: a healthy line must not pay for this with each reply.
        if now < self._ambiguous_until:
            answered = self._answered
            for key in answers:
                answered.pop(key, None)  # the latest comes last
                answered[key] = now
            while len(answered) > MOST_REMEMBERED:
                del answered[next(iter(answered))]

    def has_ambiguity(self, now: float) -> bool:
        """Return True if a duplicate reply was received in the last AMBIGUITY_PERIOD seconds."""
        return now < self._ambiguous_until

    def is_to_be_held(self, answers: Sequence[bytes], now: float) -> bool:
        """Return True if a reply like this may be a forgiven one, or the reply to an earlier master's unfinished
        frame."""
        # An ACK, or another reply of one byte, which the unfinished frame of an earlier master can cause (R15).
        if not self._forgiven and now >= self.lone_bytes_until:
            return False
        lone = any(len(key) == 1 for key in answers)
        if lone and now < self.lone_bytes_until:
            return True
        return any(until > now and (key in answers if key else lone) for key, until in self._forgiven)

    def stood_alone(self, answers: Sequence[bytes]) -> None:
        """Remove forgiven replies with these keys: no second reply arrived while this one was held."""
        # A channel keeps order, so a second reply would have arrived before the hold ended.
        self._forgiven = [entry for entry in self._forgiven if entry[0] and entry[0] not in answers]

    def is_overdue(self, now: float) -> bool:
        """Return True if the reply to an earlier request may still arrive."""
        return bool(self.overdue_replies) or any(until > now for _, until in self._forgiven)

    def refusals_are_ambiguous(self, now: float) -> bool:
        """Return True if a NAK may belong to another request: a node can answer every request with a NAK."""
        return now < self.lone_bytes_until or self.is_overdue(now)

    def came_up(self) -> None:
        """Handle a line that came up: a node may hold the beginning of an earlier master's frame."""
        self.lone_bytes_until = inf
        self.alert = True

    def is_ambiguous(self, answers: Sequence[bytes], now: float) -> bool:
        """Return True if a reply like this may be an overtaken reply or a duplicate."""
        if self._ambiguous and any(until > now and key in answers for key, until in self._ambiguous):
            return True
        if now >= self._ambiguous_until:
            return False
        answered = self._answered
        return any(key in answered and now - answered[key] <= ANSWER_MEMORY for key in answers)


def _behind(overdue: OverdueReply, run: bytes) -> bytes | None:
    """Return the bytes after this overdue reply if the run begins with a whole and correct one, else None."""
    if overdue.awaited is None or overdue.node is None or len(overdue.key) < 2 or not run.startswith(overdue.key):
        return None
    # The reader of the request decides whether the reply is whole, so that no second parser can disagree.
    try:
        step = overdue.awaited.command.open(overdue.node.address, overdue.node.timings).feed(run)
    except Exception:
        return None
    return step.rest if type(step) is Done else None


def _could_be(overdue: OverdueReply, answers: Sequence[bytes]) -> bool:
    """Return True if the overdue reply could be mistaken for a reply with one of these keys."""
    return overdue.key in answers if overdue.key else any(len(key) == 1 for key in answers)


def _is_silent(overdue: OverdueReply, now: float) -> bool:
    """Return True if the node of the overdue reply is not known to answer, or no request may be sent to it, so that
    another node's reply must clear it."""
    node = overdue.node
    return node is None or node.is_left_alone(now) or node.silent or node.last_reply == -inf


def _is(run: bytes, key: bytes) -> bool:
    """Return True if the bytes are replies with this key. A one-byte key must make up the whole run."""
    return run == key * len(run) if len(key) == 1 else bool(key) and run.startswith(key)
