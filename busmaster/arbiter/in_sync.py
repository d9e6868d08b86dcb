"""R15, in sync: which replies are overdue, and which answers could be theirs.

Replies carry neither an address nor a number. A reply that was not received may still arrive, however long its maximum
reply delay has passed: a network or a stopped process can hold it. While it is overdue, no answer that could be this
reply is believed.

Of each overdue reply the line remembers how it would begin (its key), which node owes it, and until when it could be on
time. If something else arrived in place of a whole reply, the key is ANY_BYTE: the reply's tail, a single byte, could
look like an ACK.

An overdue reply is cleared
- by itself, if it is received while no request is open, or in place of another reply (by a whole reply, if the line
  went on after a learned window: two replies may have collided, and what remains of them can begin with any byte);
- by a right answer of the same node to something else, since a node answers in the order of the requests;
- by a right answer of any node to something else, if the maximum reply delay has passed and the node has been silent
  since, because a channel keeps the order. The entry stays until its node could no longer answer: replies that were
  held up together arrive together, and the slower node answers last. Until then only an answer of that node can be the
  overdue one, and a similar answer of another node is ambiguous for three times its maximum reply delay;
- after LAPSE seconds.

If every request that could prove something is itself overdue, an overdue reply is *forgiven*: the request is sent
although its answer could be the overdue one. That answer is held until the maximum reply delay has passed. If a second
one arrives, neither is believed.

A master that stopped in the middle of a frame leaves a node waiting for the rest. Such a node takes the first bytes of
the next frame, to whichever node, for that rest, and replies with a NAK (or an ACK) of its own, up to its maximum reply
delay later. So after the line came up, no NAK is trusted, and every ACK is held, until that time has passed behind the
first frame.

A reply that is not overdue and yet looks like one of the last exchanges was sent twice. Then replies like those
received lately are ambiguous for a while, and if there is a choice, requests whose replies could be confused are not
sent one after the other.
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
"""The key of an overdue reply that any lone byte could pay."""
LAPSE = 10.0
"""Seconds after its request in which a reply is overdue: TCP gives up on most paths that stand still for longer."""
AMBIGUOUS_DELAYS = 3.0
"""For how many maximum reply delays an answer like one that was believed to be overtaken is ambiguous."""
AMBIGUITY_PERIOD = 30.0
"""Seconds after something was said twice in which answers like those heard lately are ambiguous."""
SAID_MEMORY = 0.5
"""Seconds for which what was said may be said again."""
RECENT = 128
"""Exchanges of which a reply may be said a second time: about so many fit into the longest maximum reply delay."""
MOST_UNHEARD = 4
"""Learned windows in a row that may bring nothing before a node is taken to be silent."""
MOST_OVERDUE = 400
"""More unheard replies than fit into LAPSE at any window that is in use; the oldest goes."""


@dataclass(frozen=True, slots=True)
class Awaited:
    """A reply that may still be on time: the command that it answers, the learned `window` after which the line went
    on, the `silence` after which it is over, as the document says, and how long it `lasts` at most; in seconds."""

    command: Command[Any]
    window: float
    silence: float
    lasts: float = 0.0


@dataclass(slots=True)
class OverdueReply:
    """A reply that may still come. `node` is None where it cannot be told whose it is."""

    key: bytes
    node: NodeRecord | None
    asked: float
    over: float
    """From then on, it is later than its node's maximum reply delay allows."""
    until: float = inf
    """From then on, only its own node's answers can be it: a right answer of another node was heard."""
    awaited: Awaited | None = None
    """Where the line went on after a learned window: it may still come, and meet with what is said."""

    def of(self, node: NodeRecord | None, now: float) -> bool:
        """Return whether it could be the answer of this node (None: of any) to a request that is made now."""
        return now < self.until or (node is not None and self.is_of(node))

    def is_of(self, node: NodeRecord) -> bool:
        """Return whether this node owes it: also one that was removed meanwhile, and added again."""
        own = self.node
        return own is node or (
            own is not None and own.address == node.address and own.profile.name == node.profile.name
        )


class InSync:
    """What is overdue on one line, and how far its answers can be trusted. Times are in seconds, on the caller's
    clock."""

    __slots__ = (
        "_ambiguous",
        "_ambiguous_until",
        "_forgiven",
        "_said",
        "alert",
        "last",
        "lone_bytes_until",
        "overdue_replies",
        "recent",
    )

    def __init__(self, strict: bool = False) -> None:
        """Begin with nothing overdue. If `strict`, it is always as if something had been said twice a moment ago."""
        self.alert = strict
        """There is something to be careful of: nothing else here matters while this is False."""
        self.overdue_replies: list[OverdueReply] = []
        self.last: Sequence[bytes] = ()
        """What would answer the exchange that was begun last."""
        self.recent: deque[Sequence[bytes]] = deque(maxlen=RECENT)
        """The keys of its replies and of those before: a reply like one of these that is not overdue was sent twice."""
        self._ambiguous: list[tuple[bytes, float]] = []
        self._forgiven: list[tuple[bytes, float]] = []
        self.lone_bytes_until = -inf
        """Until then a lone byte may be a node's reply to a frame that an earlier master left unfinished; inf until the
        first frame was sent."""
        self._said: deque[tuple[Sequence[bytes], float]] = deque(maxlen=256)
        self._ambiguous_until = inf if strict else -inf

    # what is overdue

    def add_overdue(
        self,
        keys: Iterable[bytes],
        node: NodeRecord | None,
        asked: float,
        over: float,
        awaited: Awaited | None = None,
    ) -> None:
        """Note that replies that begin with these keys were not heard, see `OverdueReply`."""
        self.overdue_replies += [OverdueReply(key, node, asked, over, inf, awaited) for key in keys]
        # Bounded: a line on which nothing is heard for ten seconds must not grow without limit.
        del self.overdue_replies[:-MOST_OVERDUE]
        self.alert = True

    def lapse(self, now: float) -> None:
        """Forget what has been overdue for too long, and stop being careful where nothing is left to be careful of."""
        # From when the request left, not from when its window ended: a reply cannot be older than its request.
        self.overdue_replies = [overdue for overdue in self.overdue_replies if now - overdue.asked <= LAPSE]
        self._ambiguous = [entry for entry in self._ambiguous if entry[1] > now]
        self._forgiven = [entry for entry in self._forgiven if entry[1] > now]
        unsure = self.overdue_replies or self._ambiguous or self._forgiven
        self.alert = bool(unsure or self._ambiguous_until > now or self.lone_bytes_until > now)

    def clashes(self, answers: Sequence[bytes], now: float, node: NodeRecord | None = None) -> bool:
        """Return whether an answer beginning with one of these keys, of this node if given, could be one overdue."""
        return any(overdue.of(node, now) and _could_be(overdue, answers) for overdue in self.overdue_replies)

    def over(self, answers: Sequence[bytes]) -> float:
        """Return when all that is overdue and could look so is later than its node's maximum reply delay allows."""
        return max((overdue.over for overdue in self.overdue_replies if _could_be(overdue, answers)), default=-inf)

    def awaited_until(self, last_byte: float, answers: Sequence[bytes] | None = None) -> float:
        """Return until when something may come (that could look so), though the line went on; -inf if nothing may.
        `last_byte` is when a byte came last."""
        until = -inf
        for overdue in self.overdue_replies:
            if overdue.awaited is not None and (answers is None or _could_be(overdue, answers)):
                # A reply can begin at the last moment and pause for longer than the learned silence: its end is known
                # only by the document's silence. A write that left in such a pause met the rest of the reply.
                over, awaited = overdue.over, overdue.awaited
                until = max(until, over, last_byte + awaited.silence if last_byte < over + awaited.lasts else over)
        return until

    def nodes_overdue(self, answers: Sequence[bytes] | None, now: float) -> Iterator[NodeRecord]:
        """Yield the nodes that owe what could look so (None: anything), and answer, as far as is known. A removed node
        is never asked."""
        for overdue in self.overdue_replies:
            if (
                overdue.node is None
                or overdue.node.removed
                or now >= overdue.until
                or not (answers is None or _could_be(overdue, answers))
            ):
                continue
            if not _is_silent(overdue) or (
                overdue.awaited is not None and now < overdue.over and overdue.node.unheard <= MOST_UNHEARD
            ):
                yield overdue.node

    def overdue(self) -> list[tuple[NodeRecord | None, bytes]]:
        """Return the node and the key of each overdue reply."""
        return [(overdue.node, overdue.key) for overdue in self.overdue_replies]

    def lone_byte_is_overdue(self) -> bool:
        """Return whether a reply of one byte is overdue, or anything that could be one."""
        return any(len(overdue.key) < 2 for overdue in self.overdue_replies)

    def ends(self, answers: Sequence[bytes], now: float) -> float:
        """Return when what is overdue and could look so can be no other node's any more; inf if that is not known."""
        return max((d.until for d in self.overdue_replies if now < d.until and _could_be(d, answers)), default=inf)

    def forgive(self, answers: Sequence[bytes]) -> None:
        """Forgive what is overdue and could look so: nothing unlike can be asked, R3's assumption must do, and
        doubt."""
        self._forgiven += [
            (overdue.key, overdue.asked + LAPSE) for overdue in self.overdue_replies if _could_be(overdue, answers)
        ]
        self.overdue_replies = [overdue for overdue in self.overdue_replies if not _could_be(overdue, answers)]

    def answered(self, node: NodeRecord, asked: float, now: float, patience: float) -> None:
        """Note a right answer that could be nobody else's, to what `node` was asked at `asked`.

        `patience` is how long a reply is taken to need, in seconds, of a node whose replies were never timed.
        """
        self.overdue_replies = [overdue for overdue in self.overdue_replies if not overdue.is_of(node)]
        for overdue in self.overdue_replies:
            # Only requests that left after the maximum reply delay prove anything: before, both replies may be on the
            # way.
            if overdue.over <= asked and overdue.until == inf and _is_silent(overdue):
                overdue.until = now + (0.0 if overdue.node is None else overdue.node.latest(patience))
                self._ambiguous.append(
                    (
                        overdue.key,
                        overdue.until + AMBIGUOUS_DELAYS * (overdue.over - overdue.asked),
                    )
                )

    def heard(self, run: bytes, now: float) -> OverdueReply | None:
        """Take all that came up to a silence, unexpected or in place of a reply. Returns whose it is, as far as is
        known.

        What nobody overdue, though it is like the last answers, was said twice. Of what is no lone answer, a part may
        be still to come: a byte of any kind.
        """
        # After a learned window two nodes may have talked at the same time: stricter rules apply to what is left of
        # that.
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
        # Nothing is left over, so nothing needs to be suspected.
        if payers and not rest:
            return payers[0]
        if not payers and any(until > now and _is(run, key) for key, until in (*self._ambiguous, *self._forgiven)):
            self._ambiguous = [entry for entry in self._ambiguous if not _is(run, entry[0])]
            self._forgiven = [entry for entry in self._forgiven if not _is(run, entry[0])]
            return None
        # Built here and not kept: unexpected bytes are rare, and exchanges are not.
        recent = {key for answers in self.recent for key in answers}
        contained = any(len(key) > 1 and key in rest for key in recent)
        alike = any(_is(rest, key) for key in recent)
        if contained or (alike and not payers):
            self.said_twice(now)
        if payers or not alike:
            self.add_overdue((ANY_BYTE,), None, now, now)
        return payers[0] if payers else None

    def _heard_late(self, awaited: list[OverdueReply], run: bytes, now: float) -> OverdueReply | None:
        """Do as `heard` does, where the line went on before a reply was over. Talkers may have met, and what is left of
        two can begin like anything: only a whole reply pays, and only where nobody owes another one: that could be it,
        to something else than was asked. Returns who seems to have said it."""
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
                # all that its request left: the lone byte, too, that could have been a part of this reply
                self.overdue_replies = [other for other in self.overdue_replies if (other.node, other.asked) != request]
        if run:
            self.add_overdue((ANY_BYTE,), None, now, now)
        return first

    def _overdue_byte(self, run: bytes) -> OverdueReply | None:
        """Find the overdue reply that the first byte pays: one alone, or before more of its kind, or before an overdue
        reply."""
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
        """Strike the overdue reply off. Where several nodes may have paid with the same words, it is not known which:
        the rest are nobody's."""
        self.overdue_replies.remove(paid)
        for overdue in self.overdue_replies:
            if overdue.key == paid.key and overdue.node is not paid.node:
                overdue.node = None

    # how far an answer can be trusted

    def said_twice(self, now: float) -> None:
        """Note that more was answered than was asked: for AMBIGUITY_PERIOD, answers like those heard lately are
        ambiguous."""
        self._ambiguous_until = max(self._ambiguous_until, now + AMBIGUITY_PERIOD)
        self.alert = True

    def said(self, answers: Sequence[bytes], now: float) -> None:
        """Note that a right answer was delivered, in case it is said again."""
        if now < self._ambiguous_until:
            self._said.append((answers, now))

    def has_ambiguity(self, now: float) -> bool:
        """Return whether something was said twice lately."""
        return now < self._ambiguous_until

    def is_to_be_held(self, answers: Sequence[bytes], now: float) -> bool:
        """Return whether a reply like this may be an overdue one that was forgiven, or the reply to a frame that an
        earlier master left unfinished."""
        lone = any(len(key) == 1 for key in answers)
        if lone and now < self.lone_bytes_until:
            return True
        return any(until > now and (key in answers if key else lone) for key, until in self._forgiven)

    def stood_alone(self, answers: Sequence[bytes]) -> None:
        """Note that no second reply came behind one that was held: what was forgiven and is like it is not to come."""
        # Channels keep the order: a second reply would have come before the end of the hold.
        self._forgiven = [entry for entry in self._forgiven if entry[0] and entry[0] not in answers]

    def is_overdue(self, now: float) -> bool:
        """Return whether a reply to an earlier request may still come."""
        return bool(self.overdue_replies) or any(until > now for _, until in self._forgiven)

    def refusals_are_ambiguous(self, now: float) -> bool:
        """Return whether a NAK may be the reply to another request than the one on the wire: every request can be
        answered with it, whatever its good replies begin with."""
        return now < self.lone_bytes_until or self.is_overdue(now)

    def came_up(self) -> None:
        """Note that the line came up: a node may hold the beginning of an earlier master's frame."""
        self.lone_bytes_until = inf
        self.alert = True

    def is_ambiguous(self, answers: Sequence[bytes], now: float) -> bool:
        """Return whether an answer like this may be one that was overtaken, or one that is said twice."""
        # Checked first: this list is nearly always empty, and the history below can have 256 entries.
        if any(until > now and key in answers for key, until in self._ambiguous):
            return True
        if now >= self._ambiguous_until:
            return False
        for said, when in reversed(self._said):
            if now - when > SAID_MEMORY:
                return False
            if any(key in answers for key in said):
                return True
        return False


def _behind(overdue: OverdueReply, run: bytes) -> bytes | None:
    """Return what comes behind this overdue reply where the run begins with all of it, and it is right; else None."""
    if overdue.awaited is None or overdue.node is None or len(overdue.key) < 2 or not run.startswith(overdue.key):
        return None
    # The reader of the request itself decides whether the reply is whole, so that no second parser can disagree.
    try:
        step = overdue.awaited.command.open(overdue.node.address, overdue.node.timings).feed(run)
    except Exception:
        return None
    return step.rest if type(step) is Done else None


def _could_be(overdue: OverdueReply, answers: Sequence[bytes]) -> bool:
    """Return whether the reply that is overdue could be taken for one of these answers."""
    return overdue.key in answers if overdue.key else any(len(key) == 1 for key in answers)


def _is_silent(overdue: OverdueReply) -> bool:
    """Return whether the overdue reply's node does not answer, as far as is known: another's answer must do. A node
    that does answer is asked itself, unless it was removed."""
    node = overdue.node
    return node is None or node.removed or node.silent or node.last_reply == -inf


def _is(run: bytes, key: bytes) -> bool:
    """Return whether these bytes are replies of that key: begin with it, or are nothing else, where it is one byte."""
    return run == key * len(run) if len(key) == 1 else bool(key) and run.startswith(key)
