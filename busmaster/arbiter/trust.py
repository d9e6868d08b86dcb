"""Whether an answer is believed, and what an attempt that ends leaves owed (R15)."""

from __future__ import annotations

from typing import Any

from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.in_step import ANY_BYTE, Awaited, InStep
from busmaster.arbiter.learned import LATE_SHARE
from busmaster.arbiter.mark import Mark
from busmaster.arbiter.on_wire import OnWire
from busmaster.arbiter.unasked import QUIET, UnaskedBytes
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
    """Of one line. While things are said twice on it, a doubtful answer is held until another could have come."""

    __slots__ = ("_in_step", "held")

    def __init__(self, in_step: InStep) -> None:
        self._in_step = in_step
        self.held: Done[Any] | None = None
        """An answer that is delivered only if no other comes meanwhile."""

    def weigh(self, wire: OnWire, step: Done[Any], now: float) -> str | float | None:
        """Weigh an answer. Returns None if it is believed, else why not; or until when it is `held`."""
        transaction, exchange, leg = wire.transaction, wire.exchange, wire.leg
        assert transaction is not None
        assert exchange is not None
        in_step, answers = self._in_step, exchange.answers
        held, self.held = self.held is not None, None
        if any(step.rest.startswith(key) for key in answers):
            return TWO_ANSWERS
        if in_step.clashes(answers, now, transaction.node):
            # It pays nothing: it may be this request's, and what was owed before is still to come.
            return "its answer may be an earlier request's, whose own never came"
        to_be_held = in_step.is_to_be_held(answers, now)
        if not held and (to_be_held or in_step.is_doubtful(answers, now)):
            latest = leg.end + transaction.node.latest(leg.timing.window) + leg.latency
            if step.rest or leg.begun_at > latest:
                return "its answer may be another's, said late or twice"
            if to_be_held:  # its own reply may take as long as the document allows, not only as long as usual
                latest = max(latest, leg.past())
            if to_be_held or in_step.doubts(now):
                if step.send:  # at once: MSC says its packet again until that is acknowledged
                    wire.say(step.send, now)
                self.held = Done(step.value)
                return max(now, latest) + 2 * leg.byte_time
        if to_be_held:
            in_step.stood_alone(answers)
        in_step.answered(transaction.node, transaction.started, now, leg.timing.nominal)
        in_step.said(answers, now)
        return None

    def owe(self, wire: OnWire, *, heard: bool, whole: bool = False) -> None:
        """Note that an attempt ends: its reply may still come. What was `heard` was not it, and may have been a part of
        it; a `whole` one lacks nothing but what noise may have pushed out at its end."""
        exchange, transaction = wire.exchange, wire.transaction
        assert transaction is not None
        assert exchange is not None
        keys = () if whole else tuple(exchange.owed)
        leg, awaited = wire.leg, None
        over = leg.past()
        if leg.timing.silence is not None:  # it may meet with what is said then, and only a part of it be heard
            # its node goes on by itself with the legs that need no word from the host (MSC: the packet after its ACK)
            over += sum(later.timing.lateness for later in exchange.later if not later.sent)
            silence = max(QUIET, transaction.node.timings.read.byte_gap) + leg.latency + leg.byte_time
            awaited = Awaited(transaction.command, leg.timing.window, silence)
        # The ACK that began a packet's leg (MSC) may have been an overdue one: this request's own is then still to come
        ack_in_doubt = exchange.later and self._in_step.owes_lone_byte()
        if heard or (awaited is not None and keys) or ack_in_doubt:
            keys += (ANY_BYTE,)
        if exchange.answered:
            transaction.node.unheard += not heard
            self._in_step.owe(keys, transaction.node, leg.end, over, awaited)

    def hear(
        self, wire: OnWire, run: bytes, unasked: UnaskedBytes, now: float, ours: bool = False
    ) -> NodeRecord | None:
        """Take what came before this silence of the line. Returns who owed it, if that is known. It pays nothing where
        it may be `ours`, an echo that went astray: the end of a request can be a whole right reply of somebody's."""
        if ours:
            self._in_step.owe((ANY_BYTE,), None, now, now)
            return None
        owed = self._in_step.owed()
        paid = self._in_step.heard(run, now)
        node = None if paid is None else paid.node
        if paid is None or node is None or len(paid.key) < 2:
            return node  # a lone byte may be noise, and makes no node slower
        if node.learning is None or paid.awaited is None:
            unasked.blame_straggler([one for one, key in owed if key == paid.key])
        else:
            node.unheard = 0  # heard, if late: whatever else it owes, it is asked for itself
            first_byte = unasked.last_byte - (len(run) - 1) * wire.leg.byte_time - wire.leg.latency
            if first_byte - paid.asked > LATE_SHARE * paid.awaited.window:
                node.learning.was_late()
                unasked.blame_for(node, paid.asked, first_byte)
        return node
