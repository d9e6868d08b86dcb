"""A bench for the arbiter: hex in, hex out, and a clock that the test turns."""

from __future__ import annotations

from math import inf
from typing import Any

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.counters import LineState
from busmaster.arbiter.events import Event, Polled
from busmaster.arbiter.health import Health, NodeRecord
from busmaster.arbiter.schedule import set_members
from busmaster.arbiter.transaction import Poll, Priority, Transaction
from busmaster.contract.exchange import Command
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.wire.checks import xor
from busmaster.wire.readers import ENQ

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
QUIET = 0.020 + TAU
"""The silence that ends a resynchronisation: of HCP2's inter-byte timeout, and one byte time."""
MAX_REPLY_DELAY = 0.150 + TAU
"""From the end of an HCP2 request until no reply to it can be heard any more."""


def request_of(element: int, node: int = 1) -> str:
    """HCP2: the request for an element, as hex."""
    body = b"%02X\x02%02X\x05" % (node, element)
    return (b"\x07" + body + bytes((xor(body),))).hex(" ").upper()


def reply_of(element: int, value: int) -> str:
    """HCP2: the reply with that element's value, as hex."""
    body = b"%02X%d\x03" % (element, value)
    return (b"\x02" + body + bytes((xor(body),))).hex(" ").upper()


def right_answer(request: str, value: int = 5) -> str:
    """What an HCP2 node answers to that request, of whatever element it is: a number, or an ACK to a write."""
    asked = bytes.fromhex(request)
    return reply_of(int(asked[4:6], 16), value) if asked[-2] == ENQ[0] else ACK


class Bench:
    """One arbiter with its line up and nothing left from before."""

    def __init__(
        self,
        *,
        echo: bool = False,
        paced: bool = False,
        latency: float = 0.0,
        capacity: int = 1000,
        strict: bool = False,
        tapped: bool = False,
        fresh: bool = False,
    ) -> None:
        """If `fresh`, no frame was sent yet since the line came up: a node may hold a part of an earlier one."""
        self.arbiter = Arbiter(TAU, echo=echo, receive_latency=latency, capacity=capacity, strict=strict)
        if tapped:
            self.arbiter.set_tapped(True)
        self.unsent: int | None = None
        """How many bytes the port has not sent yet, for ports that can tell."""
        self.held = False
        """It was told so: the port is asked again before it is heard."""
        self.now = 0.0
        self.events: list[Event] = []
        self.cycles: list[Poll] = []
        self.asked = ""
        self.sync_reads = 0
        self._out = b""
        self.arbiter.line_up(0.0, paced=paced)
        if not fresh:
            self.arbiter._in_sync.lone_bytes_until = -inf
        self.to(1.0)
        self.events.clear()

    def node(self, address: int = 1, profile: Profile = hcp2.PROFILE, timings: Timings | None = None) -> NodeRecord:
        return self.arbiter.add_node(profile, address, self.now, timings)

    def ask(self, node: NodeRecord, command: Command[Any] | None = None, **how: Any) -> Transaction:
        transaction = Transaction(node, hcp2.Read(1) if command is None else command, **how)
        self.arbiter.submit(transaction, self.now)
        self.listen()
        return transaction

    def submit(self, transaction: Transaction) -> Transaction:
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
        data, self._out = self._out + (self.arbiter.poll_transmit() or b""), b""
        if not data:
            return ""
        self.asked = data.hex(" ").upper()
        return self.asked

    def hear(self, data: str, after: float = 0.0) -> None:
        self.to(self.now + after)
        if self.held:
            self._tell_unsent()
        self.arbiter.data_received(bytes.fromhex(data), self.now)
        self.listen()

    def hear_bytewise(self, data: str, after: float = 0.0) -> None:
        """As `hear`, each byte by itself, a byte time after the one before."""
        self.wait(after)
        for byte in data.split():
            self.hear(byte, after=TAU)

    def answer(self, value: int = 5, after: float = 0.004) -> str:
        """The node answers what was sent last, of whatever element it is. Returns what that was."""
        asked = self.sent() or self.asked
        self.hear(right_answer(asked, value), after)
        return asked

    def checked(self) -> str:
        """The line proves first that it is in sync (R15): a check goes out, and is answered. Returns the check."""
        self.until_sent()
        self.sync_reads += 1
        assert self.arbiter.statistics(self.now).sync_reads == self.sync_reads, f"not a check: {self.sent()}"
        return self.answer(99)

    def served(self, transaction: Transaction, after: float = 0.004) -> Transaction:
        """The node answers whatever is asked until this has ended."""
        while not self.ended(transaction):
            self.until_sent()
            self.answer(after=after)
        return transaction

    def to(self, time: float) -> None:
        """Turn the clock, stopping at every deadline on the way."""
        while (due := self.arbiter.poll_timeout()) <= time:
            self.now = max(self.now, due)
            if self.arbiter.line_due(self.now):
                self._tell_unsent()
            self.arbiter.handle_timeout(self.now)
            self.listen()
        self.now = max(self.now, time)

    def wait(self, seconds: float) -> None:
        self.to(self.now + seconds)

    def until_sent(self, limit: float = 10.0) -> float:
        """Turn the clock until something goes out; returns how long that took."""
        start = self.now
        while not self._is_sent():
            due = self.arbiter.poll_timeout()
            assert due < inf, "nothing will ever be sent"
            assert due - start < limit, "nothing was sent in time"
            self.to(due)
        return self.now - start

    def _tell_unsent(self) -> None:
        if self.unsent is not None:
            self.arbiter.unsent(self.unsent, self.now)
            self.held = self.unsent > 0

    def until_ready(self, limit: float = 10.0) -> None:
        """Turn the clock until the line has nothing to do."""
        start = self.now
        while self.arbiter.state is not LineState.READY:
            assert self.arbiter.poll_timeout() - start < limit, "the line is never free"
            self.to(self.arbiter.poll_timeout())

    def _is_sent(self) -> bool:
        self._out += self.arbiter.poll_transmit() or b""
        return bool(self._out)

    def listen(self) -> None:
        while (event := self.arbiter.poll_event()) is not None:
            self.events.append(event)
            if isinstance(event, Polled):
                self.cycles.append(event.poll)

    def ended(self, transaction: Transaction) -> int:
        """How often it was reported as completed."""
        return sum(e is transaction for e in self.events)


def heard(bench: Bench) -> NodeRecord:
    """A node that is UP."""
    record = bench.node()
    bench.ask(record)
    bench.sent()
    bench.hear(FIVE, after=0.004)
    return record


def dead(bench: Bench) -> NodeRecord:
    """A node that was never heard, and did not answer."""
    record = bench.node()
    bench.ask(record, retries=0)
    bench.wait(0.2)
    bench.sent()
    assert record.health is Health.DOWN
    return record


def up(bench: Bench, address: int = 1) -> NodeRecord:
    """A node that is UP: it has answered a read of element 1 after 4 ms."""
    record = bench.node(address)
    bench.served(bench.ask(record), after=8 * TAU + 0.004)
    bench.until_ready()
    assert record.health is Health.UP
    return record


def lost(bench: Bench, record: NodeRecord, command: Command[Any] | None = None) -> Transaction:
    """What was asked of it, once, and not answered, on a line that has resynchronised since: its reply is overdue
    (R15)."""
    asked = bench.ask(record, command, retries=0)
    bench.until_sent()
    bench.sent()
    bench.until_ready()
    assert asked.error is not None
    return asked
