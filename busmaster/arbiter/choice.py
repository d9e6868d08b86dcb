"""What goes next, where answers could be taken for one another (R15).

Most of the time nothing is owed, and the first that waits goes. Otherwise it goes only if its answer cannot be one
that is owed; else another of its class whose answer cannot, or a *check*: a read whose right answer proves that the
line is in step. An urgent write is never held back; its answer may then be doubted.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from math import inf
from typing import Any, TypeAlias

from busmaster.arbiter.alike import Alike
from busmaster.arbiter.dispatcher import Dispatcher
from busmaster.arbiter.health import UP, NodeRecord
from busmaster.arbiter.in_step import MOST_UNHEARD, InStep
from busmaster.arbiter.on_wire import OnWire
from busmaster.arbiter.transaction import URGENT, Transaction
from busmaster.contract.exchange import Command, Exchange

MOST_BEFORE = 3
"""Exchanges that may go before one that is held back; then it goes, and its answer is doubted. The bounds of R9, in
planning, count them."""

Chosen: TypeAlias = tuple[Transaction, Exchange[Any]]
Unfit: TypeAlias = Callable[[Sequence[bytes], NodeRecord], bool]
"""Whether what would answer an exchange of that node proves nothing."""


class Choice:
    """Chooses for one line, from what its dispatcher has waiting, by what `in_step` says is owed; `wire` has times."""

    def __init__(self, dispatcher: Dispatcher, in_step: InStep, wire: OnWire) -> None:
        self._dispatcher = dispatcher
        self._in_step = in_step
        self._alike = Alike(wire)
        self._gone_before = 0
        self._held_since = -inf
        """When the first went before the one that is held back."""
        self._last_byte = -inf

    def next(self, now: float, last_byte: float) -> Chosen | float | None:
        """Return the transaction to be sent now and its exchange; None if none waits; a time if none may go before it.

        `last_byte` is when the last byte came, in seconds.
        """
        dispatcher = self._dispatcher
        while (transaction := dispatcher.next(now)) is not None:
            node = transaction.node
            try:
                timings = node.timings if node.learning is None else transaction.timings()
                exchange = transaction.command.open(node.address, timings)
                answers = exchange.answers  # a protocol may lack it: found out here, it fails this one alone
            except Exception as bug:
                dispatcher.unsendable(transaction, bug, now)
            else:
                break
        else:
            return None
        in_step, alike = self._in_step, self._alike
        last = in_step.last
        if answers == last and not exchange.later:
            too_many = alike.another(exchange, last_byte, now)
            if too_many or in_step.alert:
                return self._carefully((transaction, exchange), now, last_byte, too_many)
        elif in_step.alert:
            return self._carefully((transaction, exchange), now, last_byte)
        else:
            alike.count = 0
        alike.node = node
        in_step.last = answers
        in_step.recent.append(answers)
        return transaction, exchange

    def _carefully(self, first: Chosen, now: float, last_byte: float, too_many: bool = False) -> Chosen | float:
        """Choose as `next` does, where something is owed or doubted, or `too_many` answers were alike."""
        in_step = self._in_step
        self._last_byte = last_byte
        in_step.lapse(now)
        chosen: Chosen | float = first
        transaction, exchange = first
        answers = exchange.answers

        def alike(other: Sequence[bytes], node: NodeRecord) -> bool:
            return other == answers or in_step.clashes(other, now, node)

        # Only its first attempt: a late answer to that one is not the retry's, which needs proof as any other does.
        if transaction.priority is URGENT and transaction.writes and not transaction.attempts:
            pass
        elif transaction.writes and now < in_step.lone_bytes_until and any(len(key) == 1 for key in answers):
            chosen = self._before_first_write(first, now)
        elif _is_decisive(first) and now < in_step.awaited_until(self._last_byte):
            chosen = self._while_awaited(first, now) or in_step.awaited_until(self._last_byte)
        elif transaction.probe and in_step.clashes(answers, now, transaction.node):
            # The reply to the probe before may still come, and would be taken for this one's.
            chosen = self._other_probe(transaction, now) or self._instead_of(first, now)
        elif in_step.clashes(answers, now):
            chosen = self._instead_of(first, now)
        elif in_step.clashes(answers, now, transaction.node):
            chosen = self._ask_itself(first, now) or first
        elif too_many:
            unlike = self._another(first, now, alike)
            chosen = unlike or self._ask_check(self._whom_to_ask(now)[0], now, alike) or first
            self._alike.count = 0
        elif in_step.doubts(now) and answers == in_step.last:
            chosen = self._another(first, now, alike) or first
        if chosen is first:
            self._gone_before = 0
        if not isinstance(chosen, tuple):  # a time: in the proof (tests/proof) that is no float
            self._dispatcher.backlog.restore(transaction)
        else:
            if chosen[0] is not transaction:
                self._dispatcher.backlog.restore(transaction)
            if chosen[1].answers != in_step.last:
                self._alike.count = 0
            self._alike.node = chosen[0].node
            in_step.last = chosen[1].answers
            in_step.recent.append(in_step.last)
        return chosen

    def _instead_of(self, first: Chosen, now: float) -> Chosen | float:
        """Return what goes in place of one whose answer could be one that is owed; a time if none may go before it."""
        in_step, answers = self._in_step, first[1].answers

        def clashes(answers: Sequence[bytes], node: NodeRecord) -> bool:
            return in_step.clashes(answers, now, node)

        awaited = in_step.awaited_until(self._last_byte, answers)
        if now < awaited:
            return self._while_awaited(first, now, answers) or awaited
        if self._gone_before >= MOST_BEFORE:
            return first

        def proves_nothing(answers: Sequence[bytes], node: NodeRecord) -> bool:
            return in_step.clashes(answers, now)

        owing = dict.fromkeys(in_step.owing(answers, now))
        other = None
        if self._gone_before < MOST_BEFORE - 1:
            of = first[0].node if first[0].node in owing else None  # only its own answer proves that it owes no more
            other = self._another(first, now, clashes, of)
        if other is None:
            ends = in_step.ends(answers, now)
            if ends < inf:  # what its own node owes has to be asked for then, too
                own = in_step.clashes(answers, ends, first[0].node)
                return (self._ask_itself(first, now) if own else None) or ends
            asked, silent = self._whom_to_ask(now)
            worth_it = first[0].writes or not first[0].attempts
            if worth_it and not (owing or asked):  # all are silent: a check of its own node costs no more than it would
                asked = [first[0].node]
            # Who owes goes first: its answer pays at once, another node's only when the lateness is over.
            other = self._ask_check([*owing, *asked], now, clashes)
            if other is None and not any(_fit_checks(silent, proves_nothing)):  # there is nothing unlike to ask
                over = in_step.over(answers)
                if now < over:
                    return over
                in_step.forgive(answers)
        if other is None:
            return first
        self._gone_before += 1
        return other

    def _before_first_write(self, first: Chosen, now: float) -> Chosen | float:
        """Return what goes before the first write on a line that came up: a read, which ends what a node holds of an
        earlier master's frame; then the time until which that node may reply. A write that is refused by such a node's
        NAK would be sent again, and be carried out twice."""
        in_step, transaction = self._in_step, first[0]
        node = transaction.node

        def clashes(answers: Sequence[bytes], node: NodeRecord) -> bool:
            return in_step.clashes(answers, now, node)

        other = self._another(first, now, clashes)
        if other is not None:
            return other
        if in_step.lone_bytes_until < inf:
            return in_step.lone_bytes_until
        alive, silent = self._whom_to_ask(now)
        own = [] if node.address == node.profile.broadcast else [node]
        # Without a read to send, the write goes: its refusal is then not believed.
        return self._ask_check(dict.fromkeys([*own, *alive, *silent]), now, clashes) or first

    def _while_awaited(self, first: Chosen, now: float, answers: Sequence[bytes] | None = None) -> Chosen | None:
        """Return what goes while an owed answer (that could look so) may still be on time, though the line went on: a
        check of the node that owes it, which shows that it is not to come; else another. After two, only checks, which
        are short where times are learned, and only for a lateness: with the wait that is left that is no longer than
        MOST_BEFORE exchanges can last. Then returns None."""
        if not self._gone_before:
            self._held_since = now
        two_gone = self._gone_before >= MOST_BEFORE - 1
        urgent, timings = first[0].priority is URGENT, first[0].node.timings
        if two_gone and (urgent or now >= self._held_since + timings.read.lateness):
            return None

        def clashes(answers: Sequence[bytes], node: NodeRecord) -> bool:
            return self._in_step.clashes(answers, now, node)

        owing = dict.fromkeys(self._in_step.owing(answers, now))
        other = self._of_these(owing, now, clashes) or self._ask_check(owing, now, clashes)
        if other is None and not two_gone:
            other = self._another(first, now, clashes)
        if other is not None and not two_gone:
            self._gone_before += 1
        return other

    def _of_these(self, nodes: Container[NodeRecord], now: float, unfit: Unfit) -> Chosen | None:
        """Take out a read of one of these nodes that waits anyway, of whatever class: unlike a check, it is free."""
        opened: list[Exchange[Any]] = []

        def suits(other: Transaction) -> bool:
            node = other.node
            if other.writes or node not in nodes or not self._dispatcher.may_go(other, now):
                return False
            if self._dispatcher.writes.queues.get(node):  # no read overtakes a write to its node
                return False
            exchange = _opened(other)
            # A last attempt must not go while something is awaited, not even in place of a check.
            if exchange is None or _is_decisive((other, exchange)) or unfit(exchange.answers, node):
                return False
            opened.append(exchange)
            return True

        transaction = self._dispatcher.backlog.take(suits)
        return None if transaction is None else (transaction, opened[0])

    def _ask_itself(self, first: Chosen, now: float) -> Chosen | None:
        """Return a check of a node that owes what it is to be asked for: its answer would not be believed. Returns None
        for a node that is likely to be dead."""
        node = first[0].node
        # A death would cost the living an exchange. Where times are learned that is a short one.
        brief = node.learning is not None and not node.failures
        dead = node.unheard > MOST_UNHEARD if brief else node.silent
        if dead or self._gone_before >= MOST_BEFORE:
            return None
        self._gone_before += 1
        return self._ask_check([node], now, lambda answers, node: self._in_step.clashes(answers, now, node))

    def _other_probe(self, probe: Transaction, now: float) -> Chosen | None:
        """Have a probe ask the same dead node for something that is not owed. Returns None where there is nothing."""
        node = probe.node
        for command in node.checks():
            exchange = command.open(node.address, node.timings)
            if not self._in_step.clashes(exchange.answers, now, node):
                probe.command = command
                return probe, exchange
        return None

    def _another(self, first: Chosen, now: float, unfit: Unfit, of: NodeRecord | None = None) -> Chosen | None:
        """Take out a read of the same class, `of` this node if one is given, or return None. It overtakes no write to
        its node. A write would prove less, for an ACK may be anybody's; and what spoils a read, which is repeated,
        would leave a write unconfirmed."""
        opened: list[Exchange[Any]] = []
        written = {first[0].node} if first[0].writes else set()
        in_step = self._in_step
        awaited = now < in_step.awaited_until(self._last_byte)

        def suits(other: Transaction) -> bool:
            if other.writes:
                written.add(other.node)
                return False
            if other.node in written or of not in (None, other.node) or not self._dispatcher.may_go(other, now):
                return False
            exchange = _opened(other)
            if exchange is None or unfit(exchange.answers, other.node):
                return False
            if awaited and (_is_decisive((other, exchange)) or in_step.clashes(exchange.answers, now)):
                return False
            opened.append(exchange)
            return True

        transaction = self._dispatcher.backlog.pick(first[0].priority, suits)
        return None if transaction is None else (transaction, opened[0])

    def _ask_check(self, nodes: Iterable[NodeRecord], now: float, unfit: Unfit) -> Chosen | None:
        """Return a read of the first of these nodes that has one whose answer is fit to prove something, or None."""
        for node, command, exchange in _fit_checks(nodes, unfit):
            check = self._dispatcher.check(node, command, now)
            if node.learning is not None:
                exchange = command.open(node.address, check.timings())
            return check, exchange
        return None

    def _whom_to_ask(self, now: float) -> tuple[list[NodeRecord], list[NodeRecord]]:
        """Return the nodes that answer, as far as is known, the last one to do so first; and those that are silent."""
        nodes = [
            node
            for node in self._dispatcher.nodes
            if node.address != node.profile.broadcast and node.suspended_until <= now
        ]
        alive = [node for node in nodes if not node.silent]
        # Two stable sorts in place of one by a negated time: the proof's instants (tests/proof) have no negative.
        alive.sort(key=lambda node: node.last_reply, reverse=True)
        alive.sort(key=lambda node: node.health is not UP)
        return alive, [node for node in nodes if node.silent]


def _fit_checks(nodes: Iterable[NodeRecord], unfit: Unfit) -> Iterator[tuple[NodeRecord, Command[Any], Exchange[Any]]]:
    """Yield the reads of these nodes whose answers are fit to prove something."""
    for node in nodes:
        for command in node.checks():
            exchange = command.open(node.address, node.timings)
            if not unfit(exchange.answers, node):
                yield node, command, exchange


def _is_decisive(chosen: Chosen) -> bool:
    """Return whether this is a write, or a read's last attempt: nothing that could be waited for may spoil it."""
    transaction, exchange = chosen
    last = transaction.retried >= transaction.retries and not transaction.probe
    return transaction.writes or not exchange.answered or last


def _opened(transaction: Transaction) -> Exchange[Any] | None:
    """Return an exchange, or None where the protocol cannot encode it: that is told when its turn has come."""
    try:
        return transaction.command.open(transaction.node.address, transaction.timings())
    except Exception:
        return None
