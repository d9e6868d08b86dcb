"""The errors with which transactions end: a fresh one each, which says which node, which command and how often."""

from __future__ import annotations

from busmaster.arbiter.clients import Hold
from busmaster.arbiter.transaction import Transaction
from busmaster.errors import BusError, HoldEnded, NoReply, NotStarted, WriteUnconfirmed

TOO_LATE = "allow more time, or see bus.statistics(), or busmaster plan, for what holds it up"

HELD = "flow control holds the port or the adapter is stuck; check CTS, replug"


def make_error(kind: type[BusError], what: str, transaction: Transaction, hint: str | None = None) -> BusError:
    """Return the error of this kind for a transaction, with the hint of the kind if none is given."""
    return name_error(kind(what, hint=hint), transaction)


def name_error(error: BusError, transaction: Transaction) -> BusError:
    """Say in an error which node, which command and how often, and return it."""
    error.name(transaction.node)
    error.command = str(transaction.command)
    error.attempts = transaction.attempts
    return error


def too_late(transaction: Transaction, now: float, *, held: bool = False) -> BusError:
    """Return the error of a transaction whose caller's time is over: whether it was sent is what the error says.

    `held`: the port has not sent all that it was handed, this request or the one before it, and may still do.
    """
    waited = (now - transaction.queued) * 1000
    if not transaction.attempts:
        what = f"not sent within its time: it waited {waited:.0f} ms for the line"
        return make_error(NotStarted, what, transaction, HELD if held else None)
    kind = WriteUnconfirmed if transaction.writes else NoReply
    what = "the port did not send it within its time" if held else "sent, but not answered within its time"
    error = make_error(kind, f"{what}: {waited:.0f} ms", transaction)
    if kind is NoReply:
        error.hint = HELD if held else TOO_LATE
    return error


def hold_ended(transaction: Transaction, hold: Hold) -> BusError:
    """Return the error of what a sequence still waits for when the line is no longer held for it."""
    over = f"the {hold.longest:g} s for which the line was held for it are over"
    if transaction.attempts:
        return make_error(NoReply, f"not answered, and {over}", transaction)
    return make_error(HoldEnded, over, transaction)
