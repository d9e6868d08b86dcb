"""Submit, cancel, advance, deliver, garble, lose the port, close: in any order, the promises hold (R1, R3, R6, R8)."""

from __future__ import annotations

from collections import Counter

import hypothesis.strategies as st
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.events import Completed, LineState
from busmaster.arbiter.transaction import Phase, Priority, Transaction
from busmaster.errors import BusError
from busmaster.protocols import hcp2
from busmaster.wire.checks import xor
from tests.arbiter.bench import TAU

LATENESS = 0.150


def reply(element: int, value: int) -> bytes:
    body = f"{element:02X}{value}".encode() + b"\x03"
    return b"\x02" + body + bytes([xor(body)])


class AnyOrder(RuleBasedStateMachine):
    """The test plays owner and node; `asked` is the request on the wire that may still be answered."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.arbiter = Arbiter(TAU, capacity=20)
        self.nodes = [self.arbiter.add_node(hcp2.PROFILE, address, 0.0) for address in (1, 2)]
        self.submitted: list[Transaction] = []
        self.cancelled: set[int] = set()
        self.ended: Counter[int] = Counter()
        self.asked: bytes | None = None
        self.asked_until = -1.0
        self.right: dict[int, int] = {}
        self.value = 0
        self.closed = False

    @initialize()
    def open_the_port(self) -> None:
        self.arbiter.line_up(self.now)
        self.pump()

    @rule(node=st.integers(0, 1), element=st.integers(1, 99), priority=st.sampled_from(Priority))
    def read(self, node: int, element: int, priority: Priority) -> None:
        self.submit(Transaction(self.nodes[node], hcp2.Read(element), priority=priority))

    @rule(node=st.integers(0, 1), repeat=st.booleans(), priority=st.sampled_from(Priority))
    def write(self, node: int, repeat: bool, priority: Priority) -> None:
        self.submit(Transaction(self.nodes[node], hcp2.Write(1, (5,), idempotent=repeat), priority=priority))

    @rule(wait=st.floats(0.001, 0.2))
    def read_soon_or_never(self, wait: float) -> None:
        self.submit(Transaction(self.nodes[0], hcp2.Read(1), start_by=self.now + wait))

    @precondition(lambda self: self.submitted)
    @rule(which=st.integers(0, 10**6))
    def cancel(self, which: int) -> None:
        transaction = self.submitted[which % len(self.submitted)]
        if not self.ended[id(transaction)]:
            self.cancelled.add(id(transaction))
        self.arbiter.cancel(transaction, self.now)
        self.pump()

    @rule(seconds=st.floats(0.0001, 0.3))
    def advance(self, seconds: float) -> None:
        end = self.now + seconds
        while (due := self.arbiter.poll_timeout()) <= end:
            self.now = max(self.now, due)
            self.arbiter.handle_timeout(self.now)
            self.pump()
        self.now = end

    @precondition(lambda self: self.asked is not None and self.now < self.asked_until)
    @rule()
    def answer(self) -> None:
        """The node's one reply, right and whole; it may be a straggler."""
        assert self.asked is not None
        request, self.asked = self.asked, None
        if request[6] == 0x05:
            self.value += 1
            self.deliver(reply(int(request[4:6], 16), self.value))
        else:
            self.deliver(b"\x06")

    @precondition(lambda self: self.asked is not None and self.now < self.asked_until)
    @rule(cut=st.integers(1, 6))
    def answer_cut_short(self, cut: int) -> None:
        self.asked = None
        self.deliver(reply(1, 12345)[:cut])

    @rule(noise=st.binary(min_size=1, max_size=4).filter(lambda b: not set(b) & {0x06, 0x15}))
    def garble(self, noise: bytes) -> None:
        self.deliver(noise)

    @rule()
    def lose_the_port_and_find_it_again(self) -> None:
        self.arbiter.line_down("unplugged", self.now)
        self.pump()
        self.arbiter.line_up(self.now)
        self.pump()

    @precondition(lambda self: len(self.submitted) > 8)
    @rule()
    def close(self) -> None:
        self.closed = True
        self.arbiter.close(self.now)
        self.pump()

    def submit(self, transaction: Transaction) -> None:
        self.submitted.append(transaction)
        self.arbiter.submit(transaction, self.now)
        self.pump()

    def deliver(self, data: bytes) -> None:
        self.arbiter.data_received(data, self.now)
        self.pump()

    def pump(self) -> None:
        data = self.arbiter.poll_transmit()
        if data is not None:
            assert self.asked is None or self.now >= self.asked_until, "R3: a reply could still have come"
            assert self.arbiter.state is LineState.EXCHANGE
            self.asked = data
            self.asked_until = self.now + len(data) * TAU + LATENESS
        while (event := self.arbiter.poll_event()) is not None:
            if isinstance(event, Completed) and not event.transaction.probe:
                self.check(event.transaction)

    def check(self, transaction: Transaction) -> None:
        self.ended[id(transaction)] += 1
        assert id(transaction) not in self.cancelled, "R6: its caller has gone"
        if transaction.error is not None:
            assert isinstance(transaction.error, BusError)
            assert str(transaction.error).startswith("node ")
        elif not transaction.writes:
            assert transaction.value == self.value, "the value of an earlier request"

    @invariant()
    def each_transaction_ends_at_most_once(self) -> None:
        assert all(n == 1 for n in self.ended.values())

    @invariant()
    def nothing_waits_while_the_line_is_free(self) -> None:
        if self.arbiter.state is LineState.READY:
            assert not len(self.arbiter.dispatcher.backlog)

    def teardown(self) -> None:
        self.arbiter.close(self.now)
        self.pump()
        self.advance(1.0)
        for transaction in self.submitted:
            assert transaction.phase is Phase.ENDED
            assert self.ended[id(transaction)] == (id(transaction) not in self.cancelled)
        assert not any(node.writes for node in self.nodes)


TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
