"""20,000 requests, half of them cancelled at random moments, over replies as late as R3 allows."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import count

import pytest

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.counters import LineState
from busmaster.arbiter.transaction import Transaction
from busmaster.errors import BusError
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.wire.checks import xor
from tests.arbiter.bench import TAU

REQUESTS = 20_000
NODES = 8
LONGEST_DELAY = 0.145
LOST, GARBLED = 0.1, 0.05


@dataclass
class Slave:
    """Answers each read with a number that nobody else ever gets, and notes for which request it was."""

    chance: random.Random
    answers: dict[int, tuple[int, int, float]] = field(default_factory=dict)
    numbers: Callable[[], int] = count(1).__next__

    def reply(self, request: bytes, now: float) -> tuple[float, bytes] | None:
        """(delay after the request's last byte, bytes), or None where it is lost."""
        node, element = int(request[1:3], 16), int(request[4:6], 16)
        number = self.numbers()
        self.answers[number] = (node, element, now)
        body = f"{element:02X}{number}".encode() + b"\x03"
        frame = b"\x02" + body + bytes([xor(body)])
        luck = self.chance.random()
        if luck < LOST:
            return None
        if luck < LOST + GARBLED:
            frame = self.damage(frame)
        return self.chance.uniform(0, LONGEST_DELAY), frame

    def damage(self, frame: bytes) -> bytes:
        at = self.chance.randrange(1, len(frame))
        if self.chance.random() < 0.5:
            return frame[:at]
        return frame[:at] + bytes([frame[at] ^ 1 << self.chance.randrange(8)]) + frame[at + 1 :]


@dataclass
class Campaign:
    """Virtual time: what happens next, in order."""

    seed: int
    now: float = 0.0
    asked: dict[int, Transaction] = field(default_factory=dict)
    completed: dict[int, int] = field(default_factory=dict)
    cancelled: set[int] = field(default_factory=set)

    def run(self) -> None:
        chance = random.Random(self.seed)
        arbiter = Arbiter(TAU, capacity=REQUESTS)
        slave = Slave(chance)
        arbiter.line_up(0.0)
        nodes = [arbiter.add_node(hcp2.PROFILE, address, 0.0) for address in range(1, NODES + 1)]
        happenings: list[tuple[float, int, Callable[[], None]]] = []
        order = count()

        def at(time: float, action: Callable[[], None]) -> None:
            heapq.heappush(happenings, (time, next(order), action))

        def ask(number: int) -> None:
            element = chance.randrange(1, 100)
            transaction = Transaction(chance.choice(nodes), hcp2.Read(element), tag=number)
            self.asked[number] = transaction
            arbiter.submit(transaction, self.now)
            if chance.random() < 0.5:
                at(self.now + chance.expovariate(8), partial(cancel, number))

        def cancel(number: int) -> None:
            if number not in self.completed:
                self.cancelled.add(number)
                arbiter.cancel(self.asked[number], self.now)

        def deliver(data: bytes) -> None:
            arbiter.data_received(data, self.now)

        start = 0.0
        for number in range(REQUESTS):
            start += chance.expovariate(8)
            at(start, partial(ask, number))
        while happenings or arbiter.state is not LineState.READY or arbiter.dispatcher.backlog:
            due = arbiter.poll_timeout()
            if happenings and happenings[0][0] <= due:
                self.now, _, action = heapq.heappop(happenings)
                action()
            else:
                self.now = max(self.now, due)
                arbiter.handle_timeout(self.now)
            if (request := arbiter.poll_transmit()) is not None:
                answer = slave.reply(request, self.now)
                if answer is not None:
                    delay, frame = answer
                    end = self.now + len(request) * TAU + delay + len(frame) * TAU
                    at(end, partial(deliver, frame))
            while (event := arbiter.poll_event()) is not None:
                if isinstance(event, Transaction) and event.tag is not None:
                    self.check(event, slave)

    def check(self, transaction: Transaction, slave: Slave) -> None:
        number = transaction.tag
        self.completed[number] = self.completed.get(number, 0) + 1
        if transaction.error is not None:
            assert isinstance(transaction.error, BusError)
            return
        assert isinstance(transaction.command, hcp2.Read)
        asked = (transaction.node.address, transaction.command.element, transaction.started)
        assert slave.answers[int(transaction.value)] == asked


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_r3_r6_r8_every_value_is_the_right_one_and_every_transaction_ends_once(seed: int) -> None:
    campaign = Campaign(seed)
    campaign.run()
    assert set(campaign.completed) | campaign.cancelled == set(range(REQUESTS))
    assert not set(campaign.completed) & campaign.cancelled
    assert set(campaign.completed.values()) == {1}
    assert len(campaign.cancelled) > REQUESTS / 4
