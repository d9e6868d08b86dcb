"""Several programs on a line under attack: each takes turns, one of them asks far more than the others do, and now and
then one holds the line for a sequence that writes and reads back."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from random import Random
from typing import Any

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.choice import MOST_BEFORE
from busmaster.arbiter.clients import Hold, LineClient, turn_of
from busmaster.arbiter.shared_backlog import PASSED_BY_EACH
from busmaster.arbiter.transaction import Priority, Transaction
from tests.verification.campaigns.ledger import ROUNDING

PROGRAMS = 3
FLOOD = 30
"""Requests that one of them has waiting at any time."""
LONGEST_HOLDS = (0.02, 0.1, 0.5)
PASSED = PASSED_BY_EACH * PROGRAMS * (1 + MOST_BEFORE) + MOST_BEFORE
"""How often others may go before a program that waits: what proves that the line is in sync is not counted, what goes
in its place because it proves as much (R15) is."""


class Sharing:
    """Who shares a line; and the judge of turns and of sequences (R9). `problem` is told what is broken."""

    def __init__(self, name: str, arbiter: Arbiter, problem: Callable[[str], None]) -> None:
        self.random = Random(f"{name} shared")
        self.clients: list[LineClient | None] = [None, *(arbiter.add_client() for _ in range(PROGRAMS))]
        self.flood = self.random.randrange(len(self.clients))
        self.sequences = 0
        self.interrupted = 0
        """Urgent requests that came between."""
        self._problem = problem
        self._arbiter = arbiter
        self._passed: dict[LineClient, int] = {}
        self._hold: Hold | None = None
        self._until = -inf
        right = arbiter.dispatcher.started

        def started(transaction: Transaction, now: float) -> None:
            self._judge(transaction, now)
            right(transaction, now)

        arbiter.dispatcher.started = started  # type: ignore[method-assign]  # whoever goes is seen here

    def client_of(self, asker: int) -> LineClient | None:
        """Whose request it is, of a client of the campaign; what nobody in particular asks is the owner's."""
        return self.clients[asker % len(self.clients)] if asker >= 0 else None

    def hold(self, node: Any) -> Hold:
        """A sequence of any of the programs."""
        self.sequences += 1
        return self._arbiter.exclusive(node, self.random.choice(self.clients), self.random.choice(LONGEST_HOLDS))

    def released(self, hold: Hold) -> None:
        """It is let go, or over."""
        if hold is self._hold:
            self._hold, self._until = None, -inf

    def _judge(self, transaction: Transaction, now: float) -> None:
        if transaction.check:
            return
        client = transaction.client
        if self._hold is not None and client is not self._hold and now < self._until - ROUNDING:
            if transaction.priority is not Priority.URGENT:
                self._problem(f"R9: {transaction.command} comes between the requests of a sequence")
            self.interrupted += 1
        if isinstance(client, Hold):
            if client.over or (client is self._hold and now > self._until + ROUNDING):
                self._problem(f"R9: {transaction.command} is of a sequence that is over")
            if client is self._hold:
                return
            self._hold, self._until = client, now + client.longest
        self._count_turn(transaction)

    def _count_turn(self, transaction: Transaction) -> None:
        """Nobody who waits in COMMAND is passed over too often."""
        if transaction.priority is not Priority.COMMAND:
            return
        backlog = self._arbiter.dispatcher.backlog
        whose = turn_of(transaction.client)
        whose = whose.client if isinstance(whose, Hold) else whose
        for client in map(turn_of, self.clients):
            waits = client is not whose and backlog.waiting_of(Priority.COMMAND, client)
            self._passed[client] = self._passed.get(client, 0) + 1 if waits else 0
            if self._passed[client] > PASSED:
                self._problem(f"R9: {self._passed[client]} went before a command of another program")
