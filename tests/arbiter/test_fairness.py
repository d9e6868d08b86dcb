"""Who goes next, whatever is asked in whatever order: R7's order of writes and R9's bounds, at the dispatcher."""

from __future__ import annotations

from math import ceil
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from busmaster.arbiter.backlog import SHARE
from busmaster.arbiter.counters import LineCounters
from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.dispatcher import Dispatcher
from busmaster.arbiter.health import Health, NodeRecord
from busmaster.arbiter.transaction import Phase, Priority, Transaction
from busmaster.contract.exchange import no_reply
from busmaster.errors import BacklogFull, BusError, Superseded, WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2

URGENT, COMMAND, POLL, BACKGROUND = Priority
NODES = 2


class Desk:
    """A dispatcher, and a line on which every exchange takes a second and ends as the test says."""

    def __init__(self, capacity: int = 1000) -> None:
        self.now = 0.0
        self.counters = LineCounters(0.0)
        self.dispatcher = Dispatcher(Deadlines(), self.counters, 0.0, capacity, lambda: 0.5)
        self.nodes = [NodeRecord(hcp2.PROFILE, n + 1, hcp2.PROFILE.timings, 2) for n in range(NODES)]
        for node in self.nodes:
            node.health = Health.UP
        self.dispatcher.nodes = self.nodes
        self.on_wire: Transaction | None = None
        self.log: list[Transaction] = []
        """Every attempt, in order."""

    def submit(self, priority: Priority = COMMAND, node: int = 0, **how: Any) -> Transaction:
        write, repeat = how.pop("write", False), how.pop("repeat", False)
        command = hcp2.Write(1, (5,), idempotent=repeat) if write else hcp2.Read(1)
        transaction = Transaction(self.nodes[node], command, priority=priority, **how)
        self.dispatcher.submit(transaction, self.now)
        self.start()
        return transaction

    def start(self) -> None:
        if self.on_wire is None:
            self.on_wire = self.dispatcher.next(self.now)
            if self.on_wire is not None:
                self.dispatcher.started(self.on_wire, self.now)
                self.log.append(self.on_wire)

    def finish(self, ok: bool = True) -> None:
        transaction, self.on_wire = self.on_wire, None
        self.now += 1.0
        if transaction is not None:
            self.counters.exchanges += 1
            if ok:
                self.dispatcher.succeeded(transaction, 5.0, self.now)
            else:
                self.dispatcher.attempt_failed(transaction, True, no_reply(), self.now, ambiguous=False)
                transaction.node.health = Health.UP
                transaction.node.failures = 0
        self.start()
        self.dispatcher.note_success()

    def run_out(self) -> None:
        while self.on_wire is not None:
            self.finish()


PRIORITIES = st.sampled_from(Priority)
ASKED = st.tuples(st.just("ask"), PRIORITIES, st.integers(0, NODES - 1), st.booleans(), st.booleans())
DONE = st.tuples(st.just("done"), st.booleans())
CANCEL = st.tuples(st.just("cancel"), st.integers(0, 1000))
STORY = st.lists(st.one_of(ASKED, DONE, CANCEL), max_size=60)


@pytest.mark.slow
@given(STORY)
@settings(max_examples=150)
def test_r7_writes_to_one_node_never_overtake_each_other_in_any_story(story: list[tuple[Any, ...]]) -> None:
    """Nor does any that an urgent write overtook follow it; and everything ends, once."""
    desk = Desk()
    asked: list[Transaction] = []
    overtaken: list[tuple[Transaction, Transaction]] = []

    def check() -> None:
        current = desk.on_wire
        if current is None or not current.writes:
            return
        rivals = [t for t in asked if t.writes and t.node is current.node and t is not current]
        earlier = rivals[: sum(asked.index(t) < asked.index(current) for t in rivals)] if current in asked else rivals
        assert all(t.phase is Phase.ENDED for t in earlier), "R7: a write overtook an earlier one"
        assert not any(old is current for old, _ in overtaken), "R7: an overtaken write was sent"

    for step in story:
        if step[0] == "ask":
            _, priority, node, write, repeat = step
            waiting = [t for t in asked if t.writes and t.phase in (Phase.QUEUED, Phase.PARKED)]
            transaction = desk.submit(priority, node, write=write, repeat=repeat)
            asked.append(transaction)
            if write and priority is URGENT:
                same = [t for t in waiting if t.node is transaction.node and t.priority is not URGENT]
                overtaken += [(t, transaction) for t in same]
        elif step[0] == "done":
            desk.finish(step[1])
        elif asked:
            desk.dispatcher.cancel(asked[step[1] % len(asked)], desk.now)
        check()
    while desk.on_wire is not None:
        desk.finish()
        check()
    assert all(t.phase is Phase.ENDED for t in asked), "R8"
    for old, _ in overtaken:
        assert not old.wanted or type(old.error) is (WriteUnconfirmed if old.attempts else Superseded), "R7"
    assert not any(desk.dispatcher.writes.queues.values())
    assert len(desk.dispatcher.backlog) == 0


@given(STORY)
@settings(max_examples=150)
def test_r9_no_read_waits_longer_than_its_bound_in_any_story(story: list[tuple[Any, ...]]) -> None:
    """Counted in exchanges: the one on the wire, those ahead in its class, and a slot in eight of the lower ones."""
    desk = Desk()
    bounds: dict[Transaction, int] = {}
    for step in [*story, *[("done", True)] * 80]:
        if step[0] == "ask":
            _, priority, node, _, _ = step
            if priority > COMMAND:
                desk.submit(priority, node)
                continue
            ahead = desk.dispatcher.backlog.waiting(priority)
            bound = 1 + ahead + (ceil((ahead + 1) / 7) if priority is COMMAND else 0)
            bounds[desk.submit(priority, node)] = bound
        elif step[0] == "done":
            desk.finish(step[1])
    urgent = sum(t.priority is URGENT for t in bounds)
    for transaction, bound in bounds.items():
        late = urgent if transaction.priority is COMMAND else 0
        assert transaction.timeline().exchanges_ahead <= bound + late + retries(desk, transaction)


def retries(desk: Desk, transaction: Transaction) -> int:
    """Repeated attempts that went before it: they are at the back of their class, but may have been there already."""
    first = desk.log.index(transaction)
    seen: set[Transaction] = set()
    count = 0
    for other in desk.log[:first]:
        count += other in seen
        seen.add(other)
    return count


def test_r9_a_lone_command_waits_for_the_exchange_on_the_wire_and_at_most_one_slot() -> None:
    desk = Desk()
    for _ in range(30):
        desk.submit(POLL)
    waits = []
    for _ in range(20):
        command = desk.submit()
        while desk.on_wire is not command:
            desk.finish()
        waits.append(command.exchanges_ahead)
        desk.finish()
    assert max(waits) == 1


def test_r9_a_command_that_follows_seven_others_lets_a_poll_pass() -> None:
    desk = Desk()
    for _ in range(8):
        desk.submit()
    desk.submit(POLL)
    for _ in range(7):
        desk.finish()
    command = desk.submit()
    desk.run_out()
    assert command.exchanges_ahead == 2


def test_r9_polls_run_at_an_eighth_of_the_line_beside_endless_commands() -> None:
    desk = Desk()
    for _ in range(100):
        desk.submit(POLL)
    for _ in range(160):
        while desk.dispatcher.backlog.waiting(COMMAND) < 2:
            desk.submit()
        desk.finish()
    assert sum(t.priority is POLL for t in desk.log[:160]) == 20


def test_r9_a_failing_read_does_not_keep_its_place() -> None:
    desk = Desk()
    failing, next_one = desk.submit(), desk.submit()
    desk.finish(ok=False)
    assert desk.on_wire is next_one
    desk.finish()
    assert desk.on_wire is failing


def test_r7_a_repeated_poll_goes_behind_those_that_are_due_before_its_next_period() -> None:
    desk = Desk()
    failing, patient = desk.submit(POLL), desk.submit(POLL)
    patient.deadline = 1.5
    desk.finish(ok=False)
    assert desk.on_wire is patient
    assert failing.deadline == 2.0


def test_r12_writes_that_wait_behind_one_that_is_repeated_are_bounded_too() -> None:
    desk = Desk(capacity=5)
    for _ in range(20):
        desk.submit(write=True, repeat=True)
    waiting = desk.dispatcher.writes.queues[desk.nodes[0]]
    assert len(waiting) == 5
    desk.finish(ok=False)
    full = desk.submit(write=True)
    assert isinstance(full.error, BacklogFull)


def test_r12_a_repeated_request_ends_although_its_time_to_start_is_over() -> None:
    desk = Desk()
    desk.submit()
    late, after = desk.submit(start_by=1.5), desk.submit()
    desk.finish()
    desk.finish(ok=False)
    assert (desk.on_wire, late.phase) == (after, Phase.QUEUED)
    desk.dispatcher.expire(desk.now)
    desk.run_out()
    assert late.error is None
    assert late.attempts == 2


def test_r7_a_write_that_was_on_the_wire_never_ends_as_if_it_had_not_been() -> None:
    desk = Desk()
    write = desk.submit(write=True, repeat=True)
    other = desk.submit(node=1)
    desk.finish(ok=False)
    desk.dispatcher.fault = lambda: BusError("gone")
    desk.dispatcher.fail_all(desk.now)
    assert isinstance(write.error, WriteUnconfirmed)
    assert "gone" in str(write.error)
    assert write.attempts == 1
    assert desk.on_wire is other


def test_r13_a_queued_request_is_not_sent_while_the_line_is_unusable() -> None:
    desk = Desk()
    first, queued = desk.submit(), desk.submit(node=1, write=True)
    desk.dispatcher.fault = lambda: BusError("gone")
    desk.finish()
    assert first.error is None
    assert desk.on_wire is None
    assert queued.error is not None
    assert queued.error.what == "gone"
    assert not queued.attempts


@pytest.mark.parametrize(("higher", "lower"), [(COMMAND, POLL), (COMMAND, BACKGROUND), (POLL, BACKGROUND)])
def test_r9_the_slots_of_a_higher_class_count_from_when_a_lower_one_waits(higher: Priority, lower: Priority) -> None:
    desk = Desk()
    for _ in range(10):
        desk.submit(higher)
    desk.run_out()
    desk.submit(higher)  # it is sent at once
    desk.log.clear()
    waiting = desk.submit(lower)
    for _ in range(2 * SHARE):
        desk.submit(higher)
    desk.run_out()
    assert desk.log.index(waiting) == SHARE
