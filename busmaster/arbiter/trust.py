"""Decides whether a reply is delivered, and which replies are overdue after an attempt (R15)."""

from __future__ import annotations

from typing import Any

from busmaster.arbiter.counters import Mark
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.in_sync import ANY_BYTE, Awaited, InSync
from busmaster.arbiter.learned import LATE_SHARE
from busmaster.arbiter.on_wire import OnWire
from busmaster.arbiter.unexpected import UnexpectedBytes
from busmaster.contract.exchange import Done

TWO_ANSWERS = "two replies received, one expected"
TOO_EARLY = "bytes received before the request was sent completely"
COLLIDED = "the echo differs from the bytes sent: a collision, or an adapter without echo"


def damaged(mark: Mark) -> str:
    """Return the error text for a byte that the port reported as damaged."""
    return f"{mark.value} in the reply, reported by the port"


SPOILING = frozenset((TOO_EARLY, COLLIDED, *map(damaged, Mark)))
"""Errors for which the received bytes are not parsed."""


class Trust:
    """Checks the replies of one line. After a duplicate reply, an ambiguous reply is held until another could have
    arrived."""

    __slots__ = ("_in_sync", "held")

    def __init__(self, in_sync: InSync) -> None:
        self._in_sync = in_sync
        self.held: Done[Any] | None = None
        """A reply that is delivered only if no second one arrives."""

    def weigh(self, wire: OnWire, progress: Done[Any], now: float) -> str | float | None:
        """Check a reply. Returns None to deliver it, the reason not to, or the time until which it is `held`."""
        transaction, exchange, step = wire.transaction, wire.exchange, wire.step
        assert transaction is not None
        assert exchange is not None
        in_sync, answers = self._in_sync, exchange.answers
        # Called again when the time of a held reply is over: it is then delivered, unless another check fails by now.
        held, self.held = self.held is not None, None
        # Bytes behind a reply that begin like a reply: a duplicate, or an overdue reply in front of the right one.
        if any(progress.rest.startswith(key) for key in answers):
            return TWO_ANSWERS
        if in_sync.clashes(answers, now, transaction.node):
            # It clears nothing: it may be this request's reply, and the overdue one may still arrive.
            return "ambiguous reply: it may belong to an earlier request, whose reply is overdue"
        to_be_held = in_sync.is_to_be_held(answers, now)
        if not held and (to_be_held or in_sync.is_ambiguous(answers, now)):
            latest = step.end + transaction.node.latest(step.timing.window) + step.latency
            # Later than this node ever is, so it is more likely the reply of another node.
            if progress.rest or step.begun_at > latest:
                return "ambiguous reply: it may be a late or duplicate reply to another request"
            if to_be_held:  # its own reply may take as long as documented, not only as long as usual
                latest = max(latest, step.past())
            if to_be_held or in_sync.has_ambiguity(now):
                if progress.send:  # at once: MSC repeats its packet until it is acknowledged
                    wire.send(progress.send, now)
                self.held = Done(progress.value)
                # Two byte times: the first byte of a second reply must be received, not only begun.
                return max(now, latest) + 2 * step.byte_time
        if to_be_held:
            in_sync.stood_alone(answers)
        # `started` is earlier than the end of the request: the safe side, because only a request sent after the maximum
        # reply delay of an overdue reply proves something about it.
        in_sync.answered(transaction.node, transaction.started, now, step.timing.late_after)
        in_sync.note_answered(answers, now)
        return None

    def add_overdue(self, wire: OnWire, *, heard: bool, whole: bool = False) -> None:
        """Record that the reply to a finished attempt may still arrive.

        `heard`: bytes were received that may be part of it. `whole`: the reply was complete except for damage at its
        end.
        """
        exchange, transaction = wire.exchange, wire.transaction
        assert transaction is not None
        assert exchange is not None
        keys = () if whole else tuple(exchange.overdue)
        step, awaited = wire.step, None
        over = step.past()
        # The reply may collide with the next request, so that only part of it is received.
        if step.timing.silence is not None:
            # The node continues with steps that need no transmission by the host (MSC: the packet after its ACK).
            over += sum(later.timing.max_reply_delay for later in exchange.later if not later.sent)
            silence = step.quiet()
            # with one pause
            awaited = Awaited(transaction.command, step.timing.window, silence, step.wire_time() + silence)
        # The ACK before the packet (MSC) may have been an overdue one. This request's own ACK is then still to come,
        # and would confirm the next write (docs/proof.md, 21).
        ack_in_doubt = exchange.later and self._in_sync.lone_byte_is_overdue()
        if heard or (awaited is not None and keys) or ack_in_doubt:
            keys += (ANY_BYTE,)
        if exchange.answered:
            # Bytes from a node, even damaged ones, show that it is alive and worth a sync read.
            transaction.node.unheard += not heard
            self._in_sync.add_overdue(keys, transaction.node, step.end, over, awaited)

    def hear(self, wire: OnWire, run: bytes, unexpected: UnexpectedBytes, now: float, ours: bool) -> NodeRecord | None:
        """Process the bytes received before a silence. Returns the node whose overdue reply they contain, if known.

        If they may be `ours`, an incomplete echo, they clear nothing: the end of a request can look like a whole
        correct reply of another node.
        """
        if ours:
            self._in_sync.add_overdue((ANY_BYTE,), None, now, now)
            return None
        overdue = self._in_sync.overdue()
        paid = self._in_sync.heard(run, now)
        node = None if paid is None else paid.node
        if paid is None or node is None or len(paid.key) < 2:
            return node  # a single byte may be noise, so it raises no maximum reply delay
        if node.learning is None or paid.awaited is None:
            # All nodes with this key: it is not known which of them has sent it. The delay is raised only if the last
            # unanswered request was to one of them.
            unexpected.blame_overdue_reply([one for one, key in overdue if key == paid.key])
        else:
            node.unheard = 0  # the node is alive: a sync read can clear its other overdue replies
            first_byte = unexpected.last_byte - (len(run) - 1) * wire.step.byte_time - wire.step.latency
            if first_byte - paid.asked > LATE_SHARE * paid.awaited.window:
                node.learning.was_late()
                unexpected.blame_for(node, paid.asked, first_byte)
        return node
