"""Dead nodes: how they are told, what they may cost, and how they come back (R11)."""

from __future__ import annotations

from dataclasses import MISSING, fields

import pytest

from busmaster.arbiter.counters import LineStatistics
from busmaster.arbiter.events import NodeChanged
from busmaster.arbiter.health import (
    MOST_ANSWERED,
    Health,
    NodeRecord,
    note_failure,
    note_success,
)
from busmaster.arbiter.transaction import Poll, Priority
from busmaster.errors import NodeDown, Refused, WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from tests.arbiter.bench import FIVE, NAK, READ_1_OF_NODE_1, WRITE_5, Bench, dead, heard

UNKNOWN, UP, SUSPECT, DOWN, _ = Health


def node() -> NodeRecord:
    return NodeRecord(hcp2.PROFILE, 1, hcp2.PROFILE.timings, 2)


def even() -> float:
    """No jitter."""
    return 0.5


def fail(record: NodeRecord, now: float) -> Health:
    note_failure(record, now, even)
    return record.health


def changes(bench: Bench) -> list[Health]:
    return [event.after for event in bench.events if isinstance(event, NodeChanged)]


# what is remembered of a node


def test_r15_a_few_reads_that_it_has_answered_are_remembered_each_once_and_no_write() -> None:
    record = node()
    reads = [hcp2.Read(element) for element in range(1, MOST_ANSWERED + 2)]
    note = record.note_reply
    note((b"\x06",), hcp2.Write(1, (5,)), 0.004)
    assert record.answered == {}
    note((b"1",), reads[0], 0.004)
    note((b"1",), reads[1], 0.004)
    assert record.answered == {(b"1",): reads[0]}, "two that are answered alike are one"
    for number, read in enumerate(reads):
        note((b"answer %d" % number,), read, 0.004)
    assert len(record.answered) == MOST_ANSWERED
    note((b"1",), hcp2.Write(1, (5,)), 0.004)
    assert record.answered[b"1",] is reads[0]


def test_a_node_that_was_never_asked_has_failed_in_nothing_and_waits_for_nothing() -> None:
    record = node()
    assert (record.health, record.failures, record.unheard, record.silent) == (UNKNOWN, 0, 0, False)
    assert (record.answered, record.holds, record.has_hook) == ({}, 0, False)


def test_a_node_that_waits_for_no_hook_is_not_let_go_twice() -> None:
    bench = Bench()
    record = bench.node()
    bench.arbiter.dispatcher.release_node(record)
    assert record.holds == 0
    record.holds = 2
    bench.arbiter.dispatcher.release_node(record)
    assert record.holds == 1


def test_a_line_of_which_nothing_more_is_known_has_counted_nothing() -> None:
    known = {each.name: each.default for each in fields(LineStatistics) if each.default is not MISSING}
    assert known == {"sync_reads": 0, "ambiguous": 0, "damaged": 0, "breaks": 0, "driver": None}


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
        if answered:
            bench.served(read)
        else:
            bench.until_ready()
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


# coming back


def returned(bench: Bench, record: NodeRecord) -> None:
    bench.until_sent(limit=40.0)
    bench.answer()
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
    bench.sent()
    for _ in range(3):
        bench.served(bench.ask(record))
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


def test_a_suspended_dead_node_is_not_probed_in_the_place_of_another() -> None:
    bench = Bench()
    record, other = dead(bench), bench.node(2)
    bench.ask(other, retries=0)
    bench.wait(0.2)
    bench.sent()
    end = bench.now + 5.0
    bench.arbiter.dispatcher.suspend(record, end)
    probed = []
    while bench.now + bench.until_sent() < end:
        probed.append(bench.sent())
    assert {request[3:8] for request in probed} == {"30 32"}
    assert len(probed) >= 5, "nor does it keep the other waiting"


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
