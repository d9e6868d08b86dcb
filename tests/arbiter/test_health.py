"""Dead nodes: how they are told, what they may cost, and how they come back (R11)."""

from __future__ import annotations

from math import inf

import pytest

from busmaster.arbiter.events import NodeChanged
from busmaster.arbiter.health import (
    BUDGET_CAPACITY,
    FIRST_PROBE_DELAY,
    PROBE_JITTER,
    STEADY,
    Health,
    NodeRecord,
    ProbeBudget,
    note_failure,
    note_success,
)
from busmaster.arbiter.schedule import Poll
from busmaster.arbiter.transaction import Priority
from busmaster.errors import NodeDown, NoReply, Refused, WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from tests.arbiter.bench import FIVE, NAK, READ_1_OF_NODE_1, WRITE_5, Bench

UNKNOWN, UP, SUSPECT, DOWN = Health
PROBE_COST = 0.150


def node() -> NodeRecord:
    return NodeRecord(hcp2.PROFILE, 1, hcp2.PROFILE.timings, 2)


def no_jitter() -> float:
    return 0.5


def fail(record: NodeRecord, now: float) -> Health:
    note_failure(record, now, no_jitter)
    return record.health


def changes(bench: Bench) -> list[Health]:
    return [event.after for event in bench.events if isinstance(event, NodeChanged)]


def heard(bench: Bench) -> NodeRecord:
    """A node that is UP."""
    record = bench.node()
    bench.ask(record)
    bench.sent()
    bench.hear(FIVE, after=0.004)
    return record


def dead(bench: Bench) -> NodeRecord:
    """A node that was never heard, and did not answer."""
    record = bench.node()
    bench.ask(record, retries=0)
    bench.wait(0.2)
    bench.sent()
    assert record.health is DOWN
    return record


# what a node's health is


def test_r11_a_node_that_was_never_heard_is_down_after_one_failed_transaction() -> None:
    assert fail(node(), 0.0) is DOWN


def test_r11_a_node_is_down_after_three_failures_and_a_second_without_a_reply() -> None:
    record = node()
    note_success(record, 10.0)
    record.last_reply = 10.0
    assert [fail(record, 10.0 + t) for t in (0.2, 0.4, 0.6)] == [SUSPECT] * 3
    assert fail(record, 11.0) is DOWN


def test_r11_a_second_of_silence_alone_is_not_enough() -> None:
    record = node()
    note_success(record, 10.0)
    record.last_reply = 10.0
    assert [fail(record, t) for t in (20.0, 30.0)] == [SUSPECT] * 2
    assert fail(record, 40.0) is DOWN


def test_r11_a_suspect_is_up_again_after_three_replies_in_a_row_and_five_seconds_without_a_failure() -> None:
    record = node()
    note_success(record, 0.0)
    seen = [fail(record, 1.0)]
    for now in (1.1, 1.2, 1.3, 5.9, 6.1):
        note_success(record, now)
        seen.append(record.health)
    assert seen == [SUSPECT] * 5 + [UP]
    fail(record, 10.0)
    for now in (20.0, 21.0, 22.0):
        assert record.health is SUSPECT
        note_success(record, now)
    assert record.health is UP


def test_a_node_that_answers_every_other_request_is_reported_once() -> None:
    bench = Bench()
    record = heard(bench)
    bench.events.clear()
    for answered in [False, True] * 10:
        bench.ask(record, retries=0)
        bench.sent()
        if answered:
            bench.hear(FIVE, after=0.004)
        else:
            bench.wait(0.2)
    assert changes(bench) == [SUSPECT]


def test_r7_a_suspect_that_fails_gets_no_retries_and_one_that_answered_does() -> None:
    bench = Bench()
    record = heard(bench)
    attempts = []
    for answered in (False, False, True, False):
        read = bench.ask(record)
        bench.sent()
        if answered:
            bench.hear(FIVE, after=0.004)
        else:
            bench.wait(1.0)
            bench.sent()
        attempts.append(read.attempts)
    assert attempts == [3, 1, 1, 3]


def test_r11_broadcasts_that_fail_are_no_dead_node_and_the_dead_are_probed_all_the_same() -> None:
    bench = Bench(echo=True)
    everybody, drive = bench.node(0, mentor.PROFILE), bench.node(12, mentor.PROFILE)
    for node in (everybody, drive):
        write = bench.ask(node, mentor.Write(1, 17, 0), retries=0)
        bench.sent()
        bench.hear("FF")
        assert isinstance(write.error, WriteUnconfirmed)
        bench.wait(0.5)
    assert (drive.health, everybody.health) == (DOWN, UNKNOWN)
    bench.wait(60.0)
    assert drive.counters.probes > 2


# probes


def test_r11_probes_are_the_cheapest_read_at_delays_that_double_up_to_thirty_seconds() -> None:
    bench = Bench()
    record = dead(bench)
    delays = []
    for _ in range(9):
        delays.append(record.probe_delay)
        bench.until_sent(limit=40.0)
        assert bench.sent() == READ_1_OF_NODE_1
        bench.wait(0.2)
    assert delays == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0, 30.0]


@pytest.mark.parametrize("drawn", [0.0, 0.25, 1.0])
def test_r11_the_delay_is_jittered_by_a_fifth(drawn: float) -> None:
    record = node()
    note_failure(record, 7.0, lambda: drawn)
    assert record.probe_at == pytest.approx(7.0 + FIRST_PROBE_DELAY * (1 + PROBE_JITTER * (2 * drawn - 1)))


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
    for _ in range(2):
        bench.until_sent()
        bench.sent()
        bench.hear(NAK, after=0.004)
    assert record.health is UP


def test_r11_when_one_node_returns_the_others_are_probed_at_once() -> None:
    bench = Bench()
    first, second = dead(bench), bench.node(2)
    bench.ask(second, retries=0)
    bench.wait(0.2)
    bench.sent()
    second.probe_at = bench.now + 25.0
    bench.until_sent()
    bench.sent()
    bench.hear(FIVE, after=0.004)
    assert first.health is UP
    assert bench.until_sent() < 0.01
    assert second.counters.probes == 1


def test_r11_a_flapping_node_that_returns_tells_nothing_about_the_others() -> None:
    bench = Bench()
    flapping, other = dead(bench), bench.node(2)
    flapping.up_since = bench.now
    bench.ask(other, retries=0)
    bench.wait(0.2)
    bench.sent()
    other.probe_at = bench.now + 25.0
    bench.until_sent()
    bench.sent()
    bench.hear(FIVE, after=0.004)
    bench.wait(1.0)
    assert flapping.health is UP
    assert other.counters.probes == 0


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
    budget.idle(0.1)
    assert budget.tokens == 0.0
    budget.idle(0.55)
    assert budget.tokens == pytest.approx(0.1)


def test_r11_after_a_return_a_fifth_of_the_line_for_thirty_seconds() -> None:
    budget = ProbeBudget(0.0)
    budget.tokens = 0.0
    budget.node_returned(100.0)
    budget.tokens = 0.0
    assert budget.take(0.2, 101.0)
    budget.tokens = 0.0
    assert budget.wait_for(0.1, 101.0) == pytest.approx(0.5)
    assert budget.take(0.4, 140.0)
    budget.tokens = 0.0
    assert not budget.take(0.2, 149.0)


def test_r11_the_bucket_holds_no_more_than_its_capacity_and_a_full_one_pays_for_anything() -> None:
    budget = ProbeBudget(0.0)
    budget.idle(100.0)
    assert budget.tokens == BUDGET_CAPACITY
    assert budget.take(2.0, 0.0)
    assert not budget.take(0.1, 50.0)


def test_r11_a_probe_that_is_answered_costs_what_it_took() -> None:
    bench = Bench()
    dead(bench)
    bench.until_sent()
    before = bench.arbiter.dispatcher._budget.tokens
    bench.hear(FIVE, after=0.004)
    assert bench.arbiter.dispatcher._budget.tokens == pytest.approx(before + PROBE_COST - 0.004, abs=0.002)


def test_r11_a_request_to_a_dead_node_is_tried_once_while_the_budget_allows_and_then_fails_at_once() -> None:
    bench = Bench()
    record = dead(bench)
    record.probe_at = inf
    attempts = []
    for _ in range(6):
        read = bench.ask(record)
        attempts.append(read.attempts)
        if read.error is None:
            bench.wait(0.2)
            assert isinstance(read.error, NoReply)
        else:
            assert isinstance(read.error, NodeDown)
    assert attempts == [1, 1, 1, 0, 0, 0]


def test_r11_an_owner_may_probe_at_any_time() -> None:
    bench = Bench()
    record = dead(bench)
    bench.arbiter.dispatcher._budget.tokens = 0.0
    probe = bench.ask(record, record.profile.probe, probe=True)
    bench.sent()
    bench.hear(FIVE, after=0.004)
    assert probe.value == 5.0
    assert record.health is UP


def test_r11_the_polls_of_a_dead_node_are_parked() -> None:
    bench = Bench()
    record = dead(bench)
    record.probe_at = inf
    poll = bench.poll(record, 0.1, 1, 2)
    bench.wait(0.35)
    assert bench.sent() == ""
    assert len(bench.cycles) >= 3
    assert all(isinstance(t.error, NodeDown) for t in poll.results)


def test_r11_what_waits_for_a_node_that_dies_is_not_sent() -> None:
    bench = Bench()
    record = bench.node()
    first = bench.ask(record, retries=0)
    bench.arbiter.dispatcher._budget.tokens = 0.0
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


# coming back


def returned(bench: Bench, record: NodeRecord) -> None:
    bench.until_sent(limit=40.0)
    bench.sent()
    bench.hear(FIVE, after=0.004)
    assert record.health is UP


def test_r11_the_first_reply_brings_it_up_and_its_polls_resume_on_the_grid() -> None:
    bench = Bench()
    record = dead(bench)
    poll = bench.poll(record, 0.1, 1)
    returned(bench, record)
    bench.sent()
    bench.until_sent()
    assert bench.sent() == READ_1_OF_NODE_1
    assert (poll.due - poll.base) / poll.period == pytest.approx(round((poll.due - poll.base) / poll.period))
    assert bench.now - poll.due < 0.001


def test_r11_polls_wait_for_the_hook_of_a_node_that_returns() -> None:
    bench = Bench()
    record = dead(bench)
    record.has_hook = True
    poll = bench.poll(record, 0.1, 1)
    returned(bench, record)
    event = next(e for e in bench.events if isinstance(e, NodeChanged) and e.after is UP)
    assert event.returning
    bench.wait(0.35)
    assert bench.sent() == ""
    assert isinstance(poll.results[0].error, NodeDown)
    bench.arbiter.dispatcher.release_node(record)
    assert bench.until_sent() < 0.101


def test_r11_a_node_that_returns_twice_waits_for_both_runs_of_its_hook() -> None:
    bench = Bench()
    record = dead(bench)
    record.has_hook = True
    returned(bench, record)
    record.failures, record.last_reply = 2, bench.now - 2.0
    bench.ask(record, retries=0)
    bench.wait(0.2)
    bench.sent()
    assert record.health is DOWN
    returned(bench, record)
    bench.arbiter.dispatcher.release_node(record)
    poll = bench.poll(record, 0.1, 1)
    bench.wait(0.25)
    assert isinstance(poll.results[0].error, NodeDown)
    bench.arbiter.dispatcher.release_node(record)
    assert bench.until_sent() < 0.101


def test_r11_only_a_return_runs_the_hook_not_a_suspicion_that_passes() -> None:
    bench = Bench()
    record = heard(bench)
    record.has_hook = True
    bench.ask(record, retries=0)
    bench.wait(6.0)
    for _ in range(3):
        bench.ask(record)
        bench.sent()
        bench.hear(FIVE, after=0.004)
    assert changes(bench) == [UP, SUSPECT, UP]
    assert not any(e.returning for e in bench.events if isinstance(e, NodeChanged))
    assert not record.holds


# maintenance


def polled(bench: Bench) -> tuple[NodeRecord, Poll]:
    record = heard(bench)
    return record, bench.poll(record, 0.1, 1)


def test_a_suspension_rests_polls_fails_requests_and_ends_by_itself() -> None:
    bench = Bench()
    record, poll = polled(bench)
    bench.arbiter.dispatcher.suspend(record, bench.now + 0.95)
    assert isinstance(bench.ask(record).error, NodeDown)
    bench.wait(0.9)
    assert bench.sent() == ""
    assert "suspended" in str(poll.results[0].error)
    assert bench.until_sent() < 0.101
    assert record.health is UP


def test_a_suspension_fails_what_waits_already() -> None:
    bench = Bench()
    record = heard(bench)
    bench.ask(record)
    waiting = bench.ask(record)
    bench.arbiter.dispatcher.suspend(record, bench.now + 10.0)
    bench.hear(FIVE, after=0.004)
    assert isinstance(waiting.error, NodeDown)


def test_a_suspended_dead_node_is_not_probed_until_the_suspension_ends() -> None:
    bench = Bench()
    record = dead(bench)
    bench.arbiter.dispatcher.suspend(record, bench.now + 5.0)
    assert bench.until_sent() == pytest.approx(5.0, abs=0.01)


# what a write that was on the wire ends with


def test_r7_a_write_that_waits_for_its_repetition_is_unconfirmed_whatever_ends_it() -> None:
    for cause in ("line", "suspension"):
        bench = Bench()
        record = heard(bench)
        write = bench.ask(record, hcp2.Write(1, (5,)), idempotent=True, retries=2)
        assert bench.sent() == WRITE_5
        bench.wait(0.120)
        assert write.attempts == 1
        if cause == "line":
            bench.arbiter.line_down("unplugged", bench.now)
        else:
            bench.arbiter.dispatcher.suspend(record, bench.now + 10.0)
            bench.wait(0.1)
        assert isinstance(write.error, WriteUnconfirmed)


def test_a_refused_point_is_refused_and_its_node_lives() -> None:
    bench = Bench()
    record = heard(bench)
    read = bench.ask(record, hcp2.Read(2), priority=Priority.POLL)
    for _ in range(2):
        bench.until_sent()
        bench.sent()
        bench.hear(NAK, after=0.004)
    assert isinstance(read.error, Refused)
    assert record.health is UP


def test_r11_polls_that_wait_already_do_not_go_before_the_hook_of_a_node_that_returns() -> None:
    bench = Bench()
    node, other = bench.node(1), bench.node(2)
    node.has_hook = True
    for address in (node, other):
        bench.ask(address)
        bench.hear(FIVE, after=0.004)
    bench.wait(1.5)
    poll = bench.poll(node, 5.0, 1)
    bench.ask(other)
    bench.to(bench.now + 0.001)
    assert poll.remaining
    node.health, node.failures = Health.DOWN, 3
    bench.ask(node, hcp2.Read(1))
    bench.hear(FIVE, after=0.004)
    bench.sent()
    bench.hear(FIVE, after=0.004)
    assert node.health is Health.UP
    assert node.holds == 1
    assert bench.sent() == ""
    assert isinstance(poll.results[0].error, NodeDown)
