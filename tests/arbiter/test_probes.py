"""When a dead node is asked whether it is back, and what that may cost (R11, R15)."""

from __future__ import annotations

from math import inf

import pytest

from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.health import (
    BUDGET_CAPACITY,
    FIRST_PROBE_DELAY,
    STEADY,
    Health,
    NodeRecord,
    ProbeBudget,
    note_failure,
    note_success,
)
from busmaster.arbiter.probes import Probes
from busmaster.contract.profile import Profile
from busmaster.errors import NodeDown, NoReply
from busmaster.protocols._comms.codec import CHECKED
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc
from tests.arbiter.bench import MAX_REPLY_DELAY, NAK, READ_1_OF_NODE_1, TAU, Bench, dead, request_of, up

UNKNOWN, UP, SUSPECT, DOWN, _ = Health
PROBE_COST = 0.150
REQUEST = 8 * TAU


def node() -> NodeRecord:
    return NodeRecord(hcp2.PROFILE, 1, hcp2.PROFILE.timings, 2)


def fail(record: NodeRecord, now: float) -> Health:
    note_failure(record, now, lambda: 0.5)
    return record.health


def beside_a_live_node(bench: Bench) -> NodeRecord:
    """A dead node 1, and a node 2 that is polled so often that no probe is free."""
    live, record = up(bench, 2), dead(bench)
    bench.poll(live, 0.1, 50)
    return record


def until_probed(bench: Bench, limit: float = 40.0) -> float:
    """Turn the clock, node 2 answering, until node 1 is asked; returns how long that took."""
    start = bench.now
    while bench.now - start < limit:
        bench.until_sent()
        if bench.sent()[3:8] == "30 31":
            return bench.now - start
        bench.answer()
    raise AssertionError("it is not probed")


def test_r11_beside_live_nodes_probes_are_cheap_reads_at_delays_that_double_up_to_thirty_seconds() -> None:
    bench = Bench()
    record = beside_a_live_node(bench)
    delays, probes = [], []
    until_probed(bench)
    bench.wait(REQUEST + MAX_REPLY_DELAY + 0.0001)
    for _ in range(8):
        delays.append(record.probe_delay)
        waited = until_probed(bench)
        assert waited == pytest.approx(record.probe_delay, abs=0.2)
        probes.append(bench.asked)
        bench.wait(REQUEST + MAX_REPLY_DELAY + 0.0001)
    assert delays == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0, 30.0]
    assert probes[-3:] == [READ_1_OF_NODE_1] * 3, "its cheapest read"


def test_r15_probes_that_follow_one_another_never_ask_for_what_is_overdue() -> None:
    """The reply to the one before may still come, and would be taken for its own."""
    bench = Bench()
    dead(bench)
    asked = [READ_1_OF_NODE_1]
    while len(asked) < len(CHECKED):
        bench.until_sent()
        asked.append(bench.sent())
        bench.wait(0.2)
    assert len(set(asked)) == len(asked)
    assert set(asked) <= {request_of(element) for element in CHECKED}


@pytest.mark.parametrize("drawn", [0.0, 0.25, 1.0])
def test_r11_the_delay_is_jittered_by_a_fifth(drawn: float) -> None:
    record = node()
    note_failure(record, 7.0, lambda: drawn)
    assert record.probe_at == pytest.approx(7.0 + 0.5 * (0.8 + 0.4 * drawn))


def test_r11_a_node_that_dies_again_soon_is_probed_at_longer_delays() -> None:
    record = node()
    for death, delay in ((0.0, 0.5), (10.0, 1.0), (20.0, 2.0), (20.0 + 2 * STEADY, 0.5)):
        record.failures = 2
        assert fail(record, death) is DOWN
        assert record.probe_delay == delay
        note_success(record, death + 1.0)


def test_r11_a_caller_that_asks_a_dead_node_does_not_put_off_its_probe() -> None:
    record = node()
    fail(record, 0.0)
    due = record.probe_at
    fail(record, 0.1)
    assert (record.probe_at, record.probe_delay) == (due, FIRST_PROBE_DELAY)


def test_r11_a_refused_probe_is_an_answer() -> None:
    bench = Bench()
    record = dead(bench)
    bench.until_sent()
    bench.sent()
    bench.hear(NAK, after=0.004)
    assert record.health is UP


def test_r11_when_one_node_returns_the_others_are_probed_at_once() -> None:
    bench = Bench()
    first, second = dead(bench), bench.node(2)
    bench.ask(second, retries=0)
    bench.until_ready()
    bench.sent()
    assert second.health is DOWN
    second.probe_at = second.probed_at = bench.now + 25.0
    bench.until_sent()
    bench.answer()
    assert first.health is UP
    assert bench.until_sent() < 0.01
    assert second.counters.probes == 1


def test_r11_a_flapping_node_that_returns_tells_nothing_about_the_others() -> None:
    bench = Bench()
    flapping, other = dead(bench), bench.node(2)
    flapping.up_since = bench.now
    bench.ask(other, retries=0)
    bench.until_ready()
    bench.sent()
    assert other.health is DOWN
    other.probe_at = other.probed_at = due = bench.now + 25.0
    bench.until_sent()
    bench.answer()
    bench.arbiter.dispatcher.probes.budget.tokens = 0.2
    bench.wait(0.5)
    assert other.probe_at == due
    assert flapping.health is UP
    assert other.counters.probes == 0


@pytest.mark.parametrize(
    "profile", [hcp.PROFILE, hcp2.PROFILE, mentor.PROFILE, dc104.PROFILE, msc.PROFILE], ids=lambda profile: profile.name
)
def test_r11_on_an_idle_line_a_lone_dead_node_is_never_left_alone_for_more_than_a_second(profile: Profile) -> None:
    """Whenever it comes back, however long it was away: nobody else wants the line."""
    bench = Bench()
    bench.arbiter.byte_time = profile.line.byte_time
    record = bench.node(profile.addresses[-1], profile)
    bench.wait(2.0)
    bench.ask(record, profile.probe, retries=0)
    bench.sent()
    bench.until_ready()
    longest = 0.0
    while bench.now < 200.0:
        longest = max(longest, bench.until_sent(limit=60.0))
        bench.sent()
        bench.until_ready()
    assert longest <= 1.0


# what they may cost


def test_r11_a_busy_line_earns_two_percent_of_its_time() -> None:
    budget = ProbeBudget(0.0)
    while budget.take(PROBE_COST, 0.0):
        pass
    budget.tokens = 0.0
    assert not budget.take(PROBE_COST, 7.4)
    assert budget.take(PROBE_COST, 7.6)


def test_r11_a_quarter_of_a_pause_is_earned_as_far_as_it_is_longer_than_a_probe() -> None:
    budget = ProbeBudget(0.0)
    budget.tokens = 0.0
    budget.probe = PROBE_COST
    budget.idle(0.1, over=True)
    assert budget.tokens == 0.0
    budget.idle(0.55, over=True)
    assert budget.tokens == pytest.approx(0.1)


def test_r11_pauses_of_a_line_that_are_shorter_than_a_probe_earn_nothing_however_many_they_are() -> None:
    bench = Bench()
    live, budget = up(bench), bench.arbiter.dispatcher.probes.budget
    budget.tokens, budget.probe = 0.0, PROBE_COST
    for element in range(1, 11):
        bench.wait(0.9 * PROBE_COST)
        bench.served(bench.ask(live, hcp2.Read(element)))
    assert budget.tokens == 0.0
    bench.wait(2 * PROBE_COST)
    bench.served(bench.ask(live))
    assert budget.tokens > 0.0


@pytest.mark.parametrize("looks", [1, 2, 11])
def test_r11_a_pause_earns_as_much_however_often_it_is_looked_at(looks: int) -> None:
    budget = ProbeBudget(0.0)
    budget.tokens = 0.0
    budget.probe = 1.0
    for _ in range(looks - 1):
        budget.idle(2.0 / looks, over=False)
    budget.idle(2.0 / looks, over=True)
    budget.idle(0.9, over=True)
    assert budget.tokens == pytest.approx(0.25)


def test_r11_after_a_return_a_fifth_of_the_line_for_thirty_seconds() -> None:
    budget = ProbeBudget(0.0)
    budget.tokens = 0.0
    budget.node_returned(100.0)
    budget.tokens = 0.0
    assert budget.take(0.2, 101.0)
    budget.tokens = 0.0
    assert budget.wait_for(0.1, 101.0) == pytest.approx(0.5)
    assert budget.wait_for(0.01, 130.0) == pytest.approx(0.5), "the thirty seconds are over"
    assert budget.take(0.4, 140.0)
    budget.tokens = 0.0
    assert not budget.take(0.2, 149.0)


def test_r11_what_is_missing_is_awaited_for_a_millisecond_at_least() -> None:
    budget = ProbeBudget(0.0)
    assert budget.wait_for(0.1, 0.0) == 0.001, "the timer would run all the time"


def test_r11_the_bucket_holds_no_more_than_its_capacity_and_a_full_one_pays_for_anything() -> None:
    budget = ProbeBudget(0.0)
    budget.idle(100.0, over=True)
    assert budget.tokens == BUDGET_CAPACITY
    assert budget.take(2.0, 0.0)
    assert not budget.take(0.1, 50.0)


def test_r11_a_probe_that_is_answered_costs_what_it_took() -> None:
    bench = Bench()
    beside_a_live_node(bench)
    until_probed(bench)
    before = bench.arbiter.dispatcher.probes.budget.tokens
    bench.answer()
    assert bench.arbiter.dispatcher.probes.budget.tokens == pytest.approx(before + PROBE_COST - 0.004, abs=0.002)


def test_r11_a_probe_that_was_free_gives_nothing_back() -> None:
    bench = Bench()
    record = dead(bench)
    bench.until_sent()
    bench.sent()
    budget = bench.arbiter.dispatcher.probes.budget
    budget.tokens = 0.1
    bench.answer()
    assert record.health is UP
    assert budget.tokens == pytest.approx(0.1, abs=0.05), "but what the time since has earned"


def test_r11_a_request_to_a_dead_node_is_tried_once_while_the_budget_allows_and_then_fails_at_once() -> None:
    bench = Bench()
    record = dead(bench)
    record.probe_at = record.probed_at = inf
    attempts = []
    for _ in range(6):
        read = bench.ask(record)
        fails_at_once = read.error is not None
        bench.until_ready()
        attempts.append(read.attempts)
        assert isinstance(read.error, NodeDown if fails_at_once else NoReply)
    assert attempts == [1, 1, 1, 0, 0, 0]


def test_r11_a_request_to_a_dead_node_leaves_what_the_probe_that_is_due_costs() -> None:
    due, now = node(), 7.0
    due.health, due.probe_at = DOWN, now
    probes = Probes(Deadlines(), [due, node()], now)
    probes.budget.tokens = 1.9 * PROBE_COST
    assert not probes.spare(PROBE_COST, now)
    due.probe_at = now + 0.001
    assert probes.spare(PROBE_COST, now)
    assert probes.budget.tokens == pytest.approx(0.9 * PROBE_COST)


def test_r11_a_request_to_a_dead_node_may_spend_what_the_line_has_earned_until_now() -> None:
    probes = Probes(Deadlines(), [node()], 0.0)
    probes.budget.tokens = 0.0
    assert not probes.spare(0.1, 4.9)
    assert probes.spare(0.1, 5.1)


def test_r11_a_node_whose_probe_is_overdue_is_not_kept_waiting_by_one_that_is_not_due() -> None:
    overdue, later = node(), node()
    overdue.health = later.health = DOWN
    overdue.probe_at, overdue.probed_at = 6.0, 5.0
    later.probe_at, later.probed_at = 30.0, 1.0
    probe = Probes(Deadlines(), [later, overdue], 0.0).next(7.0, usable=True, idle=False)
    assert probe is not None
    assert probe.node is overdue


def test_r11_one_probe_at_a_time_is_on_its_way() -> None:
    first, second = node(), node()
    first.health = second.health = DOWN
    first.probe_at = second.probe_at = 6.0
    probes = Probes(Deadlines(), [first, second], 0.0)
    assert probes.next(7.0, usable=True, idle=False) is not None
    assert probes.next(7.1, usable=True, idle=False) is None


def test_r11_an_owner_may_probe_at_any_time() -> None:
    bench = Bench()
    record = dead(bench)
    bench.arbiter.dispatcher.probes.budget.tokens = 0.0
    probe = bench.ask(record, record.profile.probe, probe=True)
    bench.answer()
    assert probe.value == 5.0
    assert record.health is UP


def test_r11_the_polls_of_a_dead_node_are_parked() -> None:
    bench = Bench()
    record = dead(bench)
    record.probe_at = record.probed_at = inf
    poll = bench.poll(record, 0.1, 1, 2)
    bench.wait(0.35)
    assert bench.sent() == ""
    assert len(bench.cycles) >= 3
    assert all(isinstance(t.error, NodeDown) for t in poll.results)


def test_r11_what_waits_for_a_node_that_dies_is_not_sent() -> None:
    bench = Bench()
    record = bench.node()
    first = bench.ask(record, retries=0)
    bench.arbiter.dispatcher.probes.budget.tokens = 0.0
    second = bench.ask(record, hcp2.Read(2))
    bench.wait(0.2)
    assert isinstance(first.error, NoReply)
    assert isinstance(second.error, NodeDown)
    assert second.attempts == 0


def test_r11_polls_of_a_node_never_heard_are_not_retried() -> None:
    bench = Bench()
    record = bench.node()
    poll = bench.poll(record, 1.0, 1)
    bench.wait(0.3)
    assert record.health is DOWN
    assert poll.results[0].attempts == 1


def test_r15_one_nak_to_a_read_that_is_not_repeated_strikes_it_not_from_those_that_clear_the_line() -> None:
    """The NAK may be noise, and a read of a caller that has gone is not repeated."""
    bench = Bench()
    record = up(bench)
    record.answered.clear()
    read = bench.ask(record, record.profile.sync_reads[1])
    bench.until_sent()
    bench.sent()
    bench.arbiter.cancel(read, bench.now)
    bench.hear(NAK, after=0.004)
    assert read.command in [*record.sync_reads()]


def test_r11_free_probes_are_counted_for_their_node_too() -> None:
    bench = Bench()
    record = dead(bench)
    before = record.counters.probes
    for _ in range(3):
        bench.until_sent()
        bench.sent()
        bench.wait(MAX_REPLY_DELAY)
    assert record.counters.probes == before + 3
