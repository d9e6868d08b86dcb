"""The arbiter of one line: what its owner asks of it. What the line does is told in line_machine.py.

Time starts when bytes have left. `poll_transmit` hands them over; `transmitted` says when the port had taken them, and
`unsent`, asked for when a deadline of the line falls due, how many have not left yet: until then, nothing runs out.

What goes next is chosen in choice.py, by what is owed (in_step.py). What becomes of a failed attempt is dispatcher.py's
business.
"""

from __future__ import annotations

from collections.abc import Hashable

from busmaster.arbiter.clients import OWN, Hold, LineClient
from busmaster.arbiter.counters import LineStatistics
from busmaster.arbiter.events import Event
from busmaster.arbiter.health import DOWN, NodeRecord
from busmaster.arbiter.learned import Learning
from busmaster.arbiter.line_machine import LineMachine
from busmaster.arbiter.state import EXCHANGE, READY
from busmaster.arbiter.tap import Attempt
from busmaster.arbiter.tapped import set_tapped
from busmaster.arbiter.transaction import Poll, Transaction
from busmaster.contract.learning import Learned, documented
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import BusClosed


class Arbiter(LineMachine):
    """The arbiter of one line: the line's states, and these commands.

    `byte_time` is tau, in seconds. `echo`: what is sent is received too. `receive_latency`: seconds that received bytes
    may lie in an adapter. `capacity`: requests of one class that may wait. `jitter` returns numbers from 0 to 1, by
    which probes are spread. `strict`: answers that could be another's are held until that one would have come (R15).
    """

    name = ""
    """What errors call the line."""
    longest_hold = 0.0
    """Of the sequences that were begun, the longest time, in seconds, for which one may hold the line."""

    @property
    def byte_time(self) -> float:
        """tau: seconds per byte of this line."""
        return self._leg.byte_time

    @byte_time.setter
    def byte_time(self, seconds: float) -> None:
        self._leg.byte_time = seconds

    @property
    def attempt(self) -> Attempt | None:
        """What is on the wire, on a line that is tapped."""
        return self.dispatcher.attempt

    def set_tapped(self, tapped: bool) -> None:
        """Have `attempt` say what is on the wire, and the end of each attempt be an event, from now on, or no more."""
        set_tapped(self.dispatcher, tapped)

    def add_node(
        self,
        profile: Profile,
        address: int,
        now: float,
        timings: Timings | Learned | None = None,
        retries: int | None = None,
    ) -> NodeRecord:
        """Add a node and return its record.

        Raises InvalidCommand for an address that the protocol does not have, and for learned windows where they cannot
        be learned (HCP).
        """
        profile.check_address(address)
        if isinstance(timings, Learned):
            profile.check_learnable()
        node = NodeRecord(
            profile,
            address,
            documented(timings) or profile.timings,
            profile.retries if retries is None else retries,
            self.name,
        )
        if isinstance(timings, Learned):
            node.learning = Learning()
        self.dispatcher.nodes.append(node)
        if profile.listen is not None and self._unasked.listener is None:
            self._unasked.listener = profile.listen()
        # An earlier master may have asked this node just before the port was opened: that reply is waited out (R3).
        self._quarantine = max(self._quarantine, self._up_at + node.lateness + self._leg.latency + self.byte_time)
        return node

    def remove_node(self, node: NodeRecord) -> None:
        """Remove a node: the line sends it no probe and no sync read any more.

        An exchange with it that is on the wire runs out. Its overdue replies stay overdue (R15): another node's reply
        clears them, as it does for a node that is silent.
        """
        node.removed = True
        self.dispatcher.nodes.remove(node)
        self.dispatcher.writes.forget_empty()
        self.dispatcher.probes.plan()

    def ask_within_budget(self, node: NodeRecord, now: float) -> None:
        """Treat a new node as down until its first reply: it is asked within the budget of probes only (R11)."""
        node.health, node.budgeted, node.probe_at = DOWN, True, now
        self.dispatcher.probes.plan()

    def name_node(self, node: NodeRecord, label: str) -> None:
        """Have messages call the node by this label."""
        node.label = label

    def change_profile(self, node: NodeRecord, profile: Profile) -> None:
        """Go by another profile of the node's protocol from now on: one that merges otherwise."""
        node.profile = profile

    def expect_hook(self, node: NodeRecord, expected: bool) -> None:
        """Hold the node's polls when it comes back until `Dispatcher.release_node`, or do not, as `expected` says."""
        node.has_hook = expected

    def note_stop(self, node: NodeRecord) -> None:
        """Count that the node is told to stop."""
        node.stops += 1

    def answer_counts(self, now: float) -> bool:
        """Return whether a caller's time is over while something is on the wire: what has come is handed over first."""
        # A loop that stood still may look at its timers before it reads: what lies unread came in time.
        return self.state is EXCHANGE and now >= self._deadlines.expiry

    def add_client(self, share: float = 1.0, owner_time: float = 0.0, user: Hashable = None) -> LineClient:
        """Return a client with whom the line's owner and other clients take turns from now on (R9)."""
        client = LineClient(share, user=user)
        self.dispatcher.share().admit(client, owner_time)
        return client

    def change_client(self, client: LineClient, owner_time: float) -> None:
        """Give a client another `owner_time`, as its role has changed."""
        self.dispatcher.share().admit(client, owner_time)

    def remove_client(self, client: LineClient) -> None:
        """Forget a client, who has nothing waiting; what it may still have on the wire runs out."""
        client.over = True
        self.dispatcher.share().forget(client)

    def exclusive(self, node: NodeRecord, client: LineClient | None, longest: float) -> Hold:
        """Return what requests name as their client that are one sequence: see `Hold`. It ends with `release`."""
        self.dispatcher.share()
        self.longest_hold = max(self.longest_hold, longest)
        return Hold(node, OWN if client is None else client, longest)

    def release(self, hold: Hold, now: float) -> None:
        """End a sequence: the line is free for others; what of it was not sent ends as HoldEnded."""
        if not hold.over:
            self.dispatcher.end_hold(now, hold)
        if self.state is READY:
            self._advance(now)

    def submit(self, transaction: Transaction, now: float) -> bool:
        """Queue a transaction, or end it at once.

        Returns False if it waits and nothing else has changed: then there is nothing to pump.
        """
        changed = self.dispatcher.submit(transaction, now)
        if self.state is READY:
            self._advance(now)
            return True
        return changed

    def cancel(self, transaction: Transaction, now: float) -> None:
        """Cancel a transaction, synchronously and without ever touching the line (R6)."""
        self.dispatcher.cancel(transaction, now)

    def supersede_writes(self, now: float) -> None:
        """End whatever waits to be written as Superseded: the line is taken to its safe state."""
        self.dispatcher.supersede_writes(now)

    def add_poll(self, poll: Poll, now: float) -> None:
        """Run a poll from now on; its first cycle waits until a line that has just been opened can be used."""
        self.dispatcher.add_poll(poll, max(now, self._quarantine))

    def remove_poll(self, poll: Poll, now: float) -> None:
        """End a poll: what it has queued is never sent, and what it has on the wire goes unheard."""
        self.dispatcher.remove_poll(poll, now)

    def demand(self, poll: Poll, now: float) -> None:
        """Run one cycle of a poll now, off the grid."""
        self.dispatcher.demand(poll, now)
        if self.state is READY:
            self._advance(now)

    def close(self, now: float) -> None:
        """Fail whatever waits with BusClosed. The exchange on the wire runs out; then the line is OFFLINE.

        `failing` says whether some of it has not ended yet.
        """
        if self._closed:
            return
        self._closed = True
        self.dispatcher.fault = lambda: BusClosed("the bus was closed")
        for poll in list(self.dispatcher.schedule.polls):
            self.dispatcher.remove_poll(poll, now)
        self.dispatcher.fail_all(now)
        if self.state is not EXCHANGE:
            self._go_offline(now)

    @property
    def failing(self) -> bool:
        """Whether some of what failed with the line has not ended yet: further calls of `handle_timeout` end it."""
        return len(self.dispatcher.failing) > 0

    # outputs, pumped in this order

    def poll_transmit(self) -> bytes | None:
        """Return the bytes that are to be sent now, which are handed over once, or None."""
        output = self._wire.output
        data = output.waiting
        if not data:
            return None
        output.waiting = b""
        return data

    @property
    def said_until(self) -> float:
        """When all that was said is on the wire, in seconds on the caller's clock, if the port holds none of it."""
        return self._leg.out

    def poll_event(self) -> Event | None:
        """Take out the next event, in the order of `events`, or return None."""
        if self.dispatcher.unnoted is not None:
            self.dispatcher.note_success()  # only now: the next request has left
        return self.events.popleft() if self.events else None

    def poll_timeout(self) -> float:
        """Return when `handle_timeout` is to be called, in seconds on the caller's clock; inf if nothing is due."""
        # It is asked after every byte that comes. A call of `min` takes more than twice as long.
        line, other = self._deadlines.line, self._deadlines.earliest_other
        return line if line < other else other

    def reset_statistics(self, now: float) -> None:
        """Begin the counts of the line and of its nodes anew."""
        self._counters.reset(self.state, now)
        for node in self.dispatcher.nodes:
            node.counters.reset()

    def statistics(self, now: float) -> LineStatistics:
        """Return an immutable snapshot of the line's counts since the last reset; its times are in seconds."""
        return self._counters.snapshot(self.state, now, len(self.dispatcher.backlog))
