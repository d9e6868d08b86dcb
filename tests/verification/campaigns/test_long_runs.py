"""An hour of a busy line, a million requests, and a plan held against what came of it."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from math import inf
from pathlib import Path

import pytest

from busmaster.arbiter.choice import LONGEST_ALIKE
from busmaster.arbiter.transaction import Priority, Transaction
from busmaster.planning import Plan, PlannedGroup, PlannedNode, plan
from busmaster.protocols.hcp2 import codec as hcp2
from tests.verification.campaigns.loads import EXCHANGE, LINE, REPLY_TIME, VALUE, Load, quantile

SPREAD = 0.3
LONGEST = 16 * LINE.byte_time + REPLY_TIME * (1 + SPREAD)
HOUR = 3600.0
TIERS_OF_SECONDS = [
    60.0,
    pytest.param(HOUR / 6, marks=pytest.mark.slow, id="ten minutes"),
    pytest.param(HOUR, marks=pytest.mark.exhaustive, id="an hour"),
]
PERIODS = (0.25, 0.5, 1.0)


def jitters(line: Load, since: float = 1.0) -> list[float]:
    """From due to started, of all cycles."""
    return [begun - due for cycles in line.cycles.values() for due, begun, _ in cycles if due >= since]


@pytest.mark.timeout(300)
@pytest.mark.parametrize("seconds", TIERS_OF_SECONDS)
def test_r10_sixty_points_at_67_percent_of_the_line_start_on_time(seconds: float) -> None:
    line = Load(8, spread=SPREAD)
    for period in PERIODS:
        line.poll_of(f"{period}", period, [Transaction(line.nodes[i % 8], hcp2.Read(i // 8 + 1)) for i in range(20)])
    line.run(seconds)
    late = jitters(line)
    assert line.world.arbiter.statistics(line.now).utilisation == pytest.approx(0.67, abs=0.01)
    assert len(late) >= 7 * (seconds - 2)
    assert quantile(late, 0.99) <= LONGEST + 0.001
    assert sum(poll.missed for poll in line.polls) == 0


@pytest.mark.slow
@pytest.mark.parametrize("one_by_one", [False, True])
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.exhaustive) for seed in (2, 3))])
def test_r10_sixty_groups_of_one_point_start_on_time_in_whatever_order_they_were_added(
    seed: int, one_by_one: bool
) -> None:
    """Together, or one after the other while the line runs: then each must find the room that the others left."""
    line = Load(8, spread=SPREAD, seed=seed)
    wanted = [(period, index) for period in PERIODS for index in range(20)]
    line.random.shuffle(wanted)
    for period, index in wanted:
        line.poll(f"{period}/{index}", period, [line.nodes[index % 8]])
        if one_by_one:
            line.run(0.1)
    added = line.now
    line.run(300.0)
    assert quantile(jitters(line, added), 0.99) <= LONGEST + 0.001
    assert sum(poll.missed for poll in line.polls) == 0


# plan and truth


def planned(line: Load, groups: Sequence[tuple[str, float, int]]) -> Plan:
    """Poll so many elements in each group for a while, and plan the same."""
    characters = len(f"{VALUE:g}")
    reply_time = REPLY_TIME + (characters - 7) * LINE.byte_time
    wanted = []
    for name, period, count in groups:
        reads = [(line.nodes[i % 8], hcp2.Read(i // 8 + 1)) for i in range(count)]
        poll = line.poll_of(name, period, [Transaction(node, command) for node, command in reads])
        line.run(0.2)
        nodes = {node: PlannedNode(hcp2.PROFILE, node.address, reply_time=reply_time) for node, _ in reads}
        wanted.append(PlannedGroup(name, period, [(nodes[node], command) for node, command in reads], poll.phase))
    line.run(20.0)
    return plan(wanted, line=LINE)


@pytest.mark.parametrize(
    "groups",
    [
        [("only", 0.1, 5)],
        [("a", 0.25, 20), ("b", 0.5, 20), ("c", 1.0, 20)],
        [("a", 0.1, 10), ("b", 0.3, 14), ("c", 0.7, 15), ("d", 1.1, 20)],
        [("a", 0.05, 4), ("b", 2.0, 150), ("c", 10.0, 300)],
    ],
)
def test_the_plan_of_a_schedule_that_fits_is_what_comes_of_it(groups: list[tuple[str, float, int]]) -> None:
    line = Load(8, spread=SPREAD)
    prediction = planned(line, groups)
    since, missed = line.now, [poll.missed for poll in line.polls]
    line.world.arbiter.reset_statistics(line.now)
    line.run(120.0)
    assert prediction.fits
    assert line.world.arbiter.statistics(line.now).utilisation == pytest.approx(prediction.utilisation, abs=0.02)
    for group in prediction.groups:
        cycles = [done - due for due, _, done in line.cycles[group.name] if due > since]
        checked = 1 + 1 / LONGEST_ALIKE if group.name == "only" else 1.0  # its reads are alike
        assert sum(cycles) / len(cycles) == pytest.approx(group.cycle * checked, rel=0.03)
        assert max(cycles) <= 1.2 * group.longest_cycle + (LONGEST if checked > 1 else 0.0)
        assert max(cycles) <= group.worst_cycle
    assert [poll.missed for poll in line.polls] == missed


@pytest.mark.slow
def test_a_schedule_that_needs_118_percent_misses_what_the_plan_says() -> None:
    count = round(1.18 / (1 / 0.25 + 1 / 0.5 + 1 / 1.0) / EXCHANGE)
    line = Load(8, spread=SPREAD)
    prediction = planned(line, [("a", 0.25, count), ("b", 0.5, count), ("c", 1.0, count)])
    before = [(poll.missed, len(line.cycles[poll.name])) for poll in line.polls]
    line.run(300.0)
    assert prediction.utilisation == pytest.approx(1.18, abs=0.02)
    assert not prediction.fits
    assert f"{prediction.utilisation:.0%} of the line" in prediction.advice[0]
    for group, poll, (missed, cycles) in zip(prediction.groups, line.polls, before, strict=True):
        missed, cycles = poll.missed - missed, len(line.cycles[poll.name]) - cycles
        assert missed / (missed + cycles) == pytest.approx(group.missed, abs=0.08)
        assert bool(group.missed) == any(f"group {group.name!r} will miss" in line for line in prediction.advice)
        tight = any(f"group {group.name!r} has no time to spare" in line for line in prediction.advice)
        assert bool(missed) == (group.missed > 0 or tight)
    assert line.polls[0].missed > 0
    assert prediction.groups[0].missed > 0


# memory


def resident() -> int:
    """Bytes of this process that are in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.timeout(300)
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the resident size is read from /proc")
@pytest.mark.parametrize(
    "requests",
    [
        pytest.param(100_000, marks=pytest.mark.slow, id="a tenth of it"),
        pytest.param(1_000_000, marks=pytest.mark.exhaustive, id="a million"),
    ],
)
def test_r12_a_million_requests_with_callers_that_give_up_at_random_leave_nothing_behind(requests: int) -> None:
    line = Load(8, spread=SPREAD)
    chance, arbiter = line.random, line.world.arbiter
    reads = [hcp2.Read(element) for element in range(1, 100)]
    waiting: list[Transaction] = []
    sizes: list[tuple[int, int]] = []
    asked = 0
    line.on_completed = lambda transaction: None

    def ask() -> None:
        nonlocal asked
        for _ in range(20):
            asked += 1
            number = chance.getrandbits(16)
            node, priority = line.nodes[number >> 4 & 7], Priority(number >> 2 & 3)
            start_by = line.now + 0.3 if number & 3 == 0 else inf
            transaction = Transaction(node, reads[number % 99], priority=priority, start_by=start_by)
            waiting.append(transaction)
            arbiter.submit(transaction, line.now)
        while len(waiting) > 40 or (waiting and chance.random() < 0.9):
            arbiter.cancel(waiting.pop(int(chance.random() * len(waiting))), line.now)

    line.every(lambda: 0.03, ask)
    while asked < requests:
        line.run(requests / 10 * 0.03 / 20)
        gc.collect()
        sizes.append((resident(), len(gc.get_objects())))
    statistics = arbiter.statistics(line.now)
    assert statistics.cancelled > requests / 2
    assert statistics.exchanges > requests / 10
    assert sizes[-1][0] - sizes[1][0] < 2**20
    assert sizes[-1][1] - sizes[1][1] < 1000
