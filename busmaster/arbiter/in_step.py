"""R15, in step: which replies are owed, and which answers could be theirs.

Replies carry neither an address nor a number. A reply that was never heard may still come, however long the lateness
is over: a network or a stopped process can hold it. While it is owed, an answer that it could be is not believed.

A *debt* is one such reply: what it would begin with (its key), whose it is, and until when it could be on time. What
came in place of a whole reply leaves one with the key ANY_BYTE: its tail, a lone byte, could look like an ACK.

A debt is paid
- by its own reply, heard while nothing was asked or in place of another (by a whole one, where the line went on after a
  learned window: talkers may have met on it, and what is left of two can begin like anything);
- by a right answer of the same node to something else: a node answers in the order in which it was asked;
- once its lateness is over, and where its node has been silent since, by a right answer of any node to something else:
  a channel keeps the order. It stays for as long as its node could still take: what was held up together is let go
  together, and the slower node answers last. Then only that node's answer can be it, and one like it of another is
  doubted for three times its lateness;
- by LAPSE seconds.

Where every unlike request is owed an answer too, a debt is *forgiven*: the request goes although its answer could be
the overdue one. That answer is held until the maximum reply delay is over: if a second one comes, neither is believed.

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
"""The key of a debt that any lone byte could pay."""
LAPSE = 10.0
"""Seconds after its request in which a reply is owed: TCP gives up on most paths that stand still for longer."""
DOUBTED_LATENESSES = 3.0
"""For how many latenesses an answer like one that was believed to be overtaken is doubted."""
DOUBT_PERIOD = 30.0
"""Seconds after something was said twice in which answers like those heard lately are doubted."""
SAID_MEMORY = 0.5
"""Seconds for which what was said may be said again."""
RECENT = 128
"""Exchanges of which a reply may be said a second time: about so many fit into the longest maximum reply delay."""
MOST_UNHEARD = 4
"""Learned windows in a row that may bring nothing before a node is taken to be silent."""
MOST_DEBTS = 400
"""More unheard replies than fit into LAPSE at any window that is in use; the oldest goes."""


@dataclass(frozen=True, slots=True)
class Awaited:
    """Of a reply that may still be on time: what it answers, the learned `window` after which the line went on, and the
    `silence` after which it is over, as the document says; in seconds."""

    command: Command[Any]
    window: float
    silence: float


@dataclass(slots=True)
class Debt:
    """A reply that may still come. `node` is None where it cannot be told whose it is."""

    key: bytes
    node: NodeRecord | None
    asked: float
    over: float
    """From then on, it is later than its node's lateness allows."""
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


class InStep:
    """What is owed on one line, and how far its answers can be trusted. Times are in seconds, on the caller's clock."""

    __slots__ = (
        "_doubt_until",
        "_doubted",
        "_forgiven",
        "_said",
        "alert",
        "debts",
        "last",
        "lone_bytes_until",
        "recent",
    )

    def __init__(self, strict: bool = False) -> None:
        """Begin with nothing owed. If `strict`, it is always as if something had been said twice a moment ago."""
        self.alert = strict
        """There is something to be careful of: nothing else here matters while this is False."""
        self.debts: list[Debt] = []
        self.last: Sequence[bytes] = ()
        """What would answer the exchange that was begun last."""
        self.recent: deque[Sequence[bytes]] = deque(maxlen=RECENT)
        """The keys of its replies and of those before: a reply like one of these that is not overdue was sent twice."""
        self._doubted: list[tuple[bytes, float]] = []
        self._forgiven: list[tuple[bytes, float]] = []
        self.lone_bytes_until = -inf
        """Until then a lone byte may be a node's reply to a frame that an earlier master left unfinished; inf until the
        first frame was sent."""
        self._said: deque[tuple[Sequence[bytes], float]] = deque(maxlen=256)
        self._doubt_until = inf if strict else -inf

    # what is owed

    def owe(
        self,
        keys: Iterable[bytes],
        node: NodeRecord | None,
        asked: float,
        over: float,
        awaited: Awaited | None = None,
    ) -> None:
        """Note that replies that begin with these keys were not heard, see `Debt`."""
        self.debts += [Debt(key, node, asked, over, inf, awaited) for key in keys]
        del self.debts[:-MOST_DEBTS]
        self.alert = True

    def lapse(self, now: float) -> None:
        """Forget what has been owed for too long, and stop being careful where nothing is left to be careful of."""
        self.debts = [debt for debt in self.debts if now - debt.asked <= LAPSE]
        self._doubted = [entry for entry in self._doubted if entry[1] > now]
        self._forgiven = [entry for entry in self._forgiven if entry[1] > now]
        unsure = self.debts or self._doubted or self._forgiven
        self.alert = bool(unsure or self._doubt_until > now or self.lone_bytes_until > now)

    def clashes(self, answers: Sequence[bytes], now: float, node: NodeRecord | None = None) -> bool:
        """Return whether an answer beginning with one of these keys, of this node if given, could be one owed."""
        return any(debt.of(node, now) and _could_be(debt, answers) for debt in self.debts)

    def over(self, answers: Sequence[bytes]) -> float:
        """Return when all that is owed and could look so is later than its node's lateness allows."""
        return max((debt.over for debt in self.debts if _could_be(debt, answers)), default=-inf)

    def awaited_until(self, last_byte: float, answers: Sequence[bytes] | None = None) -> float:
        """Return until when something may come (that could look so), though the line went on; -inf if nothing may.
        `last_byte` is when a byte came last."""
        until = -inf
        for debt in self.debts:
            if debt.awaited is not None and (answers is None or _could_be(debt, answers)):
                over = debt.over
                until = max(until, over, last_byte + debt.awaited.silence if last_byte < over else over)
        return until

    def owing(self, answers: Sequence[bytes] | None, now: float) -> Iterator[NodeRecord]:
        """Yield the nodes that owe what could look so (None: anything), and answer, as far as is known. A removed node
        is never asked."""
        for debt in self.debts:
            if (
                debt.node is None
                or debt.node.removed
                or now >= debt.until
                or not (answers is None or _could_be(debt, answers))
            ):
                continue
            if not _is_silent(debt) or (
                debt.awaited is not None and now < debt.over and debt.node.unheard <= MOST_UNHEARD
            ):
                yield debt.node

    def owed(self) -> list[tuple[NodeRecord | None, bytes]]:
        """Return the node and the key of each debt."""
        return [(debt.node, debt.key) for debt in self.debts]

    def owes_lone_byte(self) -> bool:
        """Return whether a reply of one byte is overdue, or anything that could be one."""
        return any(len(debt.key) < 2 for debt in self.debts)

    def ends(self, answers: Sequence[bytes], now: float) -> float:
        """Return when what is owed and could look so can be no other node's any more; inf if that is not known."""
        return max((d.until for d in self.debts if now < d.until and _could_be(d, answers)), default=inf)

    def forgive(self, answers: Sequence[bytes]) -> None:
        """Forgive what is owed and could look so: nothing unlike can be asked, R3's assumption must do, and doubt."""
        self._forgiven += [(debt.key, debt.asked + LAPSE) for debt in self.debts if _could_be(debt, answers)]
        self.debts = [debt for debt in self.debts if not _could_be(debt, answers)]

    def answered(self, node: NodeRecord, asked: float, now: float, patience: float) -> None:
        """Note a right answer that could be nobody else's, to what `node` was asked at `asked`.

        `patience` is how long a reply is taken to need, in seconds, of a node whose replies were never timed.
        """
        self.debts = [debt for debt in self.debts if not debt.is_of(node)]
        for debt in self.debts:
            if debt.over <= asked and debt.until == inf and _is_silent(debt):
                debt.until = now + (0.0 if debt.node is None else debt.node.latest(patience))
                self._doubted.append((debt.key, debt.until + DOUBTED_LATENESSES * (debt.over - debt.asked)))

    def heard(self, run: bytes, now: float) -> Debt | None:
        """Take all that came up to a silence, unasked or in place of a reply. Returns whose it is, as far as is known.

        What nobody owed, though it is like the last answers, was said twice. Of what is no lone answer, a part may
        be still to come: a byte of any kind.
        """
        awaited = [debt for debt in self.debts if debt.awaited is not None]
        if awaited:
            return self._heard_late(awaited, run, now)
        payers: list[Debt] = []
        rest = run
        while (debt := self._owed_byte(rest)) is not None:
            payers.append(debt)
            self._pay(debt)
            rest = rest[1:]
        for debt in [debt for debt in self.debts if len(debt.key) > 1]:
            place = rest.find(debt.key)
            if place >= 0:
                payers.append(debt)
                self._pay(debt)
                rest = rest[:place] + rest[place + len(debt.key) :]
        if payers and not rest:
            return payers[0]
        if not payers and any(until > now and _is(run, key) for key, until in (*self._doubted, *self._forgiven)):
            self._doubted = [entry for entry in self._doubted if not _is(run, entry[0])]
            self._forgiven = [entry for entry in self._forgiven if not _is(run, entry[0])]
            return None
        recent = {key for answers in self.recent for key in answers}
        contained = any(len(key) > 1 and key in rest for key in recent)
        alike = any(_is(rest, key) for key in recent)
        if contained or (alike and not payers):
            self.said_twice(now)
        if payers or not alike:
            self.owe((ANY_BYTE,), None, now, now)
        return payers[0] if payers else None

    def _heard_late(self, awaited: list[Debt], run: bytes, now: float) -> Debt | None:
        """Do as `heard` does, where the line went on before a reply was over. Talkers may have met, and what is left of
        two can begin like anything: only a whole reply pays, and only where nobody owes another one: that could be it,
        to something else than was asked. Returns who seems to have said it."""
        first = None
        while found := next(((debt, rest) for debt in awaited if (rest := _behind(debt, run)) is not None), None):
            debt, run = found
            first = first or debt
            awaited.remove(debt)
            request = (debt.node, debt.asked)
            if all((other.node, other.asked) == request for other in self.debts if other.awaited is not None):
                # all that its request left: the lone byte, too, that could have been a part of this reply
                self.debts = [other for other in self.debts if (other.node, other.asked) != request]
        if run:
            self.owe((ANY_BYTE,), None, now, now)
        return first

    def _owed_byte(self, run: bytes) -> Debt | None:
        """Find the debt that the first byte pays: one alone, or before more of its kind, or before an owed reply."""
        more = run[1:]
        if (
            more
            and more != run[:1] * len(more)
            and not any(len(d.key) > 1 and more.startswith(d.key) for d in self.debts)
        ):
            return None
        return next((debt for debt in self.debts if debt.key and debt.key == run[:1]), None)

    def _pay(self, paid: Debt) -> None:
        """Strike the debt off. Where several nodes may have paid with the same words, it is not known which: the rest
        are nobody's."""
        self.debts.remove(paid)
        for debt in self.debts:
            if debt.key == paid.key and debt.node is not paid.node:
                debt.node = None

    # how far an answer can be trusted

    def said_twice(self, now: float) -> None:
        """Note that more was answered than was asked: for DOUBT_PERIOD, answers like those heard lately are doubted."""
        self._doubt_until = max(self._doubt_until, now + DOUBT_PERIOD)
        self.alert = True

    def said(self, answers: Sequence[bytes], now: float) -> None:
        """Note that a right answer was delivered, in case it is said again."""
        if now < self._doubt_until:
            self._said.append((answers, now))

    def doubts(self, now: float) -> bool:
        """Return whether something was said twice lately."""
        return now < self._doubt_until

    def is_to_be_held(self, answers: Sequence[bytes], now: float) -> bool:
        """Return whether a reply like this may be an overdue one that was forgiven, or the reply to a frame that an
        earlier master left unfinished."""
        lone = any(len(key) == 1 for key in answers)
        if lone and now < self.lone_bytes_until:
            return True
        return any(until > now and (key in answers if key else lone) for key, until in self._forgiven)

    def stood_alone(self, answers: Sequence[bytes]) -> None:
        """Note that no second reply came behind one that was held: what was forgiven and is like it is not to come."""
        self._forgiven = [entry for entry in self._forgiven if entry[0] and entry[0] not in answers]

    def is_overdue(self, now: float) -> bool:
        """Return whether a reply to an earlier request may still come."""
        return bool(self.debts) or any(until > now for _, until in self._forgiven)

    def doubts_refusals(self, now: float) -> bool:
        """Return whether a NAK may be the reply to another request than the one on the wire: every request can be
        answered with it, whatever its good replies begin with."""
        return now < self.lone_bytes_until or self.is_overdue(now)

    def came_up(self) -> None:
        """Note that the line came up: a node may hold the beginning of an earlier master's frame."""
        self.lone_bytes_until = inf
        self.alert = True

    def is_doubtful(self, answers: Sequence[bytes], now: float) -> bool:
        """Return whether an answer like this may be one that was overtaken, or one that is said twice."""
        if any(until > now and key in answers for key, until in self._doubted):
            return True
        if now >= self._doubt_until:
            return False
        for said, when in reversed(self._said):
            if now - when > SAID_MEMORY:
                return False
            if any(key in answers for key in said):
                return True
        return False


def _behind(debt: Debt, run: bytes) -> bytes | None:
    """Return what comes behind this debt's reply where the run begins with all of it, and it is right; else None."""
    if debt.awaited is None or debt.node is None or len(debt.key) < 2 or not run.startswith(debt.key):
        return None
    try:
        step = debt.awaited.command.open(debt.node.address, debt.node.timings).feed(run)
    except Exception:
        return None
    return step.rest if type(step) is Done else None


def _could_be(debt: Debt, answers: Sequence[bytes]) -> bool:
    """Return whether the reply that is owed could be taken for one of these answers."""
    return debt.key in answers if debt.key else any(len(key) == 1 for key in answers)


def _is_silent(debt: Debt) -> bool:
    """Return whether the debt's node does not answer, as far as is known: another's answer must do. A node that does
    answer is asked itself, unless it was removed."""
    node = debt.node
    return node is None or node.removed or node.silent or node.last_reply == -inf


def _is(run: bytes, key: bytes) -> bool:
    """Return whether these bytes are replies of that key: begin with it, or are nothing else, where it is one byte."""
    return run == key * len(run) if len(key) == 1 else bool(key) and run.startswith(key)
