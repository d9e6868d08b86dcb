"""The backlog of a line that several programs share, and that is held for sequences of requests (R9).

One class of the backlog on a line that several programs share: they take turns, by the line time that each has had.

Whose requests have had the least of the line (weighed by its share) goes next: start-time fair queueing. Who comes
begins with what the others have had, so that nobody saves up for a burst; who has just had a long exchange waits until
the others that wait have had as much, but nobody is passed over more than twice by each of them (R9).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from itertools import chain
from math import inf
from operator import attrgetter
from typing import TypeAlias

from busmaster.arbiter.backlog import LOOKED_AT, SHARE, Backlog, EarliestDeadlineFirst, Fifo, Queue, Writes, new_queues
from busmaster.arbiter.clients import OWN, Account, Hold, LineClient, turn_of
from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.transaction import COMMAND, FAILING, QUEUED, URGENT, Priority, Transaction

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

    __slots__ = ("_had", "_new_queue", "_next", "_own", "_owner_first", "_turns", "aside", "live", "may_begin")

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
        self.may_begin: Callable[[Hold], bool] | None = None
        """Whether the line can be held for a sequence; None: for each. Change it with `admit_sequences`."""
        self.aside: list[Transaction] = []
        """Requests of sequences that may not begin. They wait outside the queues: nothing waits behind them."""

    def push(self, transaction: Transaction) -> None:
        """Add a transaction at its place in its client's queue."""
        if self.may_begin is not None and self._stays_aside(transaction):
            self.aside.append(transaction)
            return
        self._joined(transaction).queue.push(transaction)
        self.live += 1

    def push_front(self, transaction: Transaction) -> None:
        """Add a transaction before all others of its client."""
        if self.may_begin is not None and self._stays_aside(transaction):
            self.aside.insert(0, transaction)
            return
        self._joined(transaction).queue.push_front(transaction)
        self.live += 1

    def give_back(self, transaction: Transaction) -> None:
        """Put back what was popped last: it is the next to be popped."""
        self.push_front(transaction)
        self._next = self._of(turn_of(transaction.client))

    def keep_turn(self, client: LineClient) -> None:
        """Have this client go next, if it waits: of what was popped last nothing was sent."""
        turn = self._turns.get(client)
        if turn is not None and turn.queue.live:
            self._next = turn

    def pop(self) -> Transaction:
        """Take out the first of the client whose turn it is. Raises IndexError if nobody waits."""
        turn = self._chosen()
        self.live -= 1
        # Moved to the end, so that clients with the same use take turns in the order of their last turns.
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
        self._put_back(transaction)

    def pick(self, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Take out the first of the first few that suits, or return None; of the client whose turn it is, if it can."""
        # The first few clients and the first few requests of each: a bounded search, whoever fills a queue.
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
        if self._leave_aside(transaction):
            return
        self.live -= 1
        self._of(turn_of(transaction.client)).queue.discard(transaction)

    def remove(self, transaction: Transaction) -> None:
        """Take out this transaction at once, wherever in its client's queue it is."""
        if self._leave_aside(transaction):
            return
        self._of(turn_of(transaction.client)).queue.remove(transaction)
        self.live -= 1

    def entries(self) -> Iterator[Transaction]:
        """Return all that is in the queues, ended ones too, in no order; not what waits aside."""
        return chain.from_iterable(turn.queue.entries() for turn in self._turns.values())

    def __iter__(self) -> Iterator[Transaction]:
        return chain(self.aside, chain.from_iterable(turn.queue for turn in self._turns.values()))

    # sequences that may not begin

    def admit_sequences(self, may_begin: Callable[[Hold], bool] | None) -> None:
        """Put aside what waits of sequences that may not begin from now on, and put back the others."""
        self.may_begin = may_begin
        before, self.aside = self.aside, []
        for transaction in reversed(before):
            if self._stays_aside(transaction):
                self.aside.insert(0, transaction)
            else:
                self._put_back(transaction)
        if may_begin is not None:
            waiting = [one for turn in self._waiting() for one in turn.queue if self._stays_aside(one)]
            for transaction in waiting:
                self.remove(transaction)
            self.aside += waiting

    def let_pass(self, transaction: Transaction) -> None:
        """Put back one that waits aside: it may be sent, but its sequence does not begin with it."""
        if self._leave_aside(transaction):
            self._put_back(transaction)

    def _put_back(self, transaction: Transaction) -> None:
        """Put back one that waited aside. Its client has waited all the time: it is not one that comes now."""
        self._of(turn_of(transaction.client)).queue.push_front(transaction)
        self.live += 1

    def _stays_aside(self, transaction: Transaction) -> bool:
        hold = transaction.client
        # A stop never waits for a sequence: it is sent, and the sequence begins later.
        if not isinstance(hold, Hold) or hold.holds or transaction.stop or self.may_begin is None:
            return False
        return not self.may_begin(hold)

    def _leave_aside(self, transaction: Transaction) -> bool:
        """Take a transaction out of those that wait aside. Returns whether it was one of them."""
        place = next((place for place, one in enumerate(self.aside) if one is transaction), None)
        if place is None:
            return False
        del self.aside[place]
        return True

    # whose turn it is

    def waiting_of(self, client: LineClient) -> int:
        """Return how many transactions of a client wait."""
        turn = self._turns.get(client)
        aside = sum(turn_of(one.client) is client for one in self.aside) if self.aside else 0
        return aside if turn is None else turn.queue.live + aside

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
        # A client that was idle begins where the others are: it cannot save up turns for a burst.
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


URGENT_RUN = 16
"""Urgent exchanges of one program in a row after which a waiting lower class gets one slot. The line's owner has no
such limit."""


MOST_USED = 1.0
"""Seconds for which a client lets the owner go first at most, unless its last exchange alone costs more."""
NEW_NODES_OWNER_TIME = 127.0
"""`owner_time` of all requests together to nodes that only clients named and that have never replied. Each can take a
whole maximum reply delay, and one too many in a cycle of the owner makes it miss the next: so few go before a waiting
owner."""
MOST_BEFORE_URGENT = 8
"""How many times its part behind one urgent exchange the owner may use at once. With less it would not get its part
where many users have their first urgent exchanges; with more a stop would wait longer."""
HELD_TIME = 2.0
"""How many times as long as a sequence of a client held the line, while the owner waited, the owner then has before
another such sequence begins; times the role's `owner_time`. Twice, since polls that are due meanwhile are missed, and
the owner cannot use the time between its cycles to catch up: with once as long, a line that is 75 % busy had 3/7."""
LEAST_PAUSE = 1e-6
"""Seconds below which no sequence waits."""
LONGEST_PAUSE = 8.0
"""How many times that, in seconds, until a sequence may begin in any case, whatever other requests of the role take."""
MOST_LEFT = 64
"""Accounts of users without a connection that are kept. The oldest is discarded first."""


class SharedBacklog(Backlog):
    """A backlog in each of whose classes clients take turns. `hold` is for whom the line is held."""

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
        """Take over what waits in the backlog that a line had as long as it was its owner's alone."""
        super().__init__()
        self.hold: Hold | None = None
        self._members: dict[float, int] = {}
        """How many users are connected with each `owner_time` but 0."""
        self._roles: dict[float, Account] = {}
        """The account of all clients together with each `owner_time` but 0."""
        self._accounts: dict[tuple[float, Hashable], Account] = {}
        """By `owner_time` and user. One per user and not per connection, or a user with many connections would have
        most of what the users have together."""
        self._left_accounts: dict[tuple[float, Hashable], Account] = {}
        """Accounts of users without a connection. A user that connects again takes its account over: otherwise a
        program with a connection for each request would always be entitled."""
        self._new_nodes: LineClient | None = None
        self._before_urgent = 0.0
        """Seconds of the line that the owner may use before the next urgent request of a client that has used its
        part. Below 0, the owner had more than that."""
        self._held_by: Account | None = None
        """The role whose sequence held the line last, until its next one may begin."""
        self._pause = 0.0
        """Seconds that the line's owner is to have before that."""
        self._pause_ends = inf
        """When it ends, whatever the owner has had."""
        self._owner_waited = False
        """Whether the owner had something waiting when the line was given away last."""
        self._begins = False
        """Whether what was taken out last is of a sequence that may hold the line."""
        self._writes = writes
        self._deadlines = deadlines
        self._streak, self._rotated = before._streak, before._rotated
        self._begin(before)
        self._last: Transaction | None = None
        """What was taken out last, when it had been sent so often:"""
        self._attempts = 0
        self._payer: tuple[Turns, LineClient] | None = None
        """Who pays for the time of the line, and in which class, ever since:"""
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
        """Return how many transactions of this class wait that are this client's."""
        return self._turns[priority].waiting_of(turn_of(client))

    # what goes next

    def pop(self, now: float) -> Transaction | None:
        """Take out the next to go at the time `now`, or return None: of those of a hold alone, as long as one lasts."""
        self.note_time(now)
        urgent, *lower = self._turns
        # Only the urgent requests of clients yield; those of the owner go first without limit.
        others = urgent.live > 0 and any(turns.live for turns in lower)
        self._urgent_yields = others and urgent.shortest_run() >= URGENT_RUN
        transaction = super().pop(now) if self.hold is None else self._pop_within(self.hold, now)
        if self._members and transaction is not None and self.hold is None:
            transaction = self._entitled(transaction, now)
        while transaction is not None and (write := self._write_before(transaction)) is not None:
            self.restore(transaction)
            self.promote(write, transaction.priority)
            transaction = super().pop(now)
        return self._taken(transaction, now)

    def _entitled(self, transaction: Transaction, now: float) -> Transaction:
        """Return the same, or what goes first because the client of this one has used up its part of the line."""
        urgent = transaction.priority is URGENT
        if turn_of(transaction.client).is_entitled(now, urgent):
            return transaction
        if not urgent:
            other = next((found for turns in self._turns if (found := turns.pop_entitled(now)) is not None), None)
        elif (other := self._turns[URGENT].pop_entitled(now, urgent=True)) is None and self._before_urgent > 0:
            # Urgent requests are not held back until their client is entitled: a stop passes. They alternate with the
            # owner, by time and not by number, or long writes would take most of the line from short polls.
            other = self._pop_lower(now)
        if other is None:
            return transaction
        self._turns[transaction.priority].put_back(transaction)
        return other

    def _pop_lower(self, now: float) -> Transaction | None:
        """Take out what goes next below URGENT, if a client that has not used its part waits there."""
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
        if now >= self._deadlines.hold:  # it ends next
            return None
        of_hold = (turns.pop_of(hold) for turns in lower)
        return next((transaction for transaction in of_hold if transaction is not None), None)

    def _write_before(self, transaction: Transaction) -> Transaction | None:
        """Return a write that has to go before a read with which a sequence begins: once it has begun, it could not."""
        hold = transaction.client
        if not isinstance(hold, Hold) or hold.holds or transaction.writes:
            return None
        write = self._writes.first_of(transaction.node, hold.client)
        if write is None or write.client is hold or write.phase is not QUEUED or write.queued > transaction.queued:
            return None
        return write

    def _taken(self, transaction: Transaction | None, now: float) -> Transaction | None:
        """Note what goes next, and who pays for it."""
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
        self._begins = isinstance(asks, Hold) and self._may_begin(asks)
        self._owner_waited = self._owner_waits()
        if self._pause and self.hold is None and transaction is None and any(turns.aside for turns in self._turns):
            self._deadlines.sequence = min(now + self._pause, self._pause_ends)
        return transaction

    def _owner_waits(self) -> bool:
        return any(turns.waiting_of(OWN) for turns in self._turns)

    def _count_run(self, priority: Priority, client: LineClient) -> None:
        urgent = self._turns[URGENT]
        if priority is not URGENT:
            urgent.begin_runs()
        elif client is not OWN:
            urgent.count_run(client)

    def restore(self, transaction: Transaction) -> None:
        """Put back what was popped last: it is the next to be popped, and its class keeps its turn."""
        self._streak, self._rotated = self._streak_before, self._rotated_before
        transaction.phase = QUEUED
        self._turns[transaction.priority].give_back(transaction)

    def keep_turn(self, transaction: Transaction) -> None:
        """Note that what was popped last is not sent: its client is the next to have its turn."""
        self._turns[transaction.priority].keep_turn(turn_of(transaction.client))

    def pick(self, priority: Priority, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Take out the first of the first few of a class that suits, or return None; the others keep their places."""
        turns, hold = self._turns[priority], self.hold
        if hold is None or priority is URGENT:
            found = turns.pick(lambda one: self._write_before(one) is None and suits(one))
        else:
            found = turns.pick_of(hold, suits)
        return found and self._taken(found, self._since)

    def take(self, suits: Callable[[Transaction], bool]) -> Transaction | None:
        """Take out one that suits, of whatever class, or return None: for what has to be asked now in any case."""
        hold = self.hold

        def may(one: Transaction) -> bool:
            return hold is None or turn_of(one.client) is hold

        found = super().take(lambda one: may(one) and self._write_before(one) is None and suits(one))
        return found and self._taken(found, self._since)

    # holds

    def note_time(self, now: float) -> None:
        """Have whoever had the line until now pay for it; a sequence of which a request was sent has begun."""
        self._begin_hold()
        if self._payer is not None:
            turns, client = self._payer
            turns.charge(client, now - self._since)
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
        """Count what the owner is to have before the next sequence begins, and end the pause when it has had that."""
        time, hold = now - self._since, self.hold
        payer = None if self._payer is None else self._payer[1]
        if payer is not None and payer.role is self._held_by and (self._owner_waited or self._owner_waits()):
            of_hold = self._last is None or isinstance(self._last.client, Hold)
            self._pause += time * payer.owner_time * (HELD_TIME if of_hold else 1.0)
            return
        if hold is not None:
            return
        # As the owner has nothing to send, or its request was on the wire.
        # Counted in time and not in exchanges: polls may be short and sequences long.
        self._pause -= time
        if self._pause <= LEAST_PAUSE or now >= self._pause_ends:
            self._end_pause()

    def _end_pause(self) -> None:
        self._held_by, self._pause, self._pause_ends = None, 0.0, inf
        self._deadlines.sequence = inf
        self._admit_sequences()

    def _admit_sequences(self) -> None:
        """Have each class put aside the sequences that may not begin now."""
        waits = self.hold is not None or self._held_by is not None
        for turns in self._turns:
            turns.admit_sequences(self._may_begin if waits else None)

    def _may_begin(self, hold: Hold) -> bool:
        """Return whether the line can be held for a sequence that does not hold it."""
        return self.hold is None and hold.client.role is not self._held_by

    def let_pass(self, transaction: Transaction) -> None:
        """Have one that waits be sent although its sequence may not begin: a stop waits behind it."""
        self._turns[transaction.priority].let_pass(transaction)

    def _use(self, client: LineClient, now: float) -> None:
        """Note until when a client has used its part of the line: all of its `owner_time` have equal parts."""
        cost, hold = 1 + client.owner_time, self.hold
        used = (now - self._since) * cost
        held = (now - hold.began) * cost if hold is not None and hold.client is client else 0.0
        members = self._members.get(client.owner_time, 1)
        self._charge(client.role, used, held, now)
        self._charge(client.account, used * members, held * members, now)

    def _charge(self, account: Account, used: float, held: float, now: float) -> None:
        # Bounded, since what it used while the line was idle took nothing from the others; but more than one exchange
        # costs, or a client would be entitled again as soon as all others had their turns. A sequence is charged whole,
        # in however many pieces it has been counted.
        most = now + max(2 * used, held, MOST_USED)
        until = min(max(account.used_until, self._since) + used, most)
        account.used_until = max(account.used_until, until)

    def _delay_urgent(self, client: LineClient, now: float) -> None:
        """Give the owner its time behind an urgent exchange. What it had beyond its time before is taken off."""
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
            self._held_by, hold.began = hold.client.role, self._since
        self._admit_sequences()
        self._deadlines.hold = self._since + hold.longest

    def end_hold(self, hold: Hold, now: float) -> list[Transaction]:
        """Hold the line no longer for a sequence. Returns what of it waits, which is not sent any more.

        One lower exchange goes next, if any waits: sequences one after the other leave nobody out.
        """
        self.note_time(now)
        left = list(self._left(hold))
        for transaction in left:
            if transaction.phase is QUEUED:
                self.discard(transaction, FAILING)
            else:
                transaction.phase = FAILING
        # A sequence of which nothing was sent never held the line: it ends without a pause for others.
        if hold.holds:
            self.hold = None
            self._deadlines.hold = inf
            if hold.priority <= COMMAND:
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
        """Have other sequences wait until the owner has had its part of the line."""
        if self._held_by is not None:
            self._pause_ends = now + LONGEST_PAUSE * self._pause
            if self._pause <= LEAST_PAUSE and self._last is None:
                self._end_pause()
                return
            # With an exchange of the sequence on the wire, its end says whether there is a pause.
        self._admit_sequences()

    def _left(self, hold: Hold) -> Iterator[Transaction]:
        for turns in self._turns:
            yield from (transaction for transaction in turns if transaction.client is hold)
        yield from self._writes.parked_of(hold.node, hold)

    def admit(self, client: LineClient, owner_time: float) -> None:
        """Count a client among those of this `owner_time` from now on."""
        self._dismiss(client)
        client.owner_time, client.account = owner_time, Account()
        client.role = client.account
        if not owner_time:
            return
        client.role = self._roles.setdefault(owner_time, Account())
        key = _account_of(client)
        account = self._accounts.get(key)
        if account is None:
            account = self._accounts[key] = self._left_accounts.pop(key, client.account)
            self._members[owner_time] = self._members.get(owner_time, 0) + 1
        account.clients += 1
        client.account = account

    def new_nodes(self) -> LineClient:
        """Return the client that has the requests of all clients to new nodes, until such a node replies."""
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
        if client.user is not None:  # the client itself comes no more
            self._left_accounts[key] = account
            if len(self._left_accounts) > MOST_LEFT:
                # Bounded: a client that connects under many users would otherwise fill the memory.
                del self._left_accounts[next(iter(self._left_accounts))]
        self._members[owner_time] -= 1
        if not self._members[owner_time]:
            del self._members[owner_time]

    def forget(self, client: LineClient) -> None:
        """Keep nothing of a client that has gone, and has nothing waiting."""
        self._dismiss(client)
        for turns in self._turns:
            turns.forget(client)

    def drain(self) -> list[Transaction]:
        """Take out everything that waits, in order of class; the backlog is empty afterwards."""
        drained = [transaction for turns in self._turns for transaction in turns]
        # New queues: the old ones belong to what is being failed in pieces.
        empty = Backlog()
        empty.queues = new_queues()
        self._begin(empty)
        self._begin_hold()  # before what is known of the request that has left is forgotten
        self._payer = self._last = None
        return drained


def _account_of(client: LineClient) -> tuple[float, Hashable]:
    return client.owner_time, client if client.user is None else client.user
