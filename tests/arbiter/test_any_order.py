"""Submit, poll, cancel, advance, deliver, garble, lose the port, close: in any order, the promises hold.

R1, R3, R6, R8, R10, R11; with and without an echo.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import ClassVar

import hypothesis.strategies as st
import pytest
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from busmaster.arbiter import dispatcher
from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.counters import LineState
from busmaster.arbiter.events import NodeChanged, Polled
from busmaster.arbiter.health import DOWN_AFTER_FAILURES, Health
from busmaster.arbiter.schedule import set_members
from busmaster.arbiter.transaction import Phase, Poll, Priority, Transaction
from busmaster.errors import BusError
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.wire.checks import xor
from tests.arbiter.bench import TAU

MAX_REPLY_DELAY = 0.150
ROUNDING = 1e-9
MOST_STEPS = 1000
"""Of one `advance`."""


@pytest.fixture(scope="module", autouse=True)
def few_fail_at_once() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dispatcher, "AT_ONCE", 2)
        yield


def reply(element: int, value: int) -> bytes:
    body = f"{element:02X}{value}".encode() + b"\x03"
    return b"\x02" + body + bytes([xor(body)])


class AnyOrder(RuleBasedStateMachine):
    """The test plays owner and nodes; `asked` is the request on the wire that may still be answered."""

    echo: ClassVar[bool] = False

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.arbiter = Arbiter(TAU, capacity=20, echo=self.echo)
        self.nodes = [self.arbiter.add_node(hcp2.PROFILE, address, 0.0) for address in (1, 2, 3)]
        self.submitted: list[Transaction] = []
        self.polls: list[Poll] = []
        self.cancelled: set[int] = set()
        self.ended: Counter[int] = Counter()
        self.cycles: Counter[str] = Counter()
        self.asked: bytes | None = None
        self.asked_at = self.asked_until = -1.0
        self.answers: dict[int, tuple[int, int, float]] = {}
        """Who was asked for what, and when, of each value: they are used once."""
        self.spoil_echo = False
        self.lost: list[tuple[Transaction, int]] = []
        """What waited or was on the wire when the port was lost, and how often it had been sent."""

    @initialize()
    def open_the_port(self) -> None:
        self.arbiter.line_up(self.now)
        self.pump()

    # the owner

    @rule(node=st.integers(0, 2), element=st.integers(1, 9), priority=st.sampled_from(Priority))
    def read(self, node: int, element: int, priority: Priority) -> None:
        self.submit(Transaction(self.nodes[node], hcp2.Read(element), priority=priority))

    @rule(node=st.integers(0, 2), repeat=st.booleans(), priority=st.sampled_from(Priority))
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

    @precondition(lambda self: len(self.polls) < 4)
    @rule(period=st.sampled_from([0.05, 0.2, 1.0]), reads=st.lists(st.tuples(st.integers(0, 2), st.integers(1, 9))))
    def add_poll(self, period: float, reads: list[tuple[int, int]]) -> None:
        poll = Poll(f"group {len(self.polls)}", period)
        members = reads or [(0, 1), (1, 1), (2, 1)]
        set_members(poll, [Transaction(self.nodes[node], hcp2.Read(element)) for node, element in members])
        self.polls.append(poll)
        self.arbiter.add_poll(poll, self.now)
        self.pump()

    @precondition(lambda self: self.polls)
    @rule(which=st.integers(0, 3))
    def demand_a_poll(self, which: int) -> None:
        self.arbiter.demand(self.polls[which % len(self.polls)], self.now)
        self.pump()

    @precondition(lambda self: self.polls)
    @rule(which=st.integers(0, 3))
    def remove_a_poll(self, which: int) -> None:
        self.arbiter.remove_poll(self.polls[which % len(self.polls)], self.now)
        self.pump()

    @rule(seconds=st.floats(0.0001, 0.3))
    def advance(self, seconds: float) -> None:
        end = self.now + seconds
        for _ in range(MOST_STEPS):
            if (due := self.arbiter.poll_timeout()) > end:
                break
            self.now = max(self.now, due)
            self.arbiter.handle_timeout(self.now)
            self.pump()
        else:
            raise AssertionError("it asks to be called again and again")
        self.now = max(self.now, end)

    @rule()
    def nobody_answers_for_long(self) -> None:
        """Whoever is asked goes down, and is probed."""
        self.advance(3.0)

    @rule()
    def lose_the_port_and_find_it_again(self) -> None:
        self.arbiter.line_down("unplugged", self.now)
        self.pump()
        self.advance(0.0)
        assert all(t.phase is Phase.ENDED for t in self.submitted), "R13"
        self.arbiter.line_up(self.now)
        self.pump()

    @rule()
    def find_the_port_again_before_all_that_waited_has_failed(self) -> None:
        """The others fail on a line that is up; meanwhile they may be cancelled, or the bus closed."""
        before = [t for t in self.submitted if t.phase is not Phase.ENDED]
        sent = [t.attempts for t in before]
        self.arbiter.line_down("unplugged", self.now)
        self.arbiter.line_up(self.now)
        self.lost += zip(before, sent, strict=True)
        self.pump()

    @precondition(lambda self: len(self.submitted) > 8)
    @rule()
    def close(self) -> None:
        self.arbiter.close(self.now)
        self.pump()

    # the nodes, and the line

    @precondition(lambda self: self.asked is not None and self.now < self.asked_until)
    @rule()
    def answer(self) -> None:
        """The node's one reply, right and whole; it may be an overdue reply."""
        assert self.asked is not None
        request, self.asked = self.asked, None
        if request[6] == 0x05:
            element, value = int(request[4:6], 16), len(self.answers) + 1
            self.answers[value] = (int(request[1:3], 16), element, self.asked_at)
            self.deliver(reply(element, value))
        else:
            self.deliver(b"\x06")

    @rule(times=st.integers(2, 12))
    def answer_at_once_for_a_while(self, times: int) -> None:
        """A healthy line: else no node would ever stay up."""
        for _ in range(times):
            if self.asked is not None and self.now < self.asked_until:
                self.advance(0.002)
                if self.asked is not None:
                    self.answer()
            else:
                self.advance(0.05)

    @precondition(lambda self: self.asked is not None and self.now < self.asked_until)
    @rule(cut=st.integers(1, 6))
    def answer_cut_short(self, cut: int) -> None:
        self.asked = None
        self.deliver(reply(1, 12345)[:cut])

    @rule(noise=st.binary(min_size=1, max_size=4).filter(lambda b: not set(b) & {0x06, 0x15}))
    def garble(self, noise: bytes) -> None:
        self.deliver(noise)

    @precondition(lambda self: self.echo)
    @rule()
    def the_next_echo_is_damaged(self) -> None:
        self.spoil_echo = True

    # what comes of it

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
            assert self.asked is None or self.now >= self.asked_until - ROUNDING, "R3: a reply could still have come"
            assert self.arbiter.state is LineState.EXCHANGE
            self.asked = data
            self.asked_at = self.now
            self.asked_until = self.now + len(data) * TAU + MAX_REPLY_DELAY + TAU
        while (event := self.arbiter.poll_event()) is not None:
            match event:
                case Transaction() as transaction:
                    self.check(transaction)
                case Polled(poll):
                    self.check_cycle(poll)
                case NodeChanged(node, Health.UP | Health.SUSPECT, Health.DOWN):
                    assert node.failures >= DOWN_AFTER_FAILURES, "R11"
        if data is not None and self.echo:
            self.hear_the_echo(data)

    def hear_the_echo(self, data: bytes) -> None:
        self.now += len(data) * TAU
        spoilt, self.spoil_echo = self.spoil_echo, False
        self.deliver(bytes([data[0] ^ 1]) + data[1:] if spoilt else data)

    def check(self, transaction: Transaction) -> None:
        if not transaction.probe:
            self.ended[id(transaction)] += 1
            assert id(transaction) not in self.cancelled, "R6: its caller has gone"
        self.check_outcome(transaction)

    def check_outcome(self, transaction: Transaction) -> None:
        assert transaction.phase is Phase.ENDED
        if transaction.error is not None:
            assert isinstance(transaction.error, BusError)
            assert str(transaction.error).startswith("node ")
        elif not transaction.writes:
            assert isinstance(transaction.command, hcp2.Read)
            mine = (transaction.node.address, transaction.command.element, transaction.started)
            assert self.answers[int(transaction.value)] == mine, "the value of another request"

    def check_cycle(self, poll: Poll) -> None:
        self.cycles[poll.name] += 1
        assert self.cycles[poll.name] <= poll.cycles, "R10: a cycle was reported twice"
        for transaction in poll.results:
            self.check_outcome(transaction)

    @invariant()
    def each_transaction_ends_at_most_once(self) -> None:
        assert all(n == 1 for n in self.ended.values())

    @invariant()
    def what_was_lost_with_the_port_is_not_sent_again(self) -> None:
        assert all(transaction.attempts == sent for transaction, sent in self.lost), "R13"

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
        assert not any(self.arbiter.dispatcher.writes.queues.values())
        assert self.arbiter.state is LineState.OFFLINE


class AnyOrderWithEcho(AnyOrder):
    """The port hears what it says, as it leaves."""

    echo = True


TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
TestAnyOrderWithEcho = AnyOrderWithEcho.TestCase
TestAnyOrderWithEcho.settings = settings(max_examples=40, stateful_step_count=40, deadline=None)
