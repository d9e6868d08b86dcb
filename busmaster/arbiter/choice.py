"""Selects the next request if replies could be mistaken for one another (R15).

Usually no reply is overdue, and the first queued request is sent. Otherwise it is sent only if its reply cannot be
mistaken for an overdue one. If it can, another request of the same class goes first, or a *sync read*: a read whose
correct reply proves that the line is in sync. An urgent write is never held back; its ACK may then be ambiguous.

This module also limits runs of exchanges with similar replies, in which one reply too many would not show.

If all replies look alike, one duplicate shifts every later reply by one exchange. It is accepted as the reply to the
next request, whose own reply is accepted for the request after that, and so on. No reply is overdue and no unexpected
byte is received. A read with a different reply reveals the shift and costs one exchange. A pause reveals it too.

On a port whose bytes leave at the baud rate, reply times reveal it as well. In sync, a node begins to prepare its reply
after it has received the request. If replies are shifted by one exchange, the received reply belongs to the request
before. Its node could begin to prepare it when the previous reply was accepted, which is when the current request began
to leave. So a shifted reply arrives earlier, by the wire time of the request. Nodes with different delays show each
other's delays; over a run these cancel out.

So a reply is *untimely* if it differs from its node's usual reply time by more than half of that wire time. A run with
an untimely reply is checked as if there were no times. A reply that is too early may belong to the previous request. A
reply that is too late means that the usual time has changed, or that the process or a driver was stopped, which hides
how early the reply was. A run of timely replies is checked after a longer time: a device that waits for a silent line
before it prepares its reply is not earlier when shifted.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from math import inf
from typing import Any, TypeAlias, final

from busmaster.arbiter.dispatcher import Dispatcher
from busmaster.arbiter.health import UP, NodeRecord
from busmaster.arbiter.in_sync import MOST_UNHEARD, InSync
from busmaster.arbiter.on_wire import OnWire
from busmaster.arbiter.transaction import URGENT, Transaction
from busmaster.contract.exchange import Command, Exchange

LONGEST_ALIKE = 31
"""Similar replies after the first, some of them untimely, before a read with a different reply is sent: 32 in all."""
LONGEST_STEADY = 127
"""The same limit if all of them were timely."""
USUAL_SHARE = 1 / 8
"""Weight of the last reply in a node's usual reply time."""


class Alike:
    """Counts the exchanges with similar replies on one line. `node` received the last request."""

    __slots__ = ("_untimely", "_wire", "count", "node")

    def __init__(self, wire: OnWire) -> None:
        self._wire = wire
        self._untimely = False
        self.count = 0
        """Consecutive exchanges before the last one whose replies are like its reply."""
        self.node: NodeRecord | None = None

    def another(self, exchange: Exchange[Any], last_byte: float, now: float) -> bool:
        """Count one exchange, and return True if a read with a different reply must go first.

        `last_byte`: when the last byte of the last reply was received, in seconds.
        """
        step = self._wire.step
        # In a pause longer than its reply is awaited, a duplicate would have arrived as unexpected bytes.
        if now - last_byte - step.latency > exchange.timing.awaited:
            self.count = 0
            return False
        self.count += 1
        if not step.paced:  # on an unpaced port reply times show nothing
            return self.count >= LONGEST_ALIKE
        untimely = self._was_untimely(last_byte - step.end, len(exchange.request) * step.byte_time)
        if self.count == 1:  # the reply before it was different, so it belonged to its own request
            self._untimely = False
        elif untimely:
            self._untimely = True
        return self.count >= (LONGEST_ALIKE if self._untimely else LONGEST_STEADY)

    def _was_untimely(self, took: float, asking: float) -> bool:
        """Return True if the reply time does not prove that the last reply belongs to its own request.

        `took`: seconds from the end of that request. `asking`: its wire time in seconds.
        """
        node = self.node
        if node is None or took < 0:  # below 0: no reply was received
            return True
        usual = node.usual
        if usual is None:
            node.usual = took
            return True
        # Updated also by an untimely reply: if the node has become slower for good, the next replies are timely again.
        node.usual = usual + USUAL_SHARE * (took - usual)
        return abs(took - usual) > asking / 2


MOST_BEFORE = 3
"""Exchanges that may go before a request that is held back. Then it is sent, and its reply is ambiguous. The bounds of
R9 in planning include them."""


Send: TypeAlias = tuple[Transaction, Exchange[Any]]
"""Send this transaction now, as this exchange. A plain tuple: to create an object takes four times as long, and this is
done for every request."""


@final
class WaitUntil:
    """Send nothing before this `time`, in seconds: an overdue reply may still come."""

    __slots__ = ("time",)

    def __init__(self, time: float) -> None:
        self.time = time


@final
class Idle:
    """No request is queued."""


IDLE = Idle()
Action: TypeAlias = Send | WaitUntil | Idle
"""The next action of the line."""
Unfit: TypeAlias = Callable[[Sequence[bytes], NodeRecord], bool]
"""Returns True if a reply with these keys from that node proves nothing."""


class Choice:
    """Selects the next request of one line from the dispatcher's queues, depending on the overdue replies."""

    def __init__(self, dispatcher: Dispatcher, in_sync: InSync, wire: OnWire) -> None:
        self._dispatcher = dispatcher
        self._in_sync = in_sync
        self._alike = Alike(wire)
        self._gone_before = 0
        self._held_since = -inf
        """When the first request was sent before the one that is held back."""
        self._last_byte = -inf

    def next(self, now: float, last_byte: float) -> Action:
        """Return the next action. `last_byte`: when the last byte was received, in seconds."""
        dispatcher = self._dispatcher
        # A transaction that its protocol cannot encode must not stop the line: it fails, and the next one is tried.
        while (transaction := dispatcher.next(now)) is not None:
            node = transaction.node
            try:
                timings = node.timings if node.learning is None else transaction.timings()
                exchange = transaction.command.open(node.address, timings)
                answers = exchange.answers  # a protocol may not implement it: then only this transaction fails
            except Exception as bug:
                dispatcher.unsendable(transaction, bug, now)
            else:
                break
        else:
            return IDLE
        in_sync, alike = self._in_sync, self._alike
        last = in_sync.last
        # An exchange with several steps (MSC) reveals a shift by itself: an ACK does not look like a packet.
        if answers == last and not exchange.later:
            too_many = alike.another(exchange, last_byte, now)
            if too_many or in_sync.alert:
                return self._carefully((transaction, exchange), now, last_byte, too_many)
        elif in_sync.alert:
            return self._carefully((transaction, exchange), now, last_byte)
        else:
            alike.count = 0
        alike.node = node
        in_sync.last = answers
        in_sync.recent.append(answers)
        return (transaction, exchange)

    def _carefully(self, first: Send, now: float, last_byte: float, too_many: bool = False) -> Send | WaitUntil:
        """Select as `next` does, while a reply is overdue or ambiguous, or `too_many` replies were alike."""
        in_sync = self._in_sync
        self._last_byte = last_byte
        # First: an expired reply must not cause a sync read, and `alert` may be cleared by it.
        in_sync.lapse(now)
        chosen: Send | WaitUntil = first
        transaction, exchange = first
        answers = exchange.answers

        def alike(other: Sequence[bytes], node: NodeRecord) -> bool:
            return other == answers or in_sync.clashes(other, now, node)

        # R9: an urgent write waits for nothing. This applies to its first attempt only: a late reply to that one looks
        # like the reply to the retry, which needs proof like any other request.
        if transaction.priority is URGENT and transaction.writes and not transaction.attempts:
            pass
        elif transaction.writes and now < in_sync.lone_bytes_until and any(len(key) == 1 for key in answers):
            # A single byte may be the NAK of a node that an earlier master left in the middle of a frame (R15).
            chosen = self._before_first_write(first, now)
        elif _is_decisive(first) and now < in_sync.awaited_until(self._last_byte):
            chosen = self._while_awaited(first, now) or WaitUntil(in_sync.awaited_until(self._last_byte))
        elif transaction.probe and in_sync.clashes(answers, now, transaction.node):
            # The reply to the previous probe may still arrive and look like the reply to this one.
            chosen = self._other_probe(transaction, now) or self._instead_of(first, now)
        elif in_sync.clashes(answers, now):
            chosen = self._instead_of(first, now)
        elif in_sync.clashes(answers, now, transaction.node):
            # Only the node's own overdue reply could be confused with this one, so only its own reply proves anything.
            chosen = self._ask_itself(first, now) or first
        elif too_many:
            unlike = self._another(first, now, alike)
            chosen = unlike or self._ask_sync_read(self._whom_to_ask(now)[0], now, alike) or first
            self._alike.count = 0
        elif in_sync.has_ambiguity(now) and answers == in_sync.last:
            # After a duplicate: a request with a different reply goes first if one is queued, but no sync read is sent
            # for this. Equal requests behind one another would only make the replies ambiguous, not wrong.
            chosen = self._another(first, now, alike) or first
        if chosen is first:
            self._gone_before = 0
        if isinstance(chosen, WaitUntil):
            self._dispatcher.backlog.restore(transaction)
            return chosen
        if chosen[0] is not transaction:
            self._dispatcher.backlog.restore(transaction)
        transaction, exchange = chosen
        # A different reply reveals a shift, so the run of similar replies is over.
        if exchange.answers != in_sync.last:
            self._alike.count = 0
        self._alike.node = transaction.node
        in_sync.last = exchange.answers
        in_sync.recent.append(in_sync.last)
        return chosen

    def _instead_of(self, first: Send, now: float) -> Send | WaitUntil:
        """Return a substitute for a request whose reply could be mistaken for an overdue one, or until when to wait."""
        in_sync, (transaction, exchange) = self._in_sync, first
        answers = exchange.answers

        def clashes(answers: Sequence[bytes], node: NodeRecord) -> bool:
            return in_sync.clashes(answers, now, node)

        awaited = in_sync.awaited_until(self._last_byte, answers)
        if now < awaited:
            return self._while_awaited(first, now, answers) or WaitUntil(awaited)
        # R9 bounds the wait: after three others the request is sent anyway, and its reply is checked more strictly.
        if self._gone_before >= MOST_BEFORE:
            return first

        def proves_nothing(answers: Sequence[bytes], node: NodeRecord) -> bool:
            return in_sync.clashes(answers, now)

        nodes_overdue = dict.fromkeys(in_sync.nodes_overdue(answers, now))
        other = None
        if self._gone_before < MOST_BEFORE - 1:
            node = transaction.node
            # only a reply of the node itself proves that its reply is not overdue
            of = node if node in nodes_overdue else None
            # The last of the three places is reserved for a sync read: other requests may prove nothing.
            other = self._another(first, now, clashes, of)
        if other is None:
            ends = in_sync.ends(answers, now)
            if ends < inf:  # the overdue reply of its own node needs a sync read even then
                own = in_sync.clashes(answers, ends, transaction.node)
                return (self._ask_itself(first, now) if own else None) or WaitUntil(ends)
            asked, silent = self._whom_to_ask(now)
            worth_it = transaction.writes or not transaction.attempts
            # All nodes are silent: a sync read of its own node costs no more than the request would.
            if worth_it and not (nodes_overdue or asked):
                asked = [transaction.node]
            # Nodes with an overdue reply first: their reply clears it at once, another node's only after the maximum
            # reply delay.
            other = self._ask_sync_read([*nodes_overdue, *asked], now, clashes)
            # no node has a sync read with a different reply
            if other is None and not any(_fit_checks(silent, proves_nothing)):
                over = in_sync.over(answers)
                if now < over:
                    return WaitUntil(over)
                # No read can prove anything: every node has refused all others, or their replies are overdue too. Then
                # only time helps.
                in_sync.forgive(answers)
        if other is None:
            return first
        self._gone_before += 1
        return other

    def _before_first_write(self, first: Send, now: float) -> Send | WaitUntil:
        """Return the substitute for the first write on a new line: a read, then the time until which a NAK may arrive.

        The read ends the unfinished frame that a node may hold from an earlier master. Without it, a write that this
        node's NAK seems to refuse would be sent again, and be carried out twice.
        """
        in_sync, (transaction, _) = self._in_sync, first
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
        # If no read is available, the write is sent: its refusal is not trusted.
        return self._ask_sync_read(dict.fromkeys([*own, *alive, *silent]), now, clashes) or first

    def _while_awaited(self, first: Send, now: float, answers: Sequence[bytes] | None = None) -> Send | None:
        """Return the request to send while an overdue reply may still be on time, or None if none may be sent.

        First choice is a sync read of the node, which shows that its reply will not arrive; then another request. After
        two of them only sync reads follow, which are short if times are learned, for one maximum reply delay. Together
        with the remaining wait this is no longer than MOST_BEFORE exchanges.
        """
        if not self._gone_before:
            self._held_since = now
        two_gone = self._gone_before >= MOST_BEFORE - 1
        transaction, _ = first
        urgent, timings = transaction.priority is URGENT, transaction.node.timings
        if two_gone and (urgent or now >= self._held_since + timings.read.max_reply_delay):
            return None

        def clashes(answers: Sequence[bytes], node: NodeRecord) -> bool:
            return self._in_sync.clashes(answers, now, node)

        nodes_overdue = dict.fromkeys(self._in_sync.nodes_overdue(answers, now))
        # A reply of the node itself ends the wait at once, because a node answers in order.
        other = self._of_these(nodes_overdue, now, clashes) or self._ask_sync_read(nodes_overdue, now, clashes)
        if other is None and not two_gone:
            other = self._another(first, now, clashes)
        if other is not None and not two_gone:
            self._gone_before += 1
        return other

    def _of_these(self, nodes: Container[NodeRecord], now: float, unfit: Unfit) -> Send | None:
        """Take a queued read of one of these nodes, of any class. Unlike a sync read, it costs nothing extra."""
        opened: list[Exchange[Any]] = []

        def suits(other: Transaction) -> bool:
            node = other.node
            if other.writes or node not in nodes or not self._dispatcher.proves(other, now):
                return False
            if self._dispatcher.writes.queues.get(node):  # R7: no read overtakes a write to its node
                return False
            exchange = _opened(other)
            # A last attempt must not be sent while a reply is awaited, not even in place of a sync read.
            if exchange is None or _is_decisive((other, exchange)) or unfit(exchange.answers, node):
                return False
            opened.append(exchange)
            return True

        transaction = self._dispatcher.backlog.take(suits)
        return None if transaction is None else (transaction, opened[0])

    def _ask_itself(self, first: Send, now: float) -> Send | None:
        """Return a sync read of the node itself, whose reply to this request would be ambiguous. None if it is likely
        dead."""
        node = first[0].node
        # A request to a dead node delays the others. If times are learned, the delay is short.
        brief = node.learning is not None and not node.failures
        dead = node.unheard > MOST_UNHEARD if brief else node.silent
        # A dead node costs a whole maximum reply delay, and its silence proves nothing.
        if dead or self._gone_before >= MOST_BEFORE:
            return None
        self._gone_before += 1
        return self._ask_sync_read([node], now, lambda answers, node: self._in_sync.clashes(answers, now, node))

    def _other_probe(self, probe: Transaction, now: float) -> Send | None:
        """Change a probe's command to a read that is not overdue. Returns None if there is none."""
        node = probe.node
        # The probe is changed, not replaced: the budget has paid for one probe only.
        for command in node.sync_reads():
            exchange = command.open(node.address, node.timings)
            if not self._in_sync.clashes(exchange.answers, now, node):
                probe.command = command
                return (probe, exchange)
        return None

    def _another(self, first: Send, now: float, unfit: Unfit, of: NodeRecord | None = None) -> Send | None:
        """Take a read of the same class, of node `of` if given, or return None. It overtakes no write to its node.

        Writes are not used: an ACK may come from any node, and a failure would leave the write unconfirmed, while a
        read is repeated.
        """
        transaction, _ = first
        opened: list[Exchange[Any]] = []
        written = {transaction.node} if transaction.writes else set()
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
            # The overdue reply may collide with this exchange. A read that can be repeated loses nothing by that.
            if awaited and (_is_decisive((other, exchange)) or in_sync.clashes(exchange.answers, now)):
                return False
            opened.append(exchange)
            return True

        taken = self._dispatcher.backlog.pick(transaction.priority, suits)
        return None if taken is None else (taken, opened[0])

    def _ask_sync_read(self, nodes: Iterable[NodeRecord], now: float, unfit: Unfit) -> Send | None:
        """Return a sync read of the first of these nodes that has one whose reply proves something, or None."""
        for node, command, exchange in _fit_checks(nodes, unfit):
            check = self._dispatcher.check(node, command, now)
            if node.learning is not None:
                # With the learned window, unlike the exchange that was used to find it: a sync read can be repeated.
                exchange = command.open(node.address, check.timings())
            return (check, exchange)
        return None

    def _whom_to_ask(self, now: float) -> tuple[list[NodeRecord], list[NodeRecord]]:
        """Return the nodes that answer, the last to do so first, and the silent nodes."""
        nodes = [
            node
            for node in self._dispatcher.nodes
            # A suspended node may be switched off or in maintenance: nothing at all is sent to it.
            if node.address != node.profile.broadcast and node.suspended_until <= now
        ]
        # The node that replied last is the most likely to reply now.
        alive = [node for node in nodes if not node.silent]
        # Two stable sorts instead of one by a negated time: the symbolic instants of tests/verification/proof have no
        # negation.
        alive.sort(key=lambda node: node.last_reply, reverse=True)
        alive.sort(key=lambda node: node.health is not UP)
        return alive, [node for node in nodes if node.silent]


def _fit_checks(nodes: Iterable[NodeRecord], unfit: Unfit) -> Iterator[tuple[NodeRecord, Command[Any], Exchange[Any]]]:
    """Yield the sync reads of these nodes whose replies prove something."""
    for node in nodes:
        for command in node.sync_reads():
            exchange = command.open(node.address, node.timings)
            if not unfit(exchange.answers, node):
                yield node, command, exchange


def _is_decisive(chosen: Send) -> bool:
    """Return True for a write, or the last attempt of a read: an overdue reply must not spoil it."""
    transaction, exchange = chosen
    last = transaction.retried >= transaction.retries and not transaction.probe
    return transaction.writes or not exchange.answered or last


def _opened(transaction: Transaction) -> Exchange[Any] | None:
    """Return an exchange, or None if the protocol cannot encode it. The error is reported when its turn comes."""
    try:
        return transaction.command.open(transaction.node.address, transaction.timings())
    except Exception:
        return None
