"""What goes next, where answers could be taken for one another (R15).

Most of the time nothing is overdue, and the first that waits goes. Otherwise it goes only if its answer cannot be one
that is overdue; else another of its class whose answer cannot, or a *check*: a read whose right answer proves that the
line is in sync. An urgent write is never held back; its answer may then be ambiguous.

The run of answers that are alike, and when one too many would have shown in it (R15).

Where everything that is asked is answered alike, one doubled reply leaves every later answer one exchange behind: it is
taken for the answer to the next request, whose own is taken for that of the one after it, and so on, with nothing
overdue and no unexpected byte to be seen. A read whose answer is unlike shows it, and costs an exchange; a pause shows
it.

Times show it too, on a port whose bytes leave at the baud rate. In sync, a node has heard its request when it begins to
think of the answer. One exchange behind, what comes is the answer to the request before, and that node was free to
think of it no later than when the answer before was taken: at which moment this request began to leave. So what comes
is sooner than it would be in sync, by the time that the request needs on the wire. Nodes with delays of their own show
each other's; over a run that cancels out, and the answers are sooner by that time on average.

So an answer is *untimely* if it differs from its node's usual one by more than half of that time. A run in which one
was is checked as if there were no times: one that came sooner may have been the one before's; one that came later says
that the usual times are not what they were, or that the process or a driver stood still, which hides how soon an answer
was. It hides that of one answer, not of those behind it: nothing is concluded from how long an answer took, and none
vouches for another. A run of timely answers alone is checked too, in the end: a device that waits for a silent line,
and only then begins to think, answers no sooner one exchange behind.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from math import inf
from typing import Any, NamedTuple, TypeAlias

from busmaster.arbiter.dispatcher import Dispatcher
from busmaster.arbiter.health import UP, NodeRecord
from busmaster.arbiter.in_sync import MOST_UNHEARD, InSync
from busmaster.arbiter.on_wire import OnWire
from busmaster.arbiter.transaction import URGENT, Transaction
from busmaster.contract.exchange import Command, Exchange

LONGEST_ALIKE = 31
"""Answers alike behind a first one, some of them untimely, after which an unlike one is asked: 32 in all."""
LONGEST_STEADY = 127
"""As many where all of them were timely."""
USUAL_SHARE = 1 / 8
"""How much of a node's usual time the last answer is."""


class Alike:
    """Of one line. `node` is the one that was asked last."""

    __slots__ = ("_untimely", "_wire", "count", "node")

    def __init__(self, wire: OnWire) -> None:
        self._wire = wire
        self._untimely = False
        self.count = 0
        """Exchanges in a row, before the last, whose answers are like its."""
        self.node: NodeRecord | None = None

    def another(self, exchange: Exchange[Any], last_byte: float, now: float) -> bool:
        """Count one more exchange, and return whether one that is unlike is to go first.

        `last_byte` is when the last byte of the last answer came, in seconds.
        """
        step = self._wire.step
        # in a pause that is longer than its reply can be awaited an answer too many would have come
        if now - last_byte - step.latency > exchange.timing.awaited:
            self.count = 0
            return False
        self.count += 1
        if not step.paced:  # where bytes leave when they like, times show nothing
            return self.count >= LONGEST_ALIKE
        untimely = self._was_untimely(last_byte - step.end, len(exchange.request) * step.byte_time)
        if self.count == 1:  # the one before it was unlike: whatever its time, it was its own
            self._untimely = False
        elif untimely:
            self._untimely = True
        return self.count >= (LONGEST_ALIKE if self._untimely else LONGEST_STEADY)

    def _was_untimely(self, took: float, asking: float) -> bool:
        """Return whether times fail to show that the last answer was its own request's. It came `took` seconds after
        that request, which needed `asking` seconds on the wire."""
        node = self.node
        if node is None or took < 0:  # below 0: there was none
            return True
        usual = node.usual
        if usual is None:
            node.usual = took
            return True
        node.usual = usual + USUAL_SHARE * (took - usual)
        return abs(took - usual) > asking / 2


MOST_BEFORE = 3
"""Exchanges that may go before one that is held back; then it goes, and its answer is ambiguous. The bounds of R9, in
planning, count them."""


class Send(NamedTuple):
    """Send this transaction now, as this exchange."""

    transaction: Transaction
    exchange: Exchange[Any]


class WaitUntil(NamedTuple):
    """Send nothing before this time, in seconds: an overdue reply may still come."""

    time: float


class Idle:
    """Nothing waits."""


IDLE = Idle()
Action: TypeAlias = Send | WaitUntil | Idle
"""What the line does next."""
Unfit: TypeAlias = Callable[[Sequence[bytes], NodeRecord], bool]
"""Whether what would answer an exchange of that node proves nothing."""


class Choice:
    """Chooses for one line, from what its dispatcher has waiting, by what `in_sync` says is overdue; `wire` has
    times."""

    def __init__(self, dispatcher: Dispatcher, in_sync: InSync, wire: OnWire) -> None:
        self._dispatcher = dispatcher
        self._in_sync = in_sync
        self._alike = Alike(wire)
        self._gone_before = 0
        self._held_since = -inf
        """When the first went before the one that is held back."""
        self._last_byte = -inf

    def next(self, now: float, last_byte: float) -> Action:
        """Return what the line does now. `last_byte` is when the last byte came, in seconds."""
        dispatcher = self._dispatcher
        # A transaction that its protocol cannot encode must not stop the line: it fails, and the next one is tried.
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
            return IDLE
        in_sync, alike = self._in_sync, self._alike
        last = in_sync.last
        # An exchange with several steps (MSC) shows a shift by itself: an ACK does not look like a packet.
        if answers == last and not exchange.later:
            too_many = alike.another(exchange, last_byte, now)
            if too_many or in_sync.alert:
                return self._carefully(Send(transaction, exchange), now, last_byte, too_many)
        elif in_sync.alert:
            return self._carefully(Send(transaction, exchange), now, last_byte)
        else:
            alike.count = 0
        alike.node = node
        in_sync.last = answers
        in_sync.recent.append(answers)
        return Send(transaction, exchange)

    def _carefully(self, first: Send, now: float, last_byte: float, too_many: bool = False) -> Send | WaitUntil:
        """Choose as `next` does, where something is overdue or ambiguous, or `too_many` answers were alike."""
        in_sync = self._in_sync
        self._last_byte = last_byte
        in_sync.lapse(now)
        chosen: Send | WaitUntil = first
        transaction, exchange = first
        answers = exchange.answers

        def alike(other: Sequence[bytes], node: NodeRecord) -> bool:
            return other == answers or in_sync.clashes(other, now, node)

        # Only its first attempt: a late answer to that one is not the retry's, which needs proof as any other does.
        if transaction.priority is URGENT and transaction.writes and not transaction.attempts:
            pass
        elif transaction.writes and now < in_sync.lone_bytes_until and any(len(key) == 1 for key in answers):
            chosen = self._before_first_write(first, now)
        elif _is_decisive(first) and now < in_sync.awaited_until(self._last_byte):
            chosen = self._while_awaited(first, now) or WaitUntil(in_sync.awaited_until(self._last_byte))
        elif transaction.probe and in_sync.clashes(answers, now, transaction.node):
            # The reply to the probe before may still come, and would be taken for this one's.
            chosen = self._other_probe(transaction, now) or self._instead_of(first, now)
        elif in_sync.clashes(answers, now):
            chosen = self._instead_of(first, now)
        elif in_sync.clashes(answers, now, transaction.node):
            chosen = self._ask_itself(first, now) or first
        elif too_many:
            unlike = self._another(first, now, alike)
            chosen = unlike or self._ask_sync_read(self._whom_to_ask(now)[0], now, alike) or first
            self._alike.count = 0
        elif in_sync.has_ambiguity(now) and answers == in_sync.last:
            chosen = self._another(first, now, alike) or first
        if chosen is first:
            self._gone_before = 0
        if isinstance(chosen, WaitUntil):
            self._dispatcher.backlog.restore(transaction)
            return chosen
        if chosen.transaction is not transaction:
            self._dispatcher.backlog.restore(transaction)
        if chosen.exchange.answers != in_sync.last:
            self._alike.count = 0
        self._alike.node = chosen.transaction.node
        in_sync.last = chosen.exchange.answers
        in_sync.recent.append(in_sync.last)
        return chosen

    def _instead_of(self, first: Send, now: float) -> Send | WaitUntil:
        """Return what goes in place of one whose answer could be one that is overdue."""
        in_sync, answers = self._in_sync, first.exchange.answers

        def clashes(answers: Sequence[bytes], node: NodeRecord) -> bool:
            return in_sync.clashes(answers, now, node)

        awaited = in_sync.awaited_until(self._last_byte, answers)
        if now < awaited:
            return self._while_awaited(first, now, answers) or WaitUntil(awaited)
        # R9 bounds the wait: after three others it is sent anyway, and its reply is weighed with more care.
        if self._gone_before >= MOST_BEFORE:
            return first

        def proves_nothing(answers: Sequence[bytes], node: NodeRecord) -> bool:
            return in_sync.clashes(answers, now)

        nodes_overdue = dict.fromkeys(in_sync.nodes_overdue(answers, now))
        other = None
        if self._gone_before < MOST_BEFORE - 1:
            node = first.transaction.node
            of = node if node in nodes_overdue else None  # only its own answer proves that it owes no more
            other = self._another(first, now, clashes, of)
        if other is None:
            ends = in_sync.ends(answers, now)
            if ends < inf:  # what its own node owes has to be asked for then, too
                own = in_sync.clashes(answers, ends, first.transaction.node)
                return (self._ask_itself(first, now) if own else None) or WaitUntil(ends)
            asked, silent = self._whom_to_ask(now)
            worth_it = first.transaction.writes or not first.transaction.attempts
            if worth_it and not (
                nodes_overdue or asked
            ):  # all are silent: a check of its own node costs no more than it would
                asked = [first.transaction.node]
            # Who owes goes first: its answer pays at once, another node's only when the maximum reply delay is over.
            other = self._ask_sync_read([*nodes_overdue, *asked], now, clashes)
            if other is None and not any(_fit_checks(silent, proves_nothing)):  # there is nothing unlike to ask
                over = in_sync.over(answers)
                if now < over:
                    return WaitUntil(over)
                in_sync.forgive(answers)
        if other is None:
            return first
        self._gone_before += 1
        return other

    def _before_first_write(self, first: Send, now: float) -> Send | WaitUntil:
        """Return what goes before the first write on a line that came up: a read, which ends what a node holds of an
        earlier master's frame; then the time until which that node may reply. A write that is refused by such a node's
        NAK would be sent again, and be carried out twice."""
        in_sync, transaction = self._in_sync, first.transaction
        node = transaction.node

        def clashes(answers: Sequence[bytes], node: NodeRecord) -> bool:
            return in_sync.clashes(answers, now, node)

        other = self._another(first, now, clashes)
        if other is not None:
            return other
        if in_sync.lone_bytes_until < inf:
            return WaitUntil(in_sync.lone_bytes_until)
        alive, silent = self._whom_to_ask(now)
        own = [] if node.address == node.profile.broadcast else [node]
        # Without a read to send, the write goes: its refusal is then not believed.
        return self._ask_sync_read(dict.fromkeys([*own, *alive, *silent]), now, clashes) or first

    def _while_awaited(self, first: Send, now: float, answers: Sequence[bytes] | None = None) -> Send | None:
        """Return what goes while an overdue answer (that could look so) may still be on time, though the line went on:
        a check of the node that owes it, which shows that it is not to come; else another. After two, only checks,
        which are short where times are learned, and only for a maximum reply delay: with the wait that is left that is
        no longer than MOST_BEFORE exchanges can last. Then returns None."""
        if not self._gone_before:
            self._held_since = now
        two_gone = self._gone_before >= MOST_BEFORE - 1
        urgent, timings = first.transaction.priority is URGENT, first.transaction.node.timings
        if two_gone and (urgent or now >= self._held_since + timings.read.max_reply_delay):
            return None

        def clashes(answers: Sequence[bytes], node: NodeRecord) -> bool:
            return self._in_sync.clashes(answers, now, node)

        nodes_overdue = dict.fromkeys(self._in_sync.nodes_overdue(answers, now))
        other = self._of_these(nodes_overdue, now, clashes) or self._ask_sync_read(nodes_overdue, now, clashes)
        if other is None and not two_gone:
            other = self._another(first, now, clashes)
        if other is not None and not two_gone:
            self._gone_before += 1
        return other

    def _of_these(self, nodes: Container[NodeRecord], now: float, unfit: Unfit) -> Send | None:
        """Take out a read of one of these nodes that waits anyway, of whatever class: unlike a check, it is free."""
        opened: list[Exchange[Any]] = []

        def suits(other: Transaction) -> bool:
            node = other.node
            if other.writes or node not in nodes or not self._dispatcher.proves(other, now):
                return False
            if self._dispatcher.writes.queues.get(node):  # no read overtakes a write to its node
                return False
            exchange = _opened(other)
            # A last attempt must not go while something is awaited, not even in place of a check.
            if exchange is None or _is_decisive(Send(other, exchange)) or unfit(exchange.answers, node):
                return False
            opened.append(exchange)
            return True

        transaction = self._dispatcher.backlog.take(suits)
        return None if transaction is None else Send(transaction, opened[0])

    def _ask_itself(self, first: Send, now: float) -> Send | None:
        """Return a check of a node that owes what it is to be asked for: its answer would not be believed. Returns None
        for a node that is likely to be dead."""
        node = first.transaction.node
        # A death would cost the living an exchange. Where times are learned that is a short one.
        brief = node.learning is not None and not node.failures
        dead = node.unheard > MOST_UNHEARD if brief else node.silent
        # A node that does not reply would cost a whole maximum reply delay, and its silence proves nothing.
        if dead or self._gone_before >= MOST_BEFORE:
            return None
        self._gone_before += 1
        return self._ask_sync_read([node], now, lambda answers, node: self._in_sync.clashes(answers, now, node))

    def _other_probe(self, probe: Transaction, now: float) -> Send | None:
        """Have a probe ask the same dead node for something that is not overdue. Returns None where there is
        nothing."""
        node = probe.node
        # The probe itself changes its command: a second probe would not be paid for.
        for command in node.sync_reads():
            exchange = command.open(node.address, node.timings)
            if not self._in_sync.clashes(exchange.answers, now, node):
                probe.command = command
                return Send(probe, exchange)
        return None

    def _another(self, first: Send, now: float, unfit: Unfit, of: NodeRecord | None = None) -> Send | None:
        """Take out a read of the same class, `of` this node if one is given, or return None. It overtakes no write to
        its node. A write would prove less, for an ACK may be anybody's; and what spoils a read, which is repeated,
        would leave a write unconfirmed."""
        opened: list[Exchange[Any]] = []
        written = {first.transaction.node} if first.transaction.writes else set()
        in_sync = self._in_sync
        awaited = now < in_sync.awaited_until(self._last_byte)

        def suits(other: Transaction) -> bool:
            # R7: a read that overtakes a write to its node would return the value from before that write.
            if other.writes:
                written.add(other.node)
                return False
            if other.node in written or of not in (None, other.node) or not self._dispatcher.proves(other, now):
                return False
            exchange = _opened(other)
            if exchange is None or unfit(exchange.answers, other.node):
                return False
            if awaited and (_is_decisive(Send(other, exchange)) or in_sync.clashes(exchange.answers, now)):
                return False
            opened.append(exchange)
            return True

        transaction = self._dispatcher.backlog.pick(first.transaction.priority, suits)
        return None if transaction is None else Send(transaction, opened[0])

    def _ask_sync_read(self, nodes: Iterable[NodeRecord], now: float, unfit: Unfit) -> Send | None:
        """Return a read of the first of these nodes that has one whose answer is fit to prove something, or None."""
        for node, command, exchange in _fit_checks(nodes, unfit):
            check = self._dispatcher.check(node, command, now)
            if node.learning is not None:
                exchange = command.open(node.address, check.timings())
            return Send(check, exchange)
        return None

    def _whom_to_ask(self, now: float) -> tuple[list[NodeRecord], list[NodeRecord]]:
        """Return the nodes that answer, as far as is known, the last one to do so first; and those that are silent."""
        nodes = [
            node
            for node in self._dispatcher.nodes
            if node.address != node.profile.broadcast and node.suspended_until <= now
        ]
        # The node that replied last is the most likely to reply now.
        alive = [node for node in nodes if not node.silent]
        # Two stable sorts in place of one by a negated time: the instants of tests/verification/proof have none.
        alive.sort(key=lambda node: node.last_reply, reverse=True)
        alive.sort(key=lambda node: node.health is not UP)
        return alive, [node for node in nodes if node.silent]


def _fit_checks(nodes: Iterable[NodeRecord], unfit: Unfit) -> Iterator[tuple[NodeRecord, Command[Any], Exchange[Any]]]:
    """Yield the reads of these nodes whose answers are fit to prove something."""
    for node in nodes:
        for command in node.sync_reads():
            exchange = command.open(node.address, node.timings)
            if not unfit(exchange.answers, node):
                yield node, command, exchange


def _is_decisive(chosen: Send) -> bool:
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
