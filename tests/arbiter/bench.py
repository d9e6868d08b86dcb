"""A bench for the arbiter: hex in, hex out, and a clock that the test turns."""

from __future__ import annotations

from math import inf
from typing import Any

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.events import Completed, Event, Polled
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.schedule import Poll, set_members
from busmaster.arbiter.transaction import Priority, Transaction
from busmaster.exchange import Command, Timings
from busmaster.profile import Profile
from busmaster.protocols.hcp2 import codec as hcp2

TAU = 10 / 57600
READ_1_OF_NODE_1 = "07 30 31 02 30 31 05 07"
"""HCP2 read of node 1 element 1 (AN00129)."""
FIVE = "02 30 31 35 03 37"
"""Its reply, 5."""
SEVEN = "02 30 31 37 03 35"
ANOTHER_ELEMENT = "02 30 32 35 03 34"
"""A whole reply of element 2."""
BAD_CHECKSUM = "02 30 31 35 03 36"
WRITE_5 = "07 30 31 02 30 31 35 03 34"
ACK = "06"
NAK = "15"


class Bench:
    """One arbiter with its line up and nothing left from before."""

    def __init__(self, *, echo: bool = False, paced: bool = False, latency: float = 0.0, capacity: int = 1000) -> None:
        self.arbiter = Arbiter(TAU, echo=echo, receive_latency=latency, capacity=capacity)
        self.now = 0.0
        self.events: list[Event] = []
        self.cycles: list[Poll] = []
        self.arbiter.line_up(0.0, paced=paced)
        self.to(1.0)
        self.events.clear()

    def node(self, address: int = 1, profile: Profile = hcp2.PROFILE, timings: Timings | None = None) -> NodeRecord:
        return self.arbiter.add_node(profile, address, self.now, timings)

    def ask(self, node: NodeRecord, command: Command[Any] | None = None, **how: Any) -> Transaction:
        transaction = Transaction(node, hcp2.Read(1) if command is None else command, **how)
        self.arbiter.submit(transaction, self.now)
        self.listen()
        return transaction

    def poll(self, node: NodeRecord, period: float, *elements: int) -> Poll:
        poll = Poll("group", period, phase=0.0)
        set_members(poll, [Transaction(node, hcp2.Read(e)) for e in elements], Priority.POLL)
        self.arbiter.add_poll(poll, self.now)
        return poll

    def sent(self) -> str:
        """What has gone out since the last look, as hex; empty when nothing has."""
        data = self.arbiter.poll_transmit()
        return "" if data is None else data.hex(" ").upper()

    def hear(self, data: str, after: float = 0.0) -> None:
        self.to(self.now + after)
        self.arbiter.data_received(bytes.fromhex(data), self.now)
        self.listen()

    def to(self, time: float) -> None:
        """Turn the clock, stopping at every deadline on the way."""
        while (due := self.arbiter.poll_timeout()) <= time:
            self.now = max(self.now, due)
            self.arbiter.handle_timeout(self.now)
            self.listen()
        self.now = max(self.now, time)

    def wait(self, seconds: float) -> None:
        self.to(self.now + seconds)

    def until_sent(self, limit: float = 10.0) -> float:
        """Turn the clock until something goes out; returns how long that took."""
        start = self.now
        while not self.arbiter._out:
            due = self.arbiter.poll_timeout()
            assert due < inf, "nothing will ever be sent"
            assert due - start < limit, "nothing was sent in time"
            self.to(due)
        return self.now - start

    def listen(self) -> None:
        while (event := self.arbiter.poll_event()) is not None:
            self.events.append(event)
            if isinstance(event, Polled):
                self.cycles.append(event.poll)

    def ended(self, transaction: Transaction) -> int:
        """How often it was reported as completed."""
        return sum(isinstance(e, Completed) and e.transaction is transaction for e in self.events)
