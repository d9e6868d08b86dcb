"""The queues of a line that several programs share, and that can be held for a sequence of requests (R9).

In each class the clients take turns by the line time that each has used: start-time fair queueing. The client that has
used the least, weighted by its share, goes next. A new client starts with the value of the others, so that no client
saves up for a burst. A client that has just had a long exchange waits until the others that wait have had as much, but
each of them passes it at most twice (R9).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from itertools import chain
from math import inf
from operator import attrgetter
from typing import NamedTuple, TypeAlias

from busmaster.arbiter.backlog import LOOKED_AT, SHARE, Backlog, EarliestDeadlineFirst, Fifo, Queue, Writes, new_queues
from busmaster.arbiter.clients import OWN, Account, Hold, LineClient, turn_of
from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.transaction import COMMAND, FAILING, QUEUED, URGENT, Priority, Transaction

PASSED_BY_EACH = 2
"""How often each other client may go before a waiting client whose share is 1."""


class _Turn:
    """The queue and the use of one client in a class.

    `had`: line time in seconds, weighted. `passed`: requests of others sent since it has been waiting. `run`: its
    requests sent since the last one of a lower class.
    """

    __slots__ = ("client", "had", "passed", "queue", "run")

    def __init__(self, client: LineClient, queue: Queue) -> None:
        self.client = client
        self.queue = queue
        self.had = 0.0
        self.passed = 0
        self.run = 0


_had: Callable[[_Turn], float] = attrgetter("had")
_Order: TypeAlias = "OrderedDict[LineClient, _Turn]"


class SequenceRule(NamedTuple):
    """Which sequences may begin. `held`: a sequence holds the line. `role`: its next sequence waits for the owner's
    time."""

    held: bool
    role: Account | None

    def may_begin(self, hold: Hold) -> bool:
        """Return True if the line can be held for a sequence that does not hold it yet."""
        return not self.held and hold.client.role is not self.role


class Turns:
    """A class whose clients take turns. `new_queue` makes a client's queue; `own` is the queue of the line's owner.

    `owner_first`: the owner always goes first, so that other programs do not delay its safe state.
    """

    __slots__ = ("_had", "_new_queue", "_next", "_own", "_owner_first", "_turns", "aside", "live", "rule")

    def __init__(self, own: Queue, new_queue: Callable[[], Queue], *, owner_first: bool = False) -> None:
        self._owner_first = owner_first
        self._own = own
        self._new_queue = new_queue
        self._turns: _Order = OrderedDict()
        """In the order of their last turns."""
        self._turns[OWN] = _Turn(OWN, own)
        self._next: _Turn | None = None
        """Client that goes next regardless of usage, because its last request was put back."""
        self._had = 0.0
        """Initial use of a new client."""
        self.live = own.live
        self.rule: SequenceRule | None = None
        """Which sequences may not begin; None: every sequence may. Set with `admit_sequences`."""
        self.aside: list[Transaction] = []
        """Requests of sequences that may not begin. They are kept outside the queues, so that no request waits behind
        them."""

    def push(self, transaction: Transaction) -> None:
        """Add a transaction to its client's queue."""
        if self.rule is not None and self._stays_aside(transaction):
            self.aside.append(transaction)
            return
        self._joined(transaction).queue.push(transaction)
        self.live += 1

    def push_front(self, transaction: Transaction) -> None:
        """Add a transaction at the front of its client's queue."""
        if self.rule is not None and self._stays_aside(transaction):
            self.aside.insert(0, transaction)
            return
        self._joined(transaction).queue.push_front(transaction)
        self.live += 1

    def give_back(self, transaction: Transaction) -> None:
        """Put back the transaction that was popped last. It is popped next."""
        self.push_front(transaction)
        # R15 held it back only for another request to prove something. Without this, its client would lose its turn
        # each time.
        self._next = self._of(turn_of(transaction.client))

    def keep_turn(self, client: LineClient) -> None:
        """Give this client the next turn if it has requests, because the one popped last was not sent."""
        turn = self._turns.get(client)
        if turn is not None and turn.queue.live:
            self._next = turn

    def pop(self) -> Transaction:
        """Remove and return the first transaction of the client whose turn it is. Raises IndexError if there is
        none."""
        turn = self._chosen()
        self.live -= 1
        # Moved to the end, so that clients with equal use take turns in the order of their last turns.
        turn.passed = 0
        self._turns.move_to_end(turn.client)
        return turn.queue.pop()

    def pop_of(self, client: LineClient) -> Transaction | None:
        """Remove and return the first transaction of this client regardless of turns, or None."""
        turn = self._turns.get(client)
        if turn is None or not turn.queue.live:
            return None
        self.live -= 1
        return turn.queue.pop()

    def pop_entitled(self, now: float, *, urgent: bool = False) -> Transaction | None:
        """Remove and return the first transaction of a client that has not used its part of the line, or None."""
        # The owner is always entitled: its `owner_time` is 0.
        entitled = [turn for turn in self._waiting() if turn.client.is_entitled(now, urgent)]
        if not entitled:
            return None
        turn = min(entitled, key=_had)
        self.live -= 1
        turn.passed = 0
        self._turns.move_to_end(turn.client)
        return turn.queue.pop()

    def put_back(self, transaction: Transaction) -> None:
        """Put the transaction popped last back at the front of its client's queue. Another client may go first."""
        self._put_back(transaction)

    def pick(self, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Remove and return the first suitable one among the first requests, or None. Prefers the client whose turn it
        is."""
        # The first clients and the first requests of each: the search is bounded, however full a queue is.
        for turn in sorted(self._waiting(), key=_had)[:LOOKED_AT]:
            found = turn.queue.pick(suits)
            if found is not None:
                self.live -= 1
                return found
        return None

    def pick_of(self, client: LineClient, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Remove and return the first suitable one among this client's first requests, or None."""
        turn = self._turns.get(client)
        found = None if turn is None else turn.queue.pick(suits)
        self.live -= found is not None
        return found

    def discard(self, transaction: Transaction) -> None:
        """Release the place of a transaction that has left the queue. The entry is removed later."""
        if self._leave_aside(transaction):
            return
        self.live -= 1
        self._of(turn_of(transaction.client)).queue.discard(transaction)

    def remove(self, transaction: Transaction) -> None:
        """Remove this transaction immediately, wherever it is in its client's queue."""
        if self._leave_aside(transaction):
            return
        self._of(turn_of(transaction.client)).queue.remove(transaction)
        self.live -= 1

    def entries(self) -> Iterator[Transaction]:
        """Return all entries of the queues, including ended ones, in any order, without those set aside."""
        return chain.from_iterable(turn.queue.entries() for turn in self._turns.values())

    def __iter__(self) -> Iterator[Transaction]:
        return chain(self.aside, chain.from_iterable(turn.queue for turn in self._turns.values()))

    # sequences that may not begin

    def admit_sequences(self, rule: SequenceRule | None) -> None:
        """Set aside the requests of sequences that may not begin any more, and put back the others."""
        self.rule = rule
        before, self.aside = self.aside, []
        for transaction in reversed(before):
            if self._stays_aside(transaction):
                self.aside.insert(0, transaction)
            else:
                self._put_back(transaction)
        if rule is not None:
            waiting = [one for turn in self._waiting() for one in turn.queue if self._stays_aside(one)]
            for transaction in waiting:
                self.remove(transaction)
            self.aside += waiting

    def let_pass(self, transaction: Transaction) -> None:
        """Put back a request that was set aside. It may be sent, but does not begin its sequence."""
        if self._leave_aside(transaction):
            self._put_back(transaction)

    def _put_back(self, transaction: Transaction) -> None:
        """Put back a request that was set aside. Its client was waiting all the time, so it does not count as new."""
        self._of(turn_of(transaction.client)).queue.push_front(transaction)
        self.live += 1

    def _stays_aside(self, transaction: Transaction) -> bool:
        hold = transaction.client
        # A stop never waits for a sequence: it is sent, and the sequence begins later.
        if not isinstance(hold, Hold) or hold.holds or transaction.stop or self.rule is None:
            return False
        return not self.rule.may_begin(hold)

    def _leave_aside(self, transaction: Transaction) -> bool:
        """Remove a transaction from those set aside. Returns True if it was one of them."""
        place = next((place for place, one in enumerate(self.aside) if one is transaction), None)
        if place is None:
            return False
        del self.aside[place]
        return True

    # whose turn it is

    def waiting_of(self, client: LineClient) -> int:
        """Return the number of a client's queued transactions."""
        turn = self._turns.get(client)
        aside = sum(turn_of(one.client) is client for one in self.aside) if self.aside else 0
        return aside if turn is None else turn.queue.live + aside

    def charge(self, client: LineClient, seconds: float) -> None:
        """Charge line time to a client."""
        turn = self._turns.get(client)
        if turn is not None:
            # Line time and not the number of exchanges: a block of MSC takes far longer than a short read.
            turn.had += seconds / client.share

    def forget(self, client: LineClient) -> None:
        """Remove a client that has no queued requests."""
        turn = self._turns.pop(client, None)
        if turn is self._next:
            self._next = None

    def count_run(self, client: LineClient, turns: int = 1) -> None:
        """Count turns of a client while lower classes waited."""
        turn = self._turns.get(client)
        if turn is not None:
            turn.run += turns

    def begin_runs(self) -> None:
        """Reset the counts: a lower class had a turn."""
        for turn in self._turns.values():
            turn.run = 0

    def shortest_run(self) -> int:
        """Return the smallest number of turns that a waiting client has had since a lower class had one."""
        return min((turn.run for turn in self._waiting()), default=0)

    def _of(self, client: LineClient) -> _Turn:
        turn = self._turns.get(client)
        if turn is None:
            turn = self._turns[client] = _Turn(client, self._new_queue())
        return turn

    def _waiting(self) -> list[_Turn]:
        return [turn for turn in self._turns.values() if turn.queue.live]

    def _joined(self, transaction: Transaction) -> _Turn:
        """Return the turn of a transaction's client, which starts to wait now."""
        if not self.live:  # no client has waited for another, so all start equal
            self._had = 0.0
            for other in self._turns.values():
                other.had = 0.0
        turn = self._of(turn_of(transaction.client))
        # A client that was idle starts with the value of the others: it cannot save up turns for a burst.
        if not turn.queue.live:
            turn.passed = 0
            if turn.had < self._had:
                turn.had = self._had
        return turn

    def _chosen(self) -> _Turn:
        # URGENT only: the safe state must not wait for the stops of 64 programs.
        if self._owner_first and self._own.live:
            return self._turns[OWN]
        given_back, self._next = self._next, None
        if given_back is not None and given_back.queue.live:
            return given_back
        waiting = self._waiting()
        first = min(waiting, key=_had)
        # The value with which a client starts that begins to wait now.
        self._had = first.had
        if len(waiting) > 1:
            most = PASSED_BY_EACH * (len(waiting) - 1)
            # R9's bound: without it, a client that has used much would wait until all others had used as much, for any
            # time.
            first = next((turn for turn in waiting if turn.passed * turn.client.share >= most), first)
            for turn in waiting:
                turn.passed += 1
        return first


URGENT_RUN = 16
"""Consecutive urgent exchanges of one program after which a waiting lower class gets one slot. The line's owner has no
such limit."""


MOST_USED = 1.0
"""Seconds for which a client lets the owner go first at most, unless its last exchange alone costs more."""
NEW_NODES_OWNER_TIME = 127.0
"""`owner_time` of all requests together to nodes that only clients named and that have never replied. Each can take a
whole maximum reply delay. One too many in a cycle of the owner makes it miss the next, so few go before a waiting
owner."""
MOST_BEFORE_URGENT = 8
"""Maximum owner time behind one urgent exchange, as a multiple of its part. With less, the owner would not get its part
if many users have their first urgent exchanges. With more, a stop would wait longer."""
HELD_TIME = 2.0
"""Factor for the time that the owner gets after a client's sequence has held the line while the owner waited, before
another such sequence begins; multiplied by the role's `owner_time`. It is 2 because polls that become due meanwhile are
missed, and the owner cannot use the time between its cycles to catch up. With 1, a line that is 75 % busy kept 3/7."""
LEAST_PAUSE = 1e-6
"""Pauses shorter than this, in seconds, are skipped."""
LONGEST_PAUSE = 8.0
"""Factor for the longest pause: after this many times the pause, a sequence may begin whatever other requests of the
role use."""
MOST_LEFT = 64
"""Maximum number of accounts kept for users without a connection. The oldest is discarded first."""


class SharedBacklog(Backlog):
    """Queues in which clients take turns in each class. `hold` is the sequence for which the line is held."""

    __slots__ = (
        "_accounts",
        "_attempts",
        "_before_urgent",
        "_begins",
        "_deadlines",
        "_held_by",
        "_last",
        "_left_accounts",
        "_members",
        "_new_nodes",
        "_owner_waited",
        "_pause",
        "_pause_ends",
        "_payer",
        "_roles",
        "_since",
        "_turns",
        "_writes",
        "hold",
    )

    def __init__(self, before: Backlog, writes: Writes, deadlines: Deadlines) -> None:
        """Take over the queued requests of a line that only its owner used so far."""
        super().__init__()
        self.hold: Hold | None = None
        self._members: dict[float, int] = {}
        """Number of connected users for each `owner_time` other than 0."""
        self._roles: dict[float, Account] = {}
        """Common account of all clients for each `owner_time` other than 0."""
        self._accounts: dict[tuple[float, Hashable], Account] = {}
        """By `owner_time` and user. One account per user and not per connection: otherwise a user with many connections
        would get most of the users' line time."""
        self._left_accounts: dict[tuple[float, Hashable], Account] = {}
        """Accounts of users without a connection. A user that connects again takes its account over: otherwise a
        program with a connection for each request would always be entitled."""
        self._new_nodes: LineClient | None = None
        self._before_urgent = 0.0
        """Seconds of line time that the owner may use before the next urgent request of a client that has used its
        part. Negative if the owner had more."""
        self._held_by: Account | None = None
        """The role whose sequence held the line last, until its next sequence may begin."""
        self._pause = 0.0
        """Seconds of line time that the owner gets before that."""
        self._pause_ends = inf
        """Latest end of that pause, whatever the owner has used."""
        self._owner_waited = False
        """True if the owner had a queued request when the line was last given to a client."""
        self._begins = False
        """True if the request popped last belongs to a sequence that may hold the line."""
        self._writes = writes
        self._deadlines = deadlines
        self._streak, self._rotated = before._streak, before._rotated
        self._begin(before)
        self._last: Transaction | None = None
        """The request popped last, and in `_attempts` its number of attempts at that time."""
        self._attempts = 0
        self._payer: tuple[Turns, LineClient] | None = None
        """The class and the client that are charged for the line time since `_since`."""
        self._since = -inf

    def _begin(self, before: Backlog) -> None:
        urgent, command, poll, background = before.queues
        self._turns = (
            Turns(urgent, Fifo, owner_first=True),
            Turns(command, Fifo),
            Turns(poll, EarliestDeadlineFirst),
            Turns(background, EarliestDeadlineFirst),
        )
        self.queues = self._turns
        self._admit_sequences()

    def __len__(self) -> int:
        return super().__len__() + sum(len(turns.aside) for turns in self._turns)

    def waiting_of(self, priority: Priority, client: LineClient | None) -> int:
        """Return the number of queued transactions of this class and client."""
        return self._turns[priority].waiting_of(turn_of(client))

    # the next request

    def pop(self, now: float) -> Transaction | None:
        """Remove and return the next transaction at the time `now`, or None. While a sequence holds the line, only its
        requests."""
        self.note_time(now)
        urgent, *lower = self._turns
        # Only the urgent requests of clients yield; those of the owner go first without limit.
        others = urgent.live > 0 and any(turns.live for turns in lower)
        self._urgent_yields = others and urgent.shortest_run() >= URGENT_RUN
        transaction = super().pop(now) if self.hold is None else self._pop_within(self.hold, now)
        if self._members and transaction is not None and self.hold is None:
            transaction = self._entitled(transaction, now)
        # Otherwise the write would wait until the sequence ends, although its program requested it before (R7).
        while transaction is not None and (write := self._write_before(transaction)) is not None:
            self.restore(transaction)
            self.promote(write, transaction.priority)
            transaction = super().pop(now)
        return self._taken(transaction, now)

    def _entitled(self, transaction: Transaction, now: float) -> Transaction:
        """Return the transaction, or another one if the client of this one has used its part of the line."""
        urgent = transaction.priority is URGENT
        if turn_of(transaction.client).is_entitled(now, urgent):
            return transaction
        if not urgent:
            other = next((found for turns in self._turns if (found := turns.pop_entitled(now)) is not None), None)
        elif (other := self._turns[URGENT].pop_entitled(now, urgent=True)) is None and self._before_urgent > 0:
            # Urgent requests do not wait until their client is entitled: a stop passes. They alternate with the owner
            # by time and not by number, or long writes would take most of the line from short polls.
            other = self._pop_lower(now)
        if other is None:
            return transaction
        self._turns[transaction.priority].put_back(transaction)
        return other

    def _pop_lower(self, now: float) -> Transaction | None:
        """Remove and return the next transaction below URGENT, if an entitled client has one."""
        self._urgent_yields = True
        transaction = super().pop(now)
        if transaction is None or turn_of(transaction.client).is_entitled(now, urgent=False):
            return transaction
        self._turns[transaction.priority].put_back(transaction)
        return next((found for turns in self._turns[1:] if (found := turns.pop_entitled(now)) is not None), None)

    def _pop_within(self, hold: Hold, now: float) -> Transaction | None:
        urgent, *lower = self._turns
        if urgent.live and not self._urgent_yields:
            transaction = urgent.pop()
            if turn_of(transaction.client).is_entitled(now, urgent=True):
                return transaction
            other = urgent.pop_entitled(now, urgent=True)
            if other is None:
                return transaction
            urgent.put_back(transaction)
            return other
        if now >= self._deadlines.hold:  # the sequence ends next
            return None
        of_hold = (turns.pop_of(hold) for turns in lower)
        return next((transaction for transaction in of_hold if transaction is not None), None)

    def _write_before(self, transaction: Transaction) -> Transaction | None:
        """Return a write that must precede a read that begins a sequence: it could not be sent during the sequence."""
        hold = transaction.client
        if not isinstance(hold, Hold) or hold.holds or transaction.writes:
            return None
        write = self._writes.first_of(transaction.node, hold.client)
        if write is None or write.client is hold or write.phase is not QUEUED or write.queued > transaction.queued:
            return None
        return write

    def _taken(self, transaction: Transaction | None, now: float) -> Transaction | None:
        """Record the transaction that is sent next and the client that is charged."""
        if transaction is None:
            self._last = None
            hold = self.hold
            self._payer = None if hold is None else (self._turns[hold.priority], hold.client)
        else:
            self._last, self._attempts = transaction, transaction.attempts
            client = turn_of(transaction.client)
            payer = client.client if isinstance(client, Hold) else client
            self._payer = self._turns[transaction.priority], payer
            self._count_run(transaction.priority, client)
        self._since = now
        asks = None if transaction is None else transaction.client
        self._begins = isinstance(asks, Hold) and SequenceRule(self.hold is not None, self._held_by).may_begin(asks)
        self._owner_waited = self._owner_waits()
        if self._pause and self.hold is None and transaction is None and any(turns.aside for turns in self._turns):
            # On an idle line no exchange ends, so the end of the pause needs a deadline of its own.
            self._deadlines.sequence = min(now + self._pause, self._pause_ends)
        return transaction

    def _owner_waits(self) -> bool:
        return any(turns.waiting_of(OWN) for turns in self._turns)

    def _count_run(self, priority: Priority, client: LineClient) -> None:
        urgent = self._turns[URGENT]
        if priority is not URGENT:
            urgent.begin_runs()
        # The owner's urgent requests have no limit: they are its safe state and its stops.
        elif client is not OWN:
            urgent.count_run(client)

    def restore(self, transaction: Transaction) -> None:
        """Put back the transaction that was popped last. It is popped next, and its class keeps its turn."""
        self._streak, self._rotated = self._streak_before, self._rotated_before
        transaction.phase = QUEUED
        self._turns[transaction.priority].give_back(transaction)

    def keep_turn(self, transaction: Transaction) -> None:
        """Note that the transaction popped last is not sent. Its client has the next turn."""
        self._turns[transaction.priority].keep_turn(turn_of(transaction.client))

    def pick(self, priority: Priority, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Remove and return the first suitable one among the first of a class, or None. The others keep their
        places."""
        turns, hold = self._turns[priority], self.hold
        if hold is None or priority is URGENT:
            found = turns.pick(lambda one: self._write_before(one) is None and suits(one))
        else:
            found = turns.pick_of(hold, suits)
        return found and self._taken(found, self._since)

    def take(self, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Remove and return a suitable transaction of any class, or None. For a request that must be sent now."""
        hold = self.hold

        def may(one: Transaction) -> bool:
            return hold is None or turn_of(one.client) is hold

        found = super().take(lambda one: may(one) and self._write_before(one) is None and suits(one))
        return found and self._taken(found, self._since)

    # holds

    def note_time(self, now: float) -> None:
        """Charge the line time until now. A sequence begins when its first request has been sent."""
        self._begin_hold()
        if self._payer is not None:
            turns, client = self._payer
            turns.charge(client, now - self._since)
            # A client without it takes turns with the owner as an equal: nothing more is counted.
            if client.owner_time:
                self._use(client, now)
                if turns is self._turns[URGENT] and not (self.hold is not None and self.hold.client is client):
                    self._delay_urgent(client, now)
            elif client is OWN and self._before_urgent > 0:
                self._before_urgent -= now - self._since
        if self._held_by is not None:
            self._count_pause(now)
        self._since = now

    def _count_pause(self, now: float) -> None:
        """Count the line time that the owner gets before the next sequence, and end the pause after that time."""
        time, hold = now - self._since, self.hold
        payer = None if self._payer is None else self._payer[1]
        if payer is not None and payer.role is self._held_by and (self._owner_waited or self._owner_waits()):
            of_hold = self._last is None or isinstance(self._last.client, Hold)
            self._pause += time * payer.owner_time * (HELD_TIME if of_hold else 1.0)
            return
        if hold is not None:
            return
        # The owner's queue was empty, or its request was on the wire. Counted in time and not in exchanges: polls may
        # be short and sequences long.
        self._pause -= time
        if self._pause <= LEAST_PAUSE or now >= self._pause_ends:
            self._end_pause()

    def _end_pause(self) -> None:
        self._held_by, self._pause, self._pause_ends = None, 0.0, inf
        self._deadlines.sequence = inf
        self._admit_sequences()

    def _admit_sequences(self) -> None:
        """Update in each class which sequences are set aside."""
        rule = SequenceRule(self.hold is not None, self._held_by)
        for turns in self._turns:
            turns.admit_sequences(rule if rule.held or rule.role is not None else None)

    def let_pass(self, transaction: Transaction) -> None:
        """Send a transaction although its sequence may not begin: a stop is queued behind it."""
        self._turns[transaction.priority].let_pass(transaction)

    def _use(self, client: LineClient, now: float) -> None:
        """Update until when a client has used its part. All users with the same `owner_time` have equal parts."""
        cost, hold = 1 + client.owner_time, self.hold
        used = (now - self._since) * cost
        held = (now - hold.began) * cost if hold is not None and hold.client is client else 0.0
        members = self._members.get(client.owner_time, 1)
        self._charge(client.role, used, held, now)
        # With n users of a role, each may use a part of 1/n.
        self._charge(client.account, used * members, held * members, now)

    def _charge(self, account: Account, used: float, held: float, now: float) -> None:
        # Bounded, because line time used while the line was idle took nothing from others. The bound is more than one
        # exchange costs, or a client would be entitled again as soon as all others had their turns. A sequence is
        # charged whole, however many pieces it was counted in.
        most = now + max(2 * used, held, MOST_USED)
        until = min(max(account.used_until, self._since) + used, most)
        account.used_until = max(account.used_until, until)

    def _delay_urgent(self, client: LineClient, now: float) -> None:
        """Give the owner its time behind an urgent exchange, minus its excess from before."""
        # Bounded: a stop of a client that has used its part waits no longer than this, whatever others have used.
        time = client.owner_time * (now - self._since)
        self._before_urgent = min(self._before_urgent + time, MOST_BEFORE_URGENT * time)

    def _begin_hold(self) -> None:
        last = self._last
        if last is not None and last.attempts > self._attempts and self._begins:
            hold = last.client
            if isinstance(hold, Hold) and not (hold.holds or hold.over):
                self._hold_for(hold, last.priority)

    def _hold_for(self, hold: Hold, priority: Priority) -> None:
        hold.priority = priority
        waiting = [transaction for turns in self._turns for transaction in turns if transaction.client is hold]
        for transaction in waiting:
            self._turns[transaction.priority].remove(transaction)
        hold.holds = True
        for transaction in waiting:
            self._turns[transaction.priority].push(transaction)
        self.hold = hold
        if hold.client.owner_time:
            # By role and not by client: a user with several programs could otherwise hold the line with one after the
            # other.
            self._held_by, hold.began = hold.client.role, self._since
        self._admit_sequences()
        self._deadlines.hold = self._since + hold.longest

    def end_hold(self, hold: Hold, now: float) -> list[Transaction]:
        """End a sequence. Returns its queued requests, which are not sent any more.

        One exchange of a lower class goes next, if one is queued, so that consecutive sequences do not starve it.
        """
        self.note_time(now)
        left = list(self._left(hold))
        for transaction in left:
            if transaction.phase is QUEUED:
                self.discard(transaction, FAILING)
            else:
                transaction.phase = FAILING
        # A sequence without any sent request never held the line, so it ends without a pause.
        if hold.holds:
            self.hold = None
            self._deadlines.hold = inf
            if hold.priority <= COMMAND:
                # The next slot goes to a lower class: consecutive sequences would otherwise starve the polls.
                self._streak = SHARE
            if hold.priority == URGENT and hold.client is not OWN:
                self._turns[URGENT].count_run(hold.client, URGENT_RUN)
            self._payer = None if self._last is None else self._payer
        for turns in self._turns:
            turns.forget(hold)
        held, hold.holds, hold.over = hold.holds, False, True
        if held:
            self._begin_pause(now)
        return left

    def _begin_pause(self, now: float) -> None:
        """Set aside other sequences until the owner has had its part of the line."""
        if self._held_by is not None:
            self._pause_ends = now + LONGEST_PAUSE * self._pause
            if self._pause <= LEAST_PAUSE and self._last is None:
                self._end_pause()
                return
            # If an exchange of the sequence is on the wire, its end decides whether there is a pause.
        self._admit_sequences()

    def _left(self, hold: Hold) -> Iterator[Transaction]:
        for turns in self._turns:
            yield from (transaction for transaction in turns if transaction.client is hold)
        yield from self._writes.parked_of(hold.node, hold)

    def admit(self, client: LineClient, owner_time: float) -> None:
        """Count a client among those with this `owner_time`."""
        self._dismiss(client)
        client.owner_time, client.account = owner_time, Account()
        client.role = client.account
        if not owner_time:
            return
        client.role = self._roles.setdefault(owner_time, Account())
        key = _account_of(client)
        account = self._accounts.get(key)
        if account is None:
            # A user that reconnects has its used line time again (see `_left_accounts`).
            account = self._accounts[key] = self._left_accounts.pop(key, client.account)
            self._members[owner_time] = self._members.get(owner_time, 0) + 1
        account.clients += 1
        client.account = account

    def new_nodes(self) -> LineClient:
        """Return the client that stands for all requests to new nodes until they reply."""
        client = self._new_nodes
        if client is None:
            client = self._new_nodes = LineClient()
            self.admit(client, NEW_NODES_OWNER_TIME)
        return client

    def _dismiss(self, client: LineClient) -> None:
        account = client.account
        if not account.clients:
            return
        account.clients -= 1
        if account.clients:
            return
        key, owner_time = _account_of(client), client.owner_time
        del self._accounts[key]
        if client.user is not None:  # a client without a user never connects again
            self._left_accounts[key] = account
            if len(self._left_accounts) > MOST_LEFT:
                # R12: a client that connects under many users would otherwise fill the memory.
                del self._left_accounts[next(iter(self._left_accounts))]
        self._members[owner_time] -= 1
        if not self._members[owner_time]:
            del self._members[owner_time]

    def forget(self, client: LineClient) -> None:
        """Remove a client that has disconnected and has no queued requests."""
        self._dismiss(client)
        for turns in self._turns:
            turns.forget(client)

    def drain(self) -> list[Transaction]:
        """Remove and return all transactions, in order of class."""
        drained = [transaction for turns in self._turns for transaction in turns]
        # New queues: the old ones still hold the transactions that are failed in batches.
        empty = Backlog()
        empty.queues = new_queues()
        self._begin(empty)
        self._begin_hold()  # before `_last` is cleared
        self._payer = self._last = None
        return drained


def _account_of(client: LineClient) -> tuple[float, Hashable]:
    return client.owner_time, client if client.user is None else client.user
