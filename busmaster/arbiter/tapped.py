"""A dispatcher that tells whoever taps the line of each attempt: other lines pay nothing for it."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from typing import Any, cast

from busmaster.arbiter.dispatcher import Dispatcher
from busmaster.arbiter.state import LineState
from busmaster.arbiter.tap import Attempt, Verdict
from busmaster.arbiter.transaction import Transaction
from busmaster.arbiter.trust import SPOILING
from busmaster.contract.exchange import FrameError
from busmaster.errors import BusError, Refused


class TappedDispatcher(Dispatcher):
    """A dispatcher whose `attempt` is what is on the wire, and whose events tell the end of each one."""

    _order_of_transactions: Iterator[int]
    _numbers: dict[Transaction, int]

    def begin(self) -> None:
        """Tell of each attempt that begins from now on; of one that is on the wire already, nothing is told."""
        self._order_of_transactions = count(1)
        self._numbers = {}

    def started(self, transaction: Transaction, now: float) -> None:
        """Begin the attempt that goes out now, with the number of its transaction."""
        super().started(transaction, now)
        if transaction.attempts == 1 or transaction not in self._numbers:
            self._numbers[transaction] = next(self._order_of_transactions)
        node = transaction.node
        self.attempt = Attempt(
            node.profile.name,
            node.address,
            transaction.command,
            node.timings,
            transaction=self._numbers[transaction],
            number=transaction.attempts,
            purpose=_purpose(transaction),
            settled=self.counters.spent[LineState.SETTLING],
        )

    def succeeded(self, transaction: Transaction, value: Any, now: float) -> None:
        """Tell that the attempt brought a value."""
        self._over(transaction, Verdict.OK, value, now)
        super().succeeded(transaction, value, now)

    def attempt_failed(
        self, transaction: Transaction, no_reply: bool, failure: FrameError, now: float, doubted: bool = False
    ) -> None:
        """Tell that the attempt failed, and how."""
        what = failure.what
        verdict = Verdict.NO_REPLY if no_reply else Verdict.SPOILT if what in SPOILING else Verdict.GARBLED
        self._over(transaction, Verdict.DOUBTED if doubted else verdict, what, now)
        super().attempt_failed(transaction, no_reply, failure, now, doubted)

    def broken(self, transaction: Transaction, bug: Exception, now: float) -> None:
        """Tell that the protocol's reader failed on what came."""
        self._over(transaction, Verdict.GARBLED, f"a bug in the protocol's reader: {bug!r}", now)
        super().broken(transaction, bug, now)

    def refused(self, transaction: Transaction, refusal: Refused, certain: bool, now: float) -> None:
        """Tell that the node refused."""
        self._over(transaction, Verdict.REFUSED, refusal.what, now)
        super().refused(transaction, refusal, certain, now)

    def cut_off(self, transaction: Transaction, error: BusError, now: float) -> None:
        """Tell that the line was lost under the attempt."""
        self._over(transaction, Verdict.CUT_OFF, error.what, now)
        super().cut_off(transaction, error, now)

    def _over(self, transaction: Transaction, verdict: Verdict, result: Any, now: float) -> None:
        attempt, self.attempt = self.attempt, None
        if attempt is None:  # it was on the wire before anybody listened
            return
        attempt.late = transaction.late
        attempt.heard = transaction.wanted or transaction.check
        attempt.end(verdict, result, now)
        self.events.append(attempt)

    def _end(self, transaction: Transaction, now: float, error: BusError | None = None) -> None:
        self._numbers.pop(transaction, None)
        super()._end(transaction, now, error)


def set_tapped(dispatcher: Dispatcher, tapped: bool) -> None:
    """Have the dispatcher of a line tell of each attempt from now on, or no more.

    It becomes one of the other kind as it stands, so that a line that nobody listens to pays nothing for it.
    """
    dispatcher.attempt = None
    if tapped:
        dispatcher.__class__ = TappedDispatcher
        cast("TappedDispatcher", dispatcher).begin()
    else:
        dispatcher.__class__ = Dispatcher


def _purpose(transaction: Transaction) -> str:
    if transaction.check:
        return "check"
    if transaction.probe:
        return "probe"
    return "" if transaction.poll is None else f"poll {transaction.poll.name}".rstrip()
