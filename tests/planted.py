"""Bugs of a master, to be planted: both the proof and the campaigns have to find them."""

from __future__ import annotations

from typing import Any

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.on_wire import Step
from busmaster.arbiter.transaction import Transaction
from busmaster.arbiter.unexpected import QUIET


def without_max_reply_delay(patch: Any) -> None:
    """The line goes on as soon as a window is over, or an attempt has failed."""
    for name in ("past", "last_begin"):
        patch.setattr(Step, name, lambda step: step.end)


def without_the_byte_time(patch: Any) -> None:
    patch.setattr(Step, "_past", lambda step, end, timing: end + timing.max_reply_delay + step.latency)


def without_the_adapter_in_the_max_reply_delay(patch: Any) -> None:
    patch.setattr(Step, "_past", lambda step, end, timing: end + timing.max_reply_delay + step.byte_time)


def without_the_adapter_in_the_silence(patch: Any) -> None:
    patch.setattr(Step, "quiet", lambda step: max(QUIET, step.timing.inter_byte_timeout) + step.byte_time)


def with_a_cancellation_that_clears_the_exchange(patch: Any) -> None:
    right = Arbiter.cancel

    def cancel(arbiter: Arbiter, transaction: Transaction, now: float) -> None:
        right(arbiter, transaction, now)
        if arbiter._wire.transaction is transaction:
            arbiter._end_exchange()
            arbiter.dispatcher._end(transaction, now)
            arbiter._release(0.0, now)

    patch.setattr(Arbiter, "cancel", cancel)
