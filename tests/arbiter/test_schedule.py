"""The grid of polls, the choice of their phases (R10), and line time."""

from __future__ import annotations

import random
from collections.abc import Iterator
from itertools import pairwise
from math import inf
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import example, given, settings

import busmaster.arbiter.schedule as phases_module
import busmaster.arbiter.schedule as schedule_module
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.schedule import (
    AT_ONCE,
    KINKS,
    ROUNDING,
    SLICE,
    STRIDE,
    Schedule,
    begin_cycle,
    common_divisor,
    quietest_offset,
    set_members,
)
from busmaster.arbiter.transaction import LONGEST_PATIENCE, Poll, Priority, Transaction
from busmaster.contract.profile import LineSettings
from busmaster.errors import InvalidCommand
from busmaster.planning.merging import at_once
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import Bench, request_of, up

TAU = LineSettings(57600).byte_time
PERIODS = st.sampled_from([0.05, 0.1, 0.2, 0.25, 0.5, 1.0, 2.0])


def running(*polls: Poll, now: float = 0.0) -> Schedule:
    schedule = Schedule()
    for poll in polls:
        schedule.add(poll, now)
    return schedule


def released(schedule: Schedule, until: float) -> list[tuple[float, str]]:
    """When which poll was due, if the clock stops at every due time and cycles take no time."""
    seen = []
    while (now := schedule.next_due()) <= until:
        seen += [(poll.due, poll.name) for poll in schedule.release(now)]
    return seen


def members(*addresses: int) -> list[Transaction]:
    nodes = [NodeRecord(hcp2.PROFILE, address, hcp2.PROFILE.timings, 2) for address in addresses]
    return [Transaction(node, hcp2.Read(1)) for node in nodes]


def test_r10_a_poll_is_due_on_a_fixed_grid_from_its_phase_on() -> None:
    schedule = running(Poll("a", 0.25, phase=0.1), now=10.0)
    assert [due for due, _ in released(schedule, 10.9)] == pytest.approx([10.1, 10.35, 10.6, 10.85])


def test_r10_a_poll_added_later_joins_the_grid_of_the_first() -> None:
    schedule = running(Poll("a", 0.25, phase=0.0), now=10.0)
    late = Poll("b", 0.25, phase=0.1)
    schedule.add(late, 10.2)
    assert late.base == pytest.approx(10.35)


def test_r10_the_grid_does_not_drift_in_a_million_cycles() -> None:
    poll = Poll("a", 0.1, phase=0.0)
    schedule = running(poll)
    schedule.release(0.0)
    poll.number = 1_000_000
    assert poll.next_due() == pytest.approx(100_000.0, abs=1e-9)


def test_r10_what_could_not_start_while_the_owner_slept_is_missed_and_not_caught_up() -> None:
    poll = Poll("a", 0.1, phase=0.0)
    schedule = running(poll)
    schedule.release(0.0)
    assert schedule.release(0.55) == [poll]
    assert poll.due == pytest.approx(0.5)
    assert poll.missed == 4
    assert schedule.next_due() == pytest.approx(0.6)


def test_r10_a_cycle_that_still_runs_makes_the_next_one_missed() -> None:
    poll = Poll("a", 0.1, phase=0.0)
    schedule = running(poll)
    schedule.release(0.0)
    poll.remaining = 1
    assert schedule.release(0.1) == []
    assert poll.missed == 1
    poll.remaining = 0
    assert schedule.release(0.2) == [poll]
    assert poll.missed == 1


def test_a_paused_poll_neither_starts_nor_misses_and_resumes_on_the_grid() -> None:
    poll = Poll("a", 0.1, phase=0.0)
    schedule = running(poll)
    poll.paused = True
    assert schedule.release(0.35) == []
    poll.paused = False
    assert schedule.next_due() == pytest.approx(0.4)
    assert poll.missed == 0


def test_a_removed_poll_is_not_due_again_and_cannot_come_back() -> None:
    poll, other = Poll("a", 0.1, phase=0.0), Poll("b", 0.3, phase=0.0)
    schedule = running(poll, other)
    list(begin_cycle(poll, 0.0))
    schedule.remove(poll)
    assert {name for _, name in released(schedule, 1.0)} == {"b"}
    with pytest.raises(InvalidCommand, match="make a new one"):
        schedule.add(poll, 1.0)


def test_a_poll_that_was_never_placed_can_be_removed() -> None:
    poll = Poll("a", 0.1)
    schedule = running(poll)
    schedule.remove(poll)
    assert schedule.next_due() == inf
    assert schedule.release(1.0) == []


@pytest.mark.parametrize("period", [0.0, -1.0, 0.0009, inf, float("nan")])
def test_a_period_that_cannot_be_is_refused(period: float) -> None:
    with pytest.raises(InvalidCommand, match=r"a period is 0\.001 to 86400 s"):
        Poll("a", period)


@pytest.mark.parametrize("phase", [-0.1, 0.5, 1.0, float("nan")])
def test_a_phase_outside_the_period_is_refused(phase: float) -> None:
    with pytest.raises(InvalidCommand, match="phase"):
        Poll("a", 0.5, phase=phase)


def test_a_cycle_begins_with_fresh_transactions_that_want_to_be_done_within_the_period() -> None:
    poll = Poll("a", 0.5, phase=0.0)
    set_members(poll, members(1, 2), Priority.POLL)
    running(poll).release(0.0)
    cycle = list(begin_cycle(poll, 0.001))
    assert [(t.queued, t.deadline) for t in cycle] == [(0.001, 0.5)] * 2
    assert poll.remaining == 2


def test_r9_a_slow_poll_waits_no_longer_for_later_fast_ones_than_its_patience() -> None:
    poll = Poll("hourly", 3600.0, phase=0.0)
    set_members(poll, members(1))
    running(poll).release(0.0)
    assert next(begin_cycle(poll, 0.0)).deadline == LONGEST_PATIENCE


def test_r9_a_request_among_polls_wants_to_be_answered_within_a_second() -> None:
    """A cycle of half a second that begins with it goes before it, and one of two seconds behind."""
    bench = Bench()
    node = up(bench)
    bench.ask(node, hcp2.Read(9))
    bench.ask(node, hcp2.Read(3), priority=Priority.POLL)
    for element, period in ((4, 0.5), (5, 2.0)):
        bench.poll(node, period, element)
    bench.wait(0.0)
    assert [bench.answer() for _ in range(4)] == [request_of(element) for element in (9, 4, 3, 5)]


def test_r11_a_node_that_was_never_heard_is_read_in_background() -> None:
    poll = Poll("a", 0.5, phase=0.0)
    heard, absent = members(1, 2)
    heard.node.last_reply = 0.0
    set_members(poll, [heard, absent])
    running(poll).release(0.0)
    assert [t.priority for t in begin_cycle(poll, 0.0)] == [Priority.POLL, Priority.BACKGROUND]


def test_new_members_are_asked_from_the_next_cycle_on() -> None:
    poll = Poll("a", 0.5, phase=0.0)
    old, new = members(1, 2)
    set_members(poll, [old])
    list(begin_cycle(poll, 0.0))
    set_members(poll, [new])
    assert list(poll.results) == [old]
    assert list(begin_cycle(poll, 0.5)) == [new]
    assert poll.cycles == 2


# phases


def test_r10_the_first_poll_starts_at_once() -> None:
    poll = Poll("a", 0.5, cost=0.1)
    schedule = running(poll, now=3.0)
    assert schedule.next_due() == 3.0
    assert schedule.release(3.0) == [poll]


def test_r10_polls_added_together_do_not_meet() -> None:
    """60 polls of one exchange, a third each at 0.25, 0.5 and 1 s: 67 % of the line, and not one has to wait."""
    exchange = 0.0048
    polls = [Poll(f"{period} {n}", period, cost=exchange) for period in (0.25, 0.5, 1.0) for n in range(20)]
    random.Random(1).shuffle(polls)
    starts = sorted(due for due, _ in released(running(*polls), 2.999) if due >= 1.0)
    assert len(starts) == 2 * 140
    assert min(b - a for a, b in pairwise(starts)) >= exchange


def test_r10_phases_do_not_depend_on_what_replies_were_thought_to_take() -> None:
    """At first reply times are guesses, all too long by the same factor: the polls spread all the same."""
    polls = [Poll(f"{period} {n}", period, cost=0.0285) for period in (0.25, 0.5, 1.0) for n in range(20)]
    starts = sorted(due for due, _ in released(running(*polls), 2.999) if due >= 1.0)
    assert min(b - a for a, b in pairwise(starts)) >= 0.0048


def test_r10_a_poll_added_to_a_running_line_goes_where_there_is_room() -> None:
    first = Poll("first", 0.2, phase=0.0, cost=0.1)
    schedule = running(first)
    schedule.release(0.0)
    later = Poll("later", 0.4, cost=0.05)
    schedule.add(later, 1.03)
    schedule.release(1.03)
    into = later.base % 0.2
    assert 0.1 <= into <= 0.15


def test_a_long_cycle_meets_as_little_as_can_be() -> None:
    """It cannot avoid polls that are due more often than it lasts, but it can avoid the other slow one."""
    polls = [Poll("fast", 0.05, phase=0.0, cost=0.01), Poll("slow", 2.0, phase=0.0, cost=0.4)]
    schedule = running(*polls)
    schedule.release(0.0)
    assert 0.4 <= at_once(quietest_offset(Poll("another", 2.0, cost=0.4), polls, 0.0)) <= 1.6


def test_choosing_a_phase_among_many_polls_looks_at_a_bounded_number_of_kinks(monkeypatch: pytest.MonkeyPatch) -> None:
    """The 60th group costs the running line a few milliseconds, however its period relates to the others'."""
    looked_at = most = 0
    kinks = phases_module._kinks

    def counted(*arguments: Any) -> Iterator[tuple[float, float]]:
        nonlocal looked_at
        for kink in kinks(*arguments):
            looked_at += 1
            yield kink

    monkeypatch.setattr(phases_module, "_kinks", counted)
    chance = random.Random(3)
    for period in (0.25, 10.0, 0.007, 3600.0, 0.333):
        others = [Poll(str(n), chance.choice([0.1, 0.25, 0.3, 1.0, 60.0]), cost=0.005) for n in range(59)]
        for other in others:
            other.base = chance.uniform(0.0, other.period)
        looked_at = 0
        offset = at_once(quietest_offset(Poll("sixtieth", period, cost=0.005), others, 0.0))
        most = max(most, looked_at)
        assert 0 <= offset < period
    assert 0 < most <= 2 * KINKS


def overlap(poll: Poll, offset: float, others: list[Poll], until: float) -> float:
    """By counting, cycle by cycle."""
    total = 0.0
    for k in range(round(until / poll.period)):
        start = offset + k * poll.period
        for other in others:
            for n in range(-1, round(until / other.period) + 2):
                at = other.base + n * other.period
                total += max(0.0, min(start + poll.cost, at + other.cost) - max(start, at))
    return total


@given(st.lists(st.tuples(PERIODS, st.floats(0.001, 0.04), st.floats(0, 0.99)), min_size=1, max_size=4), PERIODS)
@settings(max_examples=40)
def test_no_offset_is_quieter_than_the_one_chosen(others: list[tuple[float, float, float]], period: float) -> None:
    polls = []
    for n, (other_period, cost, phase) in enumerate(others):
        polls.append(Poll(str(n), other_period, cost=min(cost, other_period)))
        polls[-1].base = phase * other_period
    poll = Poll("new", period, cost=0.01)
    offset = at_once(quietest_offset(poll, polls, 0.0))
    assert 0 <= offset < period
    chosen = overlap(poll, offset, polls, 2.0)
    tried = [overlap(poll, n / 40 * period, polls, 2.0) for n in range(40)]
    cycles = 2.0 / period
    assert chosen <= min(tried) + cycles * ROUNDING + 1e-6


def test_the_common_divisor_of_two_periods() -> None:
    assert common_divisor(0.25, 1.0) == pytest.approx(0.25)
    assert common_divisor(0.6, 0.25) == pytest.approx(0.05)
    assert common_divisor(1.0, 1 / 3) == pytest.approx(1 / 3)
    assert common_divisor(0.5, 0.5) == 0.5


# the clock


@given(st.floats(0.001, 10.0), st.floats(0.0, 100.0), st.integers(1, 1000))
@example(0.1, 100.0, 1)
def test_r10_an_owner_who_was_late_starts_a_poll_once_even_if_the_clock_stands_on_its_grid(
    period: float, start: float, cycles: int
) -> None:
    """Rounding may put the time before the cycle that is due just then."""
    schedule = Schedule()
    poll = Poll("g", period, phase=0.0)
    schedule.add(poll, start)
    starting = schedule.release(poll.base + cycles * period)
    assert starting == [poll]
    assert poll.missed == cycles
    assert poll.next_due() > poll.base + cycles * period


# nothing holds the loop up


def counted_kinks(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Counts, in its first item, the kinks that are looked at."""
    looked_at = [0]
    kinks = phases_module._kinks

    def counted(*arguments: Any) -> Iterator[tuple[float, float]]:
        for kink in kinks(*arguments):
            looked_at[0] += 1
            yield kink

    monkeypatch.setattr(phases_module, "_kinks", counted)
    return looked_at


def two_hundred() -> list[Poll]:
    periods = (0.25, 0.5, 1.0, 2.0, 0.1, 0.3, 0.7, 5.0)
    return [Poll(str(n), periods[n % len(periods)], cost=0.001) for n in range(200)]


def place_all(schedule: Schedule, now: float = 0.0) -> int:
    """Until every poll has its place; the number of calls that it took."""
    calls = 0
    while schedule.unplaced():
        assert schedule.next_due() <= now
        schedule.release(now)
        calls += 1
    return calls


def test_placing_two_hundred_polls_takes_many_calls_of_a_slice_each(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_at = counted_kinks(monkeypatch)
    polls = two_hundred()
    schedule = running(*polls)
    slices = []
    while schedule.unplaced():
        before = looked_at[0]
        schedule.release(0.0)
        slices.append(looked_at[0] - before)
    assert len(slices) > 100
    assert max(slices) <= SLICE + STRIDE
    assert all(poll.placed for poll in polls)


def test_phases_do_not_depend_on_how_the_work_was_cut_up(monkeypatch: pytest.MonkeyPatch) -> None:
    cut, whole = two_hundred(), two_hundred()
    place_all(running(*cut))
    monkeypatch.setattr(schedule_module, "SLICE", 10**9)
    assert place_all(running(*whole)) == 1
    assert [poll.phase for poll in cut] == [poll.phase for poll in whole]


def test_a_preparation_is_done_a_slice_at_a_time_and_then_the_poll_is_placed() -> None:
    done = [0]

    def work() -> Iterator[int]:
        for _ in range(100):
            done[0] += 10
            yield 10

    poll = Poll("large", 1.0)
    poll.preparation = work()
    schedule = running(poll)
    steps = [done[0]]
    while schedule.unplaced():
        schedule.release(0.0)
        steps.append(done[0])
    assert steps[-1] == 1000
    assert max(b - a for a, b in pairwise([0, *steps])) <= SLICE + 10
    assert poll.placed


def test_a_small_preparation_is_done_at_once_unless_other_work_waits() -> None:
    schedule = Schedule()
    done = []

    def work(name: str) -> Iterator[int]:
        done.append(name)
        yield 1

    for name in ("first", "second"):
        poll = Poll(name, 1.0)
        poll.preparation = work(name)
        schedule.add(poll, 0.0)
    assert done == ["first"]
    place_all(schedule)
    assert done == ["first", "second"]


@pytest.mark.parametrize("calls", [0, 1, 2, 30])
def test_polls_that_are_removed_while_they_are_placed_leave_nothing(calls: int) -> None:
    stays, polls = Poll("stays", 0.4, phase=0.1), two_hundred()
    for poll in polls[::2]:
        poll.preparation = iter([10] * 30)
    schedule = running(stays, *polls)
    for _ in range(calls):
        schedule.release(0.0)
    for poll in polls:
        schedule.remove(poll)
    assert not schedule.unplaced()
    assert schedule.next_due() == pytest.approx(0.1)
    assert {name for _, name in released(schedule, 10.0)} == {"stays"}


def test_a_large_cycle_is_started_so_many_exchanges_at_a_time() -> None:
    poll = Poll("large", 10.0, phase=0.0)
    large = members(*range(1, 201))
    set_members(poll, large)
    schedule = running(poll)
    begun: list[Transaction] = []
    while schedule.next_due() <= 0.0:
        piece = schedule.begin(0.0)
        assert len(piece) <= AT_ONCE
        assert poll.running
        begun += piece
    assert begun == large
    assert schedule.next_due() == pytest.approx(10.0)


def test_a_poll_that_is_removed_while_its_cycle_starts_queues_no_more() -> None:
    poll = Poll("large", 10.0, phase=0.0)
    set_members(poll, members(*range(1, 201)))
    schedule = running(poll)
    assert len(schedule.begin(0.0)) == AT_ONCE
    schedule.remove(poll)
    assert schedule.begin(0.0) == []
    assert schedule.next_due() == inf


def test_polls_that_are_all_due_at_once_start_a_number_at_a_time_and_none_is_missed() -> None:
    polls = [Poll(str(n), 1.0, phase=0.0) for n in range(200)]
    schedule = running(*polls)
    started = []
    while schedule.next_due() <= 0.0:
        piece = schedule.release(0.0)
        assert len(piece) <= AT_ONCE
        started += piece
    assert started == polls
    assert not any(poll.missed for poll in polls)


def test_a_demand_waits_until_the_poll_is_prepared() -> None:
    poll = Poll("large", 10.0, phase=5.0)
    [member] = members(1)

    def work() -> Iterator[int]:
        yield 2 * SLICE
        set_members(poll, [member])

    poll.preparation = work()
    schedule = running(poll)
    schedule.demand(poll)
    assert schedule.begin(0.0) == [member]
    assert poll.due == 0.0
    assert schedule.next_due() == pytest.approx(5.0)
    poll.remaining, poll.preparation = 0, work()
    schedule.prepare(poll, 1.0)
    assert schedule.begin(1.0) == [], "it was demanded once"


def test_a_demand_runs_one_cycle_at_once_and_leaves_the_grid_alone() -> None:
    poll = Poll("a", 10.0, phase=5.0)
    [member] = members(1)
    set_members(poll, [member])
    schedule = running(poll)
    schedule.demand(poll)
    assert schedule.begin(1.0) == [member]
    assert schedule.next_due() == pytest.approx(5.0)


def test_a_cycle_has_begun_when_its_first_request_went_out() -> None:
    bench = Bench()
    poll = bench.poll(up(bench), 10.0, 1, 2)
    assert poll.started == -inf
    bench.until_sent()
    begun = bench.now
    assert poll.started == begun
    bench.answer()
    bench.until_sent()
    assert bench.now > begun
    assert poll.started == begun


def test_r10_a_phase_that_was_chosen_counts_from_the_first_poll_of_the_line() -> None:
    """The phases of all groups can then be compared."""
    bench = Bench()
    node = up(bench)
    first = bench.poll(node, 0.5, 1)
    bench.wait(1.37)
    second = Poll("second", 0.4)
    set_members(second, [Transaction(node, hcp2.Read(2))], Priority.POLL)
    bench.arbiter.add_poll(second, bench.now)
    while not bench.cycles or bench.cycles[-1] is not second:
        bench.until_sent()
        bench.answer()
    assert second.phase is not None
    assert first.phase == 0.0
    periods = (second.due - first.due - second.phase) / 0.1  # of both
    assert periods == pytest.approx(round(periods))
    assert 0.0 <= second.phase < 0.4
