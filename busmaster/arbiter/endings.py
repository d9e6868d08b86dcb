"""The errors with which transactions end: a fresh one each, which says which node, which command and how often."""

from __future__ import annotations

from busmaster.arbiter.transaction import Transaction
from busmaster.errors import BusError, NotStarted


def make_error(kind: type[BusError], what: str, transaction: Transaction) -> BusError:
    """Return the error of this kind for a transaction."""
    return name_error(kind(what), transaction)


def name_error(error: BusError, transaction: Transaction) -> BusError:
    """Say which node, which command and how often."""
    error.node = transaction.node.label
    error.command = str(transaction.command)
    error.attempts = transaction.attempts
    return error


def not_started(transaction: Transaction, now: float) -> BusError:
    """Return the error of a transaction whose time to start is over (R12)."""
    waited = (now - transaction.queued) * 1000
    return make_error(NotStarted, f"not sent within its time: it waited {waited:.0f} ms for the line", transaction)
