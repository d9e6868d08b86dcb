"""Bugs of a master, to be planted: both the proof and the campaigns have to find them."""

from __future__ import annotations

from typing import Any

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.leg import Leg
from busmaster.arbiter.transaction import Transaction
from busmaster.arbiter.unasked import QUIET


def without_lateness(patch: Any) -> None:
    """The line goes on as soon as a window is over, or an attempt has failed."""
    for name in ("past", "last_begin"):
        patch.setattr(Leg, name, lambda leg: leg.end)


def without_the_byte_time(patch: Any) -> None:
    patch.setattr(Leg, "_past", lambda leg, end, timing: end + timing.lateness + leg.latency)


def without_the_adapter_in_the_lateness(patch: Any) -> None:
    patch.setattr(Leg, "_past", lambda leg, end, timing: end + timing.lateness + leg.byte_time)


def without_the_adapter_in_the_silence(patch: Any) -> None:
    patch.setattr(Leg, "quiet", lambda leg: max(QUIET, leg.timing.byte_gap) + leg.byte_time)


def with_a_cancellation_that_clears_the_exchange(patch: Any) -> None:
    right = Arbiter.cancel

    def cancel(arbiter: Arbiter, transaction: Transaction, now: float) -> None:
        right(arbiter, transaction, now)
        if arbiter._wire.transaction is transaction:
            arbiter._end_exchange()
            arbiter.dispatcher._end(transaction, now)
            arbiter._release(0.0, now)

    patch.setattr(Arbiter, "cancel", cancel)
