"""Whether an answer is believed, and what an attempt that ends leaves overdue (R15)."""

from __future__ import annotations

from typing import Any

from busmaster.arbiter.counters import Mark
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.in_sync import ANY_BYTE, Awaited, InSync
from busmaster.arbiter.learned import LATE_SHARE
from busmaster.arbiter.on_wire import OnWire
from busmaster.arbiter.unexpected import QUIET, UnexpectedBytes
from busmaster.contract.exchange import Done

TWO_ANSWERS = "two answers came where one was due"
TOO_EARLY = "bytes came before the request was out"
COLLIDED = "the echo differs from what was sent: a collision, or an adapter without echo"


def damaged(mark: Mark) -> str:
    """Say that the port found a byte damaged."""
    return f"{mark.value} in the reply, says the port"


SPOILING = frozenset((TOO_EARLY, COLLIDED, *map(damaged, Mark)))
"""Reasons for which what comes is not read at all."""


class Trust:
    """Of one line. While things are said twice on it, an ambiguous answer is held until another could have come."""

    __slots__ = ("_in_sync", "held")

    def __init__(self, in_sync: InSync) -> None:
        self._in_sync = in_sync
        self.held: Done[Any] | None = None
        """An answer that is delivered only if no other comes meanwhile."""

    def weigh(self, wire: OnWire, progress: Done[Any], now: float) -> str | float | None:
        """Weigh an answer. Returns None if it is believed, else why not; or until when it is `held`."""
        transaction, exchange, step = wire.transaction, wire.exchange, wire.step
        assert transaction is not None
        assert exchange is not None
        in_sync, answers = self._in_sync, exchange.answers
        held, self.held = self.held is not None, None
        if any(progress.rest.startswith(key) for key in answers):
            return TWO_ANSWERS
        if in_sync.clashes(answers, now, transaction.node):
            # It pays nothing: it may be this request's, and what was overdue before is still to come.
            return "its answer may be an earlier request's, whose own never came"
        to_be_held = in_sync.is_to_be_held(answers, now)
        if not held and (to_be_held or in_sync.is_ambiguous(answers, now)):
            latest = step.end + transaction.node.latest(step.timing.window) + step.latency
            if progress.rest or step.begun_at > latest:
                return "its answer may be another's, said late or twice"
            if to_be_held:  # its own reply may take as long as the document allows, not only as long as usual
                latest = max(latest, step.past())
            if to_be_held or in_sync.has_ambiguity(now):
                if progress.send:  # at once: MSC says its packet again until that is acknowledged
                    wire.say(progress.send, now)
                self.held = Done(progress.value)
                return max(now, latest) + 2 * step.byte_time
        if to_be_held:
            in_sync.stood_alone(answers)
        in_sync.answered(transaction.node, transaction.started, now, step.timing.late_after)
        in_sync.said(answers, now)
        return None

    def add_overdue(self, wire: OnWire, *, heard: bool, whole: bool = False) -> None:
        """Note that an attempt ends: its reply may still come. What was `heard` was not it, and may have been a part of
        it; a `whole` one lacks nothing but what noise may have pushed out at its end."""
        exchange, transaction = wire.exchange, wire.transaction
        assert transaction is not None
        assert exchange is not None
        keys = () if whole else tuple(exchange.overdue)
        step, awaited = wire.step, None
        over = step.past()
        if step.timing.silence is not None:  # it may meet with what is said then, and only a part of it be heard
            # its node goes on by itself with the steps that need no word from the host (MSC: the packet after its ACK)
            over += sum(later.timing.max_reply_delay for later in exchange.later if not later.sent)
            silence = max(QUIET, transaction.node.timings.read.inter_byte_timeout) + step.latency + step.byte_time
            lasts = step.longest * step.byte_time + silence  # with one pause
            awaited = Awaited(transaction.command, step.timing.window, silence, lasts)
        # The ACK that began a packet's step (MSC) may have been an overdue one: this request's own is then still to
        # come
        ack_in_doubt = exchange.later and self._in_sync.lone_byte_is_overdue()
        if heard or (awaited is not None and keys) or ack_in_doubt:
            keys += (ANY_BYTE,)
        if exchange.answered:
            transaction.node.unheard += not heard
            self._in_sync.add_overdue(keys, transaction.node, step.end, over, awaited)

    def hear(
        self, wire: OnWire, run: bytes, unexpected: UnexpectedBytes, now: float, ours: bool = False
    ) -> NodeRecord | None:
        """Take what came before this silence of the line. Returns who overdue it, if that is known. It pays nothing
        where it may be `ours`, an echo that went astray: the end of a request can be a whole right reply of
        somebody's."""
        if ours:
            self._in_sync.add_overdue((ANY_BYTE,), None, now, now)
            return None
        overdue = self._in_sync.overdue()
        paid = self._in_sync.heard(run, now)
        node = None if paid is None else paid.node
        if paid is None or node is None or len(paid.key) < 2:
            return node  # a lone byte may be noise, and makes no node slower
        if node.learning is None or paid.awaited is None:
            unexpected.blame_overdue_reply([one for one, key in overdue if key == paid.key])
        else:
            node.unheard = 0  # heard, if late: whatever else it owes, it is asked for itself
            first_byte = unexpected.last_byte - (len(run) - 1) * wire.step.byte_time - wire.step.latency
            if first_byte - paid.asked > LATE_SHARE * paid.awaited.window:
                node.learning.was_late()
                unexpected.blame_for(node, paid.asked, first_byte)
        return node
