"""The four classes and the slot of the lower ones (R9)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from busmaster.arbiter.backlog import SHARE, SLACK, Backlog
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.transaction import Phase, Priority, Transaction
from busmaster.protocols.hcp2 import codec as hcp2

NODE = NodeRecord(hcp2.PROFILE, 1, hcp2.PROFILE.timings, 2)
READ = hcp2.Read(1)
URGENT, COMMAND, POLL, BACKGROUND = Priority


def waiting(priority: Priority, deadline: float = 1.0) -> Transaction:
    transaction = Transaction(NODE, READ, priority=priority)
    transaction.deadline = deadline
    return transaction


def filled(*priorities: Priority) -> Backlog:
    backlog = Backlog()
    for priority in priorities:
        backlog.push(waiting(priority))
    return backlog


def order(backlog: Backlog) -> list[Priority]:
    """The classes in which it is served until it is empty."""
    served = []
    while (transaction := backlog.pop(0.0)) is not None:
        transaction.phase = Phase.ON_WIRE
        served.append(transaction.priority)
    return served


def test_r9_the_classes_are_strict() -> None:
    backlog = filled(BACKGROUND, POLL, COMMAND, URGENT, BACKGROUND, POLL, COMMAND, URGENT)
    assert order(backlog) == [URGENT, URGENT, COMMAND, COMMAND, POLL, POLL, BACKGROUND, BACKGROUND]


def test_r9_after_seven_commands_a_waiting_poll_gets_a_slot() -> None:
    assert order(filled(*[COMMAND] * 16, POLL, POLL)) == [*[COMMAND] * 7, POLL, *[COMMAND] * 7, POLL, *[COMMAND] * 2]


def test_r9_the_slot_goes_to_poll_and_background_in_turn() -> None:
    served = order(filled(*[COMMAND] * 28, *[POLL] * 2, *[BACKGROUND] * 2))
    assert served[7::8] == [POLL, BACKGROUND, POLL, BACKGROUND]


def test_r9_after_seven_polls_background_gets_a_slot() -> None:
    served = order(filled(*[POLL] * 16, BACKGROUND, BACKGROUND))
    assert served == [*[POLL] * 7, BACKGROUND, *[POLL] * 7, BACKGROUND, *[POLL] * 2]


def test_r9_a_turn_of_background_on_a_free_line_does_not_count_towards_its_slot() -> None:
    backlog = filled(BACKGROUND)
    assert order(backlog) == [BACKGROUND]
    for priority in (*[POLL] * 9, BACKGROUND):
        backlog.push(waiting(priority))
    assert order(backlog) == [*[POLL] * 7, BACKGROUND, *[POLL] * 2]


def test_r9_the_slot_is_never_before_urgent() -> None:
    assert order(filled(*[URGENT] * 20, COMMAND, POLL))[:20] == [URGENT] * 20


def test_r9_commands_while_nothing_else_waits_do_not_count_towards_a_slot() -> None:
    backlog = filled(*[COMMAND] * 8)
    for _ in range(7):
        backlog.pop(0.0)
    backlog.push(waiting(POLL))
    assert order(backlog) == [COMMAND, POLL]


def test_r9_commands_go_first_in_first_out() -> None:
    backlog = Backlog()
    commands = [waiting(COMMAND, deadline=-n) for n in range(5)]
    for command in commands:
        backlog.push(command)
    assert [backlog.pop(0.0) for _ in commands] == commands


def test_r9_polls_go_earliest_deadline_first_and_equals_in_the_order_of_arrival() -> None:
    backlog = Backlog()
    polls = [waiting(POLL, deadline) for deadline in (3.0, 1.0, 2.0, 1.0)]
    for poll in polls:
        backlog.push(poll)
    assert [backlog.pop(0.0) for _ in polls] == [polls[1], polls[3], polls[2], polls[0]]


def test_a_discarded_transaction_is_not_served() -> None:
    backlog = Backlog()
    keep, drop = waiting(COMMAND), waiting(COMMAND)
    backlog.push(drop)
    backlog.push(keep)
    backlog.discard(drop, Phase.ENDED)
    assert len(backlog) == backlog.waiting(COMMAND) == 1
    assert backlog.pop(0.0) is keep
    assert backlog.pop(0.0) is None


def test_a_promoted_write_goes_to_the_front_of_the_higher_class() -> None:
    backlog = Backlog()
    first, urgent = waiting(BACKGROUND), waiting(URGENT)
    for transaction in (waiting(BACKGROUND), first, waiting(COMMAND), urgent):
        backlog.push(transaction)
    backlog.promote(first, COMMAND)
    assert backlog.pop(0.0) is urgent
    assert backlog.pop(0.0) is first
    assert backlog.waiting(BACKGROUND) == 1


def test_what_is_pushed_to_the_front_of_poll_goes_before_every_deadline() -> None:
    backlog = filled(POLL, POLL)
    first = waiting(POLL, deadline=99.0)
    backlog.push_front(first)
    assert backlog.pop(0.0) is first


def test_draining_empties_it_in_order_of_class() -> None:
    backlog = filled(POLL, COMMAND, URGENT, BACKGROUND)
    assert [t.priority for t in backlog.drain()] == [URGENT, COMMAND, POLL, BACKGROUND]
    assert len(backlog) == 0
    assert backlog.pop(0.0) is None


def test_draining_keeps_the_order_of_arrival_among_equal_deadlines() -> None:
    backlog = Backlog()
    transactions = [waiting(POLL) for _ in range(6)]
    for transaction in transactions:
        backlog.push(transaction)
    assert backlog.pop(0.0) is transactions.pop(0)
    assert backlog.drain() == transactions


def test_cancelled_transactions_do_not_pile_up() -> None:
    for priority in Priority:
        backlog = Backlog()
        for _ in range(10_000):
            transaction = waiting(priority)
            backlog.push(transaction)
            backlog.discard(transaction, Phase.ENDED)
        assert len(list(backlog.queues[priority].entries())) <= SLACK + 1


def longest_wait(served: Sequence[Priority], priority: Priority) -> int:
    """Exchanges between two of this class, while it always waits."""
    places = [-1, *(i for i, p in enumerate(served) if p is priority)]
    return max(later - earlier for earlier, later in pairwise(places))


@given(st.lists(st.sampled_from([COMMAND, POLL, BACKGROUND]), max_size=4), st.integers(20, 60))
@settings(max_examples=50)
def test_r9_no_class_that_waits_is_passed_over_for_more_than_its_share(start: list[Priority], count: int) -> None:
    """However it began: with every class always waiting, a slot in eight goes down, to POLL and BACKGROUND in turn."""
    backlog = filled(*start)
    for _ in start:
        backlog.pop(0.0)
    served = []
    for _ in range(count):
        for priority in (COMMAND, POLL, BACKGROUND):
            if not backlog.waiting(priority):
                backlog.push(waiting(priority))
        transaction = backlog.pop(0.0)
        assert transaction is not None
        served.append(transaction.priority)
    assert longest_wait(served, COMMAND) <= 2
    assert longest_wait([*served, POLL], POLL) <= 2 * (SHARE + 1)
    assert longest_wait([*served, BACKGROUND], BACKGROUND) <= 2 * (SHARE + 1)


OPERATIONS = st.lists(
    st.tuples(st.sampled_from(["push", "pop", "discard", "front", "promote"]), st.sampled_from(Priority)), max_size=60
)


@given(OPERATIONS)
@settings(max_examples=100)
def test_nothing_is_lost_nor_served_twice(operations: list[tuple[str, Priority]]) -> None:
    backlog = Backlog()
    inside: list[Transaction] = []
    for operation, priority in operations:
        if operation in ("push", "front"):
            transaction = waiting(priority)
            (backlog.push if operation == "push" else backlog.push_front)(transaction)
            inside.append(transaction)
        elif operation == "pop" or not inside:
            served = backlog.pop(0.0)
            assert (served is None) == (not inside)
            if served is not None:
                served.phase = Phase.ON_WIRE
                inside.remove(served)
        elif operation == "discard":
            backlog.discard(inside.pop(), Phase.ENDED)
        elif priority < inside[-1].priority:
            backlog.promote(inside[-1], priority)
        assert len(backlog) == len(inside)
    assert sorted(map(id, backlog.drain())) == sorted(map(id, inside))


# what goes before the first one (R15)

FEW = 8


@pytest.mark.parametrize("higher", [COMMAND, POLL])
def test_r15_what_is_put_back_is_the_next_to_go_and_its_class_keeps_its_turn(higher: Priority) -> None:
    """As if nobody had looked: also at the slot of the lower classes."""
    for when in range(3 * SHARE):
        backlogs = []
        for _ in range(2):
            backlog = filled(*[higher] * 3 * SHARE, *[POLL, BACKGROUND] * 3)
            for place, transaction in enumerate(backlog.drain()):
                transaction.touches = place
                backlog.push(transaction)
            backlogs.append(backlog)
        plain, looked = backlogs
        for step in range(3 * SHARE + 6):
            if step == when:
                first = looked.pop(0.0)
                assert first is not None
                looked.restore(first)
            expected, served = plain.pop(0.0), looked.pop(0.0)
            assert expected is not None
            assert served is not None
            assert expected.touches == served.touches
            expected.phase = served.phase = Phase.ON_WIRE


@pytest.mark.parametrize("priority", Priority)
def test_r15_the_first_that_suits_is_picked_and_the_others_keep_their_places(priority: Priority) -> None:
    backlog = Backlog()
    entries = [waiting(priority) for _ in range(5)]
    for transaction in entries:
        backlog.push(transaction)
    picked = backlog.pick(priority, lambda transaction: transaction in entries[2:4])
    assert picked is entries[2]
    assert len(backlog) == backlog.waiting(priority) == 4
    assert [backlog.pop(0.0) for _ in range(4)] == [entries[0], entries[1], entries[3], entries[4]]


@pytest.mark.parametrize("priority", Priority)
def test_r15_only_the_first_few_are_looked_at(priority: Priority) -> None:
    """Equal polls by the hundred must not be searched for an unlike one at every exchange."""
    backlog = Backlog()
    for _ in range(FEW + 1):
        backlog.push(waiting(priority))
    last = waiting(priority, 2.0)
    backlog.push(last)
    seen = []

    def suits(transaction: Transaction) -> bool:
        seen.append(transaction)
        return transaction is last

    assert backlog.pick(priority, suits) is None
    assert len(seen) == FEW
    assert len(backlog) == FEW + 2


@pytest.mark.parametrize("priority", Priority)
def test_r15_what_has_ended_is_not_picked(priority: Priority) -> None:
    backlog = Backlog()
    entries = [waiting(priority) for _ in range(3)]
    for transaction in entries:
        backlog.push(transaction)
    backlog.discard(entries[0], Phase.ENDED)
    assert backlog.pick(priority, lambda _: True) is entries[1]
    assert [backlog.pop(0.0), backlog.pop(0.0)] == [entries[2], None]
