"""R15, in step: which replies are owed, and which answers could be theirs.

Replies carry neither an address nor a number. A reply that was never heard may still come, however long the lateness
is over: a network or a stopped process can hold it. While it is owed, an answer that it could be is not believed.

A *debt* is one such reply: what it would begin with (its key), whose it is, and until when it could be on time. What
came in place of a whole reply leaves one with the key ANY_BYTE: its tail, a lone byte, could look like an ACK.

A debt is paid
- by its own reply, heard while nothing was asked or in place of another;
- by a right answer of the same node to something else: a node answers in the order in which it was asked;
- once its lateness is over, by a right answer of any node to something else: a channel keeps the order. In case that
  one did not, an answer like the owed one is doubted for three times its lateness;
- by LAPSE seconds.

What nobody owed and yet came, though it looks like a reply, was said twice. Then answers like those heard lately are
doubted for a while, and neighbours that could be confused are not asked one after the other where there is a choice.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from busmaster.arbiter.health import NodeRecord

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
LONGEST_ALIKE = 32
"""Answers alike, without a pause in which one too many would show, after which an unlike one is asked."""
MOST_DEBTS = 400
"""More unheard replies than fit into LAPSE at any window that is in use; the oldest goes."""


@dataclass(slots=True)
class Debt:
    """A reply that may still come. `node` is None where it cannot be told whose it is."""

    key: bytes
    node: NodeRecord | None
    asked: float
    over: float
    """From then on, it is later than its node's lateness allows."""


class InStep:
    """What is owed on one line, and how far its answers can be trusted. Times are in seconds, on the caller's clock."""

    __slots__ = ("_doubt_until", "_doubted", "_said", "alert", "alike", "before", "debts", "last")

    def __init__(self) -> None:
        self.alert = False
        """There is something to be careful of: nothing else here matters while this is False."""
        self.debts: list[Debt] = []
        self.last: Sequence[bytes] = ()
        """What would answer the exchange that was begun last."""
        self.before: Sequence[bytes] = ()
        """What would answer the one before that."""
        self.alike = 0
        """Exchanges in a row, before the last, whose answers are like its."""
        self._doubted: list[tuple[bytes, float]] = []
        self._said: deque[tuple[Sequence[bytes], float]] = deque(maxlen=256)
        self._doubt_until = -inf

    # what is owed

    def owe(self, keys: Iterable[bytes], node: NodeRecord | None, asked: float, over: float) -> None:
        """Replies that begin with these keys were not heard."""
        self.debts += [Debt(key, node, asked, over) for key in keys]
        del self.debts[:-MOST_DEBTS]
        self.alert = True

    def lapse(self, now: float) -> None:
        """Forget what has been owed for too long, and stop being careful where nothing is left to be careful of."""
        self.debts = [debt for debt in self.debts if now - debt.asked <= LAPSE]
        self._doubted = [entry for entry in self._doubted if entry[1] > now]
        self.alert = bool(self.debts or self._doubted or self._doubt_until > now)

    def clashes(self, answers: Sequence[bytes]) -> bool:
        """Whether an answer that begins with one of these keys could be a reply that is owed."""
        return any(_could_be(debt, answers) for debt in self.debts)

    def over(self, answers: Sequence[bytes]) -> float:
        """When all that is owed and could look so is later than its node's lateness allows."""
        return max((debt.over for debt in self.debts if _could_be(debt, answers)), default=-inf)

    def forgive(self, answers: Sequence[bytes]) -> None:
        """There is no unlike exchange to ask: R3's assumption must do."""
        self.debts = [debt for debt in self.debts if not _could_be(debt, answers)]

    def doubtful_answer(self, answers: Sequence[bytes]) -> None:
        """An answer came that was the oldest debt of its kind, or the answer: one of the two is still owed."""
        for place, debt in enumerate(self.debts):
            if _could_be(debt, answers):
                del self.debts[place]
                return

    def answered(self, node: NodeRecord, asked: float, now: float) -> None:
        """A right answer came that could be nobody else's, to what `node` was asked at `asked`."""
        if not self.debts:
            return
        kept: list[Debt] = []
        for debt in self.debts:
            if debt.node is node:
                continue
            if debt.over > asked:
                kept.append(debt)
            elif debt.key:
                self._doubted.append((debt.key, now + DOUBTED_LATENESSES * (debt.over - debt.asked)))
        self.debts = kept

    def heard(self, run: bytes, now: float) -> NodeRecord | None:
        """All that came while nothing was asked, or in place of a reply, up to a silence. Returns who owed it.

        A lone byte pays only if it is all that came. What nobody owed, though it is like the last answers, was said
        twice.
        """
        for place, debt in enumerate(self.debts):
            if _is(run, debt.key):
                del self.debts[place]
                self._share(debt)
                return debt.node
        for place, (key, until) in enumerate(self._doubted):
            if until > now and _is(run, key):
                del self._doubted[place]
                return None
        if any(_is(run, key) for key in (*self.last, *self.before)):
            self._doubt_until = now + DOUBT_PERIOD
            self.alert = True
        return None

    # how far an answer can be trusted

    def said(self, answers: Sequence[bytes], now: float) -> None:
        """A right answer was delivered; in case it is said again."""
        if now < self._doubt_until:
            self._said.append((answers, now))

    @property
    def doubts(self) -> bool:
        """Something was said twice lately."""
        return self._doubt_until > -inf

    def is_doubtful(self, answers: Sequence[bytes], now: float) -> bool:
        """An answer like this may be one that was overtaken, or one that is said twice."""
        if any(until > now and key in answers for key, until in self._doubted):
            return True
        if now >= self._doubt_until:
            self._doubt_until = -inf
            return False
        for said, when in reversed(self._said):
            if now - when > SAID_MEMORY:
                return False
            if any(key in answers for key in said):
                return True
        return False

    def _share(self, paid: Debt) -> None:
        """One of several nodes paid with the same words: it is not known which, so the rest are nobody's."""
        for debt in self.debts:
            if debt.key == paid.key and debt.node is not paid.node:
                debt.node = None


def _could_be(debt: Debt, answers: Sequence[bytes]) -> bool:
    """The reply that is owed could be taken for one of these answers."""
    return debt.key in answers if debt.key else any(len(key) == 1 for key in answers)


def _is(run: bytes, key: bytes) -> bool:
    """These bytes are the reply of that key: it begins with it, or is it, where that is one byte."""
    return run == key if len(key) == 1 else bool(key) and run.startswith(key)
