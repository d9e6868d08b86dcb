"""Which of the cheaper exchanges that a protocol proposes are taken."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import hypothesis.strategies as st
from hypothesis import given, settings

from busmaster.contract.exchange import Command
from busmaster.contract.profile import Batch
from busmaster.planning import PlannedNode
from busmaster.planning.merging import Merge, at_once, cheapest
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc

TAU_9600 = 10 / 9600
READS = [mentor.Read(1, number) for number in (17, 18, 19, 25)]


def cost_of(node: PlannedNode) -> Callable[[Command[Any]], float]:
    return lambda command: node.line_time(command, TAU_9600)


def names(commands: Sequence[Command[Any]], *merges: Merge, node: PlannedNode) -> list[str]:
    return [str(served.command) for served in at_once(cheapest(commands, merges, cost_of(node)))]


MENTOR = PlannedNode(mentor.PROFILE, 1, reply_time=0.01)
MSC = PlannedNode(msc.PROFILE, 1, reply_time=0.005)


def test_without_merges_every_command_is_an_exchange() -> None:
    assert names(READS, node=MENTOR) == [str(read) for read in READS]


def test_neighbouring_parameters_become_a_run_and_the_rest_stays_single() -> None:
    assert names(READS, mentor.merge_runs, node=MENTOR) == ["read 01.17 to 01.19", "read 01.25"]


def test_a_run_saves_nine_bytes_for_each_parameter_but_the_first() -> None:
    run = at_once(cheapest(READS[:3], [mentor.merge_runs], cost_of(MENTOR)))[0]
    assert run.serves == (0, 1, 2)
    assert run.batch
    assert abs(run.saved - 2 * 9 * TAU_9600) < 1e-9


def test_a_block_of_32_is_read_only_where_it_takes_less_time_than_the_values_that_are_wanted() -> None:
    """BREAD costs 124 more bytes than DREAD: a few values are cheaper one by one, unless replies are slow."""
    merge = msc.Merging(address_step=4)

    def exchanges(count: int, reply_time: float) -> int:
        node = PlannedNode(msc.PROFILE, 1, reply_time=reply_time)
        return len(at_once(cheapest([msc.DataRead(2000 + 4 * n) for n in range(count)], [merge], cost_of(node))))

    assert [exchanges(count, 0.005) for count in (2, 3, 4, 32)] == [2, 3, 1, 1]
    assert exchanges(2, 0.1) == 1


def pair(*places: int) -> Batch:
    return Batch(msc.PickedData(0, places), places)


def pairs(commands: Sequence[Command[Any]]) -> list[Batch]:
    return [pair(index, index + 1) for index in range(len(commands) - 1)]


def test_the_greatest_saving_goes_first_and_nothing_is_read_twice() -> None:
    costs: dict[Command[Any], float] = {pair(0, 1).command: 1.5, pair(1, 2).command: 1.1, pair(2, 3).command: 1.2}
    commands = [msc.DataRead(n) for n in range(4)]
    served = at_once(cheapest(commands, [pairs], lambda command: costs.get(command, 1.0)))
    assert [s.serves for s in served] == [(0,), (1, 2), (3,)]


def test_a_batch_that_saves_nothing_is_left() -> None:
    commands = [msc.DataRead(0), msc.DataRead(1)]
    served = at_once(cheapest(commands, [pairs], lambda command: 1.0 if command in commands else 2.0))
    assert [s.batch for s in served] == [False, False]


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 20)), unique=True), st.floats(0.0, 0.1))
@settings(max_examples=60)
def test_every_command_is_served_exactly_once_and_never_at_a_greater_cost(
    wanted: list[tuple[int, int]], reply_time: float
) -> None:
    commands = [mentor.Read(menu, number) for menu, number in wanted]
    node = PlannedNode(mentor.PROFILE, 1, reply_time=reply_time)
    served = at_once(cheapest(commands, [mentor.merge_runs], cost_of(node)))
    assert sorted(index for s in served for index in s.serves) == list(range(len(commands)))
    single = sum(node.line_time(command, TAU_9600) for command in commands)
    total = sum(node.line_time(s.command, TAU_9600) for s in served)
    assert abs(single - total - sum(s.saved for s in served)) < 1e-9
    assert total <= single + 1e-9
