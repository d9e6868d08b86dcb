"""One exchange on the wire, its windows, and what may count as its reply (R1, R2, R4, R5)."""

from __future__ import annotations

import pytest

from busmaster.arbiter.counters import LineState
from busmaster.arbiter.events import RepliesLate
from busmaster.arbiter.health import Health
from busmaster.arbiter.on_wire import Step
from busmaster.contract.exchange import Exchange
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import GarbledReply, NoReply, Refused, WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import (
    ACK,
    ANOTHER_ELEMENT,
    BAD_CHECKSUM,
    FIVE,
    MAX_REPLY_DELAY,
    NAK,
    QUIET,
    READ_1_OF_NODE_1,
    SEVEN,
    TAU,
    WRITE_5,
    Bench,
    reply_of,
)

REQUEST = 8 * TAU


def test_a_read_is_sent_at_once_and_its_reply_is_the_value() -> None:
    bench = Bench()
    read = bench.ask(bench.node())
    assert bench.sent() == READ_1_OF_NODE_1
    bench.hear(FIVE, after=0.004)
    assert (read.value, read.error, bench.ended(read)) == (5.0, None, 1)


def test_r1_the_next_request_leaves_only_when_the_reply_is_complete() -> None:
    bench = Bench()
    node = bench.node()
    first, second = bench.ask(node), bench.ask(node)
    assert bench.sent() == READ_1_OF_NODE_1
    bench.hear(FIVE[:8], after=0.003)
    assert bench.sent() == ""
    bench.hear(FIVE[9:], after=0.001)
    assert bench.sent() == READ_1_OF_NODE_1
    bench.hear(SEVEN, after=0.003)
    assert (first.value, second.value) == (5.0, 7.0)


def test_r2_the_window_runs_from_the_end_of_the_request_on_the_wire() -> None:
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    bench.wait(REQUEST + MAX_REPLY_DELAY - 0.0001)
    assert not bench.ended(read)
    bench.wait(0.0002)
    assert isinstance(read.error, NoReply)
    assert str(read.error).startswith("node 1: no reply within 150 ms, 1 attempt")


@pytest.mark.parametrize(
    ("delay", "late"), [(0.049, False), (0.051, True), (0.099, True), (0.101, True), (0.149, True)]
)
def test_r2_a_reply_after_late_after_is_accepted_and_counted_late(delay: float, late: bool) -> None:
    bench = Bench()
    node = bench.node()
    read = bench.ask(node)
    bench.hear(FIVE, after=REQUEST + delay)
    assert read.value == 5.0
    assert node.counters.late == late


def test_r2_behind_a_slow_adapter_the_window_is_longer_by_its_latency() -> None:
    bench = Bench(latency=0.016)
    read = bench.ask(bench.node(), retries=0)
    bench.hear(FIVE, after=REQUEST + 0.115)
    assert read.value == 5.0


def test_r2_a_gap_in_a_reply_ends_the_attempt() -> None:
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    bench.hear(FIVE[:8], after=0.003)
    bench.wait(0.020 + TAU - 0.0001)
    assert not bench.ended(read), "the next start bit may be 20 ms away, and its byte is heard one byte time later"
    bench.wait(0.0002)
    assert isinstance(read.error, GarbledReply)


def test_r2_a_trickle_of_bytes_cannot_hold_the_line() -> None:
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    bench.hear("02", after=REQUEST + 0.099)
    bench.hear("30")
    bench.hear("31")
    longest = hcp2.Read(1).open(1, hcp2.PROFILE.timings).sizes.longest
    start = bench.now
    while read.error is None:
        bench.hear("31", after=0.001)
        assert bench.now - start < 1.0
    assert bench.now <= 1.0 + REQUEST + 0.100 + longest * TAU + 0.020 + TAU + 0.001


def test_r2_the_trickle_of_a_reply_that_began_late_cannot_hold_the_line_either() -> None:
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    began = bench.now + REQUEST + 0.149
    bench.hear("02", after=REQUEST + 0.149)
    bench.hear("30")
    bench.hear("31")
    longest = hcp2.Read(1).open(1, hcp2.PROFILE.timings).sizes.longest
    while read.error is None:
        bench.hear("31", after=0.001)
        assert bench.now - began < 1.0
    assert bench.now <= began + longest * TAU + 0.020 + TAU + 0.001


def test_r2_a_late_reply_may_last_as_long_as_any_other() -> None:
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    bench.wait(REQUEST + 0.1495)
    bench.hear_bytewise(reply_of(1, 123456789))
    assert read.value == 123456789.0


def test_r2_a_write_is_confirmed_by_a_late_ack() -> None:
    bench = Bench()
    write = bench.ask(bench.node(), hcp2.Write(1, (5,)))
    request = len(bytes.fromhex(bench.sent())) * TAU
    bench.hear(ACK, after=request + 0.130)
    assert (bench.ended(write), write.attempts, write.error) == (1, 1, None)


def test_r7_a_late_refusal_of_a_write_is_one_and_is_confirmed_at_once() -> None:
    bench = Bench()
    node = bench.node()
    write = bench.ask(node, hcp2.Write(1, (5,)))
    for _ in range(2):
        request = len(bytes.fromhex(bench.sent())) * TAU
        assert request
        bench.hear(NAK, after=request + 0.130)
    assert isinstance(write.error, Refused)
    assert node.max_reply_delay == pytest.approx(1.6 * 0.130)


def test_r2_where_the_bus_is_closed_no_late_reply_is_awaited() -> None:
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    bench.sent()
    bench.arbiter.close(bench.now)
    bench.wait(REQUEST + 0.1001)
    assert str(read.error).startswith("node 1: no reply within 100 ms")
    assert bench.arbiter.state is LineState.OFFLINE


def test_r2_a_node_that_answers_late_is_told_once_and_again_where_it_is_much_slower() -> None:
    bench = Bench()
    node = bench.node()
    for delay in (0.090, 0.105, 0.106, 0.120, 0.140, 0.141, 0.140):
        bench.ask(node)
        bench.until_sent()
        bench.answer(after=REQUEST + delay)
    told = [event for event in bench.events if isinstance(event, RepliesLate)]
    assert [(event.node, event.window) for event in told] == [(node, 0.100)] * 2
    assert [event.age for event in told] == pytest.approx([0.105, 0.140])
    assert (node.counters.late, node.counters.overdue, node.health) == (7, 6, Health.UP)


def test_r4_on_a_paced_line_bytes_before_the_request_is_out_taint_the_attempt() -> None:
    bench = Bench(paced=True)
    read = bench.ask(bench.node(), retries=0)
    bench.hear(FIVE, after=REQUEST * 0.8)
    assert isinstance(read.error, GarbledReply)
    assert bench.arbiter.state is LineState.RESYNCHRONISING


def test_r4_on_an_unpaced_line_the_reply_may_come_at_once() -> None:
    bench = Bench()
    read = bench.ask(bench.node())
    bench.hear(FIVE)
    assert read.value == 5.0


def test_r5_a_reply_of_another_element_is_never_taken() -> None:
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    bench.hear(ANOTHER_ELEMENT, after=0.004)
    assert isinstance(read.error, GarbledReply)


def test_r5_an_ack_is_no_answer_to_a_read() -> None:
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    bench.hear("06", after=0.004)
    assert isinstance(read.error, GarbledReply)


def test_r3_a_whole_frame_with_the_right_echo_and_a_bad_checksum_is_asked_again_after_the_silence_alone() -> None:
    bench = Bench()
    read = bench.ask(bench.node())
    bench.sent()
    bench.hear(BAD_CHECKSUM, after=0.004)
    assert bench.until_sent() == pytest.approx(QUIET)
    assert bench.sent() == READ_1_OF_NODE_1
    bench.hear(FIVE, after=0.004)
    assert (read.value, read.attempts) == (5.0, 2)


def test_a_value_is_delivered_when_the_loop_slept_through_the_window_but_the_bytes_were_waiting() -> None:
    bench = Bench()
    read = bench.ask(bench.node())
    bench.arbiter.data_received(bytes.fromhex(FIVE), bench.now + 0.4)
    assert read.value == 5.0
    assert read.late


def test_a_write_is_acknowledged() -> None:
    bench = Bench()
    write = bench.ask(bench.node(), hcp2.Write(1, (5,)))
    assert bench.sent() == WRITE_5
    bench.hear("06", after=0.004)
    assert (write.value, write.error) == (None, None)


def test_a_write_without_an_answer_is_unconfirmed_and_not_sent_again() -> None:
    bench = Bench()
    write = bench.ask(bench.node(), hcp2.Write(1, (5,)))
    bench.sent()
    bench.wait(1.0)
    assert isinstance(write.error, WriteUnconfirmed)
    assert WRITE_5 not in bench.sent()


def test_a_bug_in_a_protocols_reader_fails_its_transaction_and_not_the_line() -> None:
    class Broken:
        writes = False
        idempotent = True

        def open(self, address: int, timings: Timings, /) -> Exchange[float]:
            raise RuntimeError("boom")

    bench = Bench()
    node = bench.node()
    broken, sound = bench.ask(node, Broken()), bench.ask(node)
    assert "boom" in str(broken.error)
    assert bench.sent() == READ_1_OF_NODE_1
    bench.hear(FIVE, after=0.004)
    assert sound.value == 5.0


def test_r2_a_reply_window_counts_from_the_last_byte_of_the_echo() -> None:
    step = Step(ReplyTiming(0.05, 0.1, 0.15, 0.01), 0.004, TAU)
    step.begin(ReplyTiming(0.05, 0.1, 0.15, 0.01), 8, 10, 3.0)
    assert step.echoed(5.0) == pytest.approx(5.0 + 0.1 + 0.004)
    assert step.end == pytest.approx(5.0)
