"""One class of the backlog on a line that several programs share: they take turns, by the line time that each has had.

Whose requests have had the least of the line (weighed by its share) goes next: start-time fair queueing. Who comes
begins with what the others have had, so that nobody saves up for a burst; who has just had a long exchange waits until
the others that wait have had as much, but nobody is passed over more than twice by each of them (R9).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from itertools import chain
from operator import attrgetter
from typing import TypeAlias

from busmaster.arbiter.clients import OWN, LineClient, turn_of
from busmaster.arbiter.queues import LOOKED_AT, Queue
from busmaster.arbiter.transaction import Transaction

PASSED_BY_EACH = 2
"""How often each of the others may go before a client that waits, whose share is 1."""


class _Turn:
    """What one client has waiting in a class. `had`: seconds of the line, weighed; `passed`: how often others went
    before it since it waits; `run`: how often it went since a lower class did."""

    __slots__ = ("client", "had", "passed", "queue", "run")

    def __init__(self, client: LineClient, queue: Queue) -> None:
        self.client = client
        self.queue = queue
        self.had = 0.0
        self.passed = 0
        self.run = 0


_had: Callable[[_Turn], float] = attrgetter("had")
_Order: TypeAlias = "OrderedDict[LineClient, _Turn]"


class Turns:
    """A class whose clients take turns; `new_queue` makes the queue of each, and `own` is that of the line's owner.

    `owner_first`: the owner takes no turns but goes first, so that no number of programs delays its safe state.
    """

    __slots__ = ("_had", "_new_queue", "_next", "_own", "_owner_first", "_turns", "live")

    def __init__(self, own: Queue, new_queue: Callable[[], Queue], *, owner_first: bool = False) -> None:
        self._owner_first = owner_first
        self._own = own
        self._new_queue = new_queue
        self._turns: _Order = OrderedDict()
        """In the order in which they had their last turns."""
        self._turns[OWN] = _Turn(OWN, own)
        self._next: _Turn | None = None
        """Whose turn it is in any case, for it was given back."""
        self._had = 0.0
        """What a client has had that comes now."""
        self.live = own.live

    def push(self, transaction: Transaction) -> None:
        """Add a transaction at its place in its client's queue."""
        self._joined(transaction).queue.push(transaction)
        self.live += 1

    def push_front(self, transaction: Transaction) -> None:
        """Add a transaction before all others of its client."""
        self._joined(transaction).queue.push_front(transaction)
        self.live += 1

    def give_back(self, transaction: Transaction) -> None:
        """Put back what was popped last: it is the next to be popped."""
        self.push_front(transaction)
        self._next = self._of(turn_of(transaction.client))

    def pop(self) -> Transaction:
        """Take out the first of the client whose turn it is. Raises IndexError if nobody waits."""
        turn = self._chosen()
        self.live -= 1
        turn.passed = 0
        self._turns.move_to_end(turn.client)
        return turn.queue.pop()

    def pop_of(self, client: LineClient) -> Transaction | None:
        """Take out the first of one client's, whose turn it is in any case, or return None."""
        turn = self._turns.get(client)
        if turn is None or not turn.queue.live:
            return None
        self.live -= 1
        return turn.queue.pop()

    def pop_entitled(self, now: float, *, urgent: bool = False) -> Transaction | None:
        """Take out the first of a client that has not used up its part of the line, or return None."""
        entitled = [turn for turn in self._waiting() if turn.client.is_entitled(now, urgent)]
        if not entitled:
            return None
        turn = min(entitled, key=_had)
        self.live -= 1
        turn.passed = 0
        self._turns.move_to_end(turn.client)
        return turn.queue.pop()

    def put_back(self, transaction: Transaction) -> None:
        """Put back what was popped last, at the front of its client's queue; another client may go first."""
        self._of(turn_of(transaction.client)).queue.push_front(transaction)
        self.live += 1

    def pick(self, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Take out the first of the first few that suits, or return None; of the client whose turn it is, if it can."""
        for turn in sorted(self._waiting(), key=_had)[:LOOKED_AT]:
            found = turn.queue.pick(suits)
            if found is not None:
                self.live -= 1
                return found
        return None

    def pick_of(self, client: LineClient, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Take out the first of the first few of one client's that suits, or return None."""
        turn = self._turns.get(client)
        found = None if turn is None else turn.queue.pick(suits)
        self.live -= found is not None
        return found

    def discard(self, transaction: Transaction) -> None:
        """Give up the place of a transaction that waits no longer; it is swept out later."""
        self.live -= 1
        self._of(turn_of(transaction.client)).queue.discard(transaction)

    def remove(self, transaction: Transaction) -> None:
        """Take out this transaction at once, wherever in its client's queue it is."""
        self._of(turn_of(transaction.client)).queue.remove(transaction)
        self.live -= 1

    def entries(self) -> Iterator[Transaction]:
        """Return all that is in the queues, ended ones too, in no order."""
        return chain.from_iterable(turn.queue.entries() for turn in self._turns.values())

    def __iter__(self) -> Iterator[Transaction]:
        return chain.from_iterable(turn.queue for turn in self._turns.values())

    # whose turn it is

    def waiting_of(self, client: LineClient) -> int:
        """Return how many transactions of a client wait."""
        turn = self._turns.get(client)
        return 0 if turn is None else turn.queue.live

    def charge(self, client: LineClient, seconds: float) -> None:
        """Note that a client has had the line for so long."""
        turn = self._turns.get(client)
        if turn is not None:
            turn.had += seconds / client.share

    def forget(self, client: LineClient) -> None:
        """Keep nothing of a client that waits for nothing and will not come again."""
        turn = self._turns.pop(client, None)
        if turn is self._next:
            self._next = None

    def count_run(self, client: LineClient, turns: int = 1) -> None:
        """Count that a client had so many turns while lower classes waited."""
        turn = self._turns.get(client)
        if turn is not None:
            turn.run += turns

    def begin_runs(self) -> None:
        """Note that a lower class had a turn."""
        for turn in self._turns.values():
            turn.run = 0

    def shortest_run(self) -> int:
        """Return how many turns each of those who wait has had at least since a lower class had one."""
        return min((turn.run for turn in self._waiting()), default=0)

    def _of(self, client: LineClient) -> _Turn:
        turn = self._turns.get(client)
        if turn is None:
            turn = self._turns[client] = _Turn(client, self._new_queue())
        return turn

    def _waiting(self) -> list[_Turn]:
        return [turn for turn in self._turns.values() if turn.queue.live]

    def _joined(self, transaction: Transaction) -> _Turn:
        """Return the turn of a transaction's client, which waits from now on."""
        if not self.live:  # nobody has waited for anybody: all are even
            self._had = 0.0
            for other in self._turns.values():
                other.had = 0.0
        turn = self._of(turn_of(transaction.client))
        if not turn.queue.live:
            turn.passed = 0
            if turn.had < self._had:
                turn.had = self._had
        return turn

    def _chosen(self) -> _Turn:
        if self._owner_first and self._own.live:
            return self._turns[OWN]
        given_back, self._next = self._next, None
        if given_back is not None and given_back.queue.live:
            return given_back
        waiting = self._waiting()
        first = min(waiting, key=_had)
        self._had = first.had
        if len(waiting) > 1:
            most = PASSED_BY_EACH * (len(waiting) - 1)
            first = next((turn for turn in waiting if turn.passed * turn.client.share >= most), first)
            for turn in waiting:
                turn.passed += 1
        return first
