"""The backlog of a line that several programs share, and that is held for sequences of requests (R9)."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from math import inf

from busmaster.arbiter.backlog import SHARE, Backlog, new_queues
from busmaster.arbiter.clients import OWN, Account, Hold, LineClient, turn_of
from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.queues import EarliestDeadlineFirst, Fifo
from busmaster.arbiter.transaction import COMMAND, FAILING, QUEUED, URGENT, Priority, Transaction
from busmaster.arbiter.turns import Turns
from busmaster.arbiter.writes import Writes

URGENT_RUN = 16
"""Urgent exchanges of one program in a row after which a waiting lower class gets one slot. The line's owner has no
such limit."""


MOST_USED = 1.0
"""Seconds for which a client lets the owner go first at most, unless its last exchange alone costs more."""
NEW_NODES_OWNER_TIME = 127.0
"""`owner_time` of all requests together to nodes that only clients named and that have never replied. Each can take a
whole lateness, and one too many in a cycle of the owner makes it miss the next: so few go before a waiting owner."""
MOST_BEFORE_URGENT = 8
"""How many times its part behind one urgent exchange the owner may use at once. With less it would not get its part
where many users have their first urgent exchanges; with more a stop would wait longer."""
MOST_LEFT = 64
"""Accounts of users without a connection that are kept. The oldest is discarded first."""


class SharedBacklog(Backlog):
    """A backlog in each of whose classes clients take turns. `hold` is for whom the line is held."""

    __slots__ = (
        "_accounts",
        "_attempts",
        "_before_urgent",
        "_deadlines",
        "_last",
        "_left_accounts",
        "_members",
        "_new_nodes",
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

    def waiting_of(self, priority: Priority, client: LineClient | None) -> int:
        """Return how many transactions of this class wait that are this client's."""
        return self._turns[priority].waiting_of(turn_of(client))

    # what goes next

    def pop(self, now: float) -> Transaction | None:
        """Take out the next to go at the time `now`, or return None: of those of a hold alone, as long as one lasts."""
        self.note_time(now)
        urgent = self._turns[URGENT]
        self._urgent_yields = urgent.live > 0 and len(self) > urgent.live and urgent.shortest_run() >= URGENT_RUN
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
            return urgent.pop()
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
        return transaction

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
        if self._payer is not None:
            turns, client = self._payer
            turns.charge(client, now - self._since)
            if client.owner_time:
                self._use(client, now)
                if turns is self._turns[URGENT]:
                    self._delay_urgent(client, now)
            elif client is OWN and self._before_urgent > 0:
                self._before_urgent -= now - self._since
        self._begin_hold()
        self._since = now

    def _use(self, client: LineClient, now: float) -> None:
        """Note until when a client has used its part of the line: all of its `owner_time` have equal parts."""
        used = (now - self._since) * (1 + client.owner_time)
        self._charge(client.role, used, now)
        self._charge(client.account, used * self._members.get(client.owner_time, 1), now)

    def _charge(self, account: Account, used: float, now: float) -> None:
        # Bounded, since what it used while the line was idle took nothing from the others; but more than one exchange
        # costs, or a client would be entitled again as soon as all others had their turns.
        account.used_until = min(max(account.used_until, self._since) + used, now + max(2 * used, MOST_USED))

    def _delay_urgent(self, client: LineClient, now: float) -> None:
        """Give the owner its time behind an urgent exchange. What it had beyond its time before is taken off."""
        # Bounded: a stop of a client that has used its part waits no longer than this, whatever others have used.
        time = client.owner_time * (now - self._since)
        self._before_urgent = min(self._before_urgent + time, MOST_BEFORE_URGENT * time)

    def _begin_hold(self) -> None:
        last = self._last
        if last is not None and last.attempts > self._attempts:
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
        hold.holds, hold.over = False, True
        return left

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
        empty = Backlog()
        empty.queues = new_queues()
        self._begin(empty)
        self._begin_hold()  # before what is known of the request that has left is forgotten
        self._payer = self._last = None
        return drained


def _account_of(client: LineClient) -> tuple[float, Hashable]:
    return client.owner_time, client if client.user is None else client.user
