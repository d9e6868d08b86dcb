"""What is left of polls that were removed: nothing, and the others lose nothing."""

from __future__ import annotations

import pytest

from busmaster.arbiter.schedule import AT_ONCE, SLICE
from busmaster.arbiter.transaction import Poll
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import Bench
from tests.arbiter.test_schedule import released, running


def test_polls_that_were_removed_do_not_pile_up_and_those_that_are_left_stay_due() -> None:
    kept = [Poll(str(number), 1.0 if number < 2 else 9.0, phase=0.5) for number in range(150)]
    schedule = running(*kept)
    for number in range(10 * AT_ONCE):
        poll = Poll(str(number), 5.0, phase=0.01 * (number % 100))
        schedule.add(poll, 0.0)
        schedule.remove(poll)
        assert len(schedule._heap) <= 2 * len(kept) + AT_ONCE + 1
    assert len(released(schedule, 0.5)) == len(kept)
    assert [name for _, name in released(schedule, 2.0)] == ["0", "1"]


@pytest.mark.parametrize("removed", [0, 1, 2])
def test_of_those_that_are_being_prepared_one_that_is_removed_takes_no_other_with_it(removed: int) -> None:
    polls = [Poll(str(number), 5.0, phase=1.0) for number in range(3)]
    for poll in polls:
        poll.preparation = iter([2 * SLICE, 2 * SLICE])
    schedule = running(*polls)
    schedule.remove(polls[removed])
    while schedule.unplaced():
        schedule.release(0.0)
    assert sorted(name for _, name in released(schedule, 2.0)) == sorted({"0", "1", "2"} - {str(removed)})


def test_nothing_is_kept_of_the_writes_to_a_node_that_was_removed() -> None:
    bench = Bench()
    gone, stays = bench.node(1), bench.node(2)
    for node in (gone, stays):
        bench.served(bench.ask(node, hcp2.Write(1, (5.0,))))
    bench.arbiter.remove_node(gone)
    assert gone not in bench.arbiter.dispatcher.writes.queues
