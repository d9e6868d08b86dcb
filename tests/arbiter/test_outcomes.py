"""Outcomes are true: what may have been carried out is never said not to be, a bug is called a bug (R7)."""

from __future__ import annotations

from typing import Any

import pytest

from busmaster.arbiter.events import MaxReplyDelayLowered, MaxReplyDelayRaised, Sampled
from busmaster.arbiter.health import CALM_MAX_REPLY_DELAY, Health, NodeRecord
from busmaster.arbiter.transaction import Priority
from busmaster.contract.exchange import OTHER_FORMAT, Command
from busmaster.contract.timing import Timings
from busmaster.errors import BusError, GarbledReply, NoReply, Refused, Superseded, WriteUnconfirmed
from busmaster.protocols._comms.codec import Reading, Writing
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.modbus import codec as modbus
from tests.arbiter.bench import (
    ACK,
    FIVE,
    MAX_REPLY_DELAY,
    NAK,
    QUIET,
    READ_1_OF_NODE_1,
    TAU,
    WRITE_5,
    Bench,
    lost,
    request_of,
    up,
)

REQUEST = 8 * TAU
URGENT = Priority.URGENT
WRITE_0 = "07 30 31 02 30 31 30 03 31"


def write(value: int = 5, *, idempotent: bool = False) -> hcp2.Write:
    return hcp2.Write(1, (value,), idempotent=idempotent)


# what may have been carried out


def test_r7_a_write_that_was_not_answered_and_then_overtaken_is_unconfirmed_not_superseded() -> None:
    bench = Bench()
    node = up(bench)
    enable = bench.ask(node, write(5, idempotent=True), retries=2)
    assert bench.sent() == WRITE_5
    bench.hear("FF", after=REQUEST + 0.110)
    assert enable.attempts == 1
    assert not bench.ended(enable), "it waits for its repetition"
    bench.ask(node, write(0), priority=URGENT)
    bench.listen()
    assert isinstance(enable.error, WriteUnconfirmed)


def test_r7_a_write_that_was_not_answered_and_then_refused_is_unconfirmed_not_refused() -> None:
    bench = Bench()
    node = up(bench)
    asked = bench.ask(node, write(5, idempotent=True), retries=2)
    assert bench.sent() == WRITE_5
    bench.until_sent()
    bench.answer()
    for _ in range(2):
        if not bench.ended(asked):
            bench.until_sent()
            assert bench.sent() == WRITE_5
            bench.hear(NAK, after=0.004)
    assert isinstance(asked.error, WriteUnconfirmed)
    assert not isinstance(asked.error, Refused)


def test_r7_a_write_whose_ack_may_have_lost_a_bit_is_unconfirmed_and_sent_once() -> None:
    """Mentor II's EOT is an ACK with one bit flipped."""
    bench = Bench()
    asked = bench.ask(bench.node(1, mentor.PROFILE), mentor.Write(1, 17, 100))
    bench.sent()
    bench.hear("04", after=0.030)
    assert isinstance(asked.error, WriteUnconfirmed)
    bench.until_ready()
    assert bench.sent() == ""


def test_r7_a_write_answered_in_another_format_is_to_be_read_back_first() -> None:
    bench = Bench()
    asked = bench.ask(bench.node(1, modbus.PROFILE), modbus.WriteRegisters(100, (5,)))
    bench.sent()
    bench.hear(modbus.with_crc(bytes.fromhex("01 06 00 65 00 05")).hex(), after=0.030)
    assert isinstance(asked.error, WriteUnconfirmed)
    assert "of another format" in asked.error.what
    assert asked.error.hint == WriteUnconfirmed.hint


def test_a_read_answered_in_another_format_has_the_hint_of_its_reader() -> None:
    bench = Bench()
    read = bench.ask(bench.node(1, mentor.PROFILE), mentor.Read(1, 17), retries=0)
    bench.sent()
    bench.hear("02 30 31 31 37 2b 34 37 2e 36 03 34", after=0.030)
    assert isinstance(read.error, GarbledReply)
    assert read.error.what.startswith("12 bytes came, right in their check but of another format: b'+47.6'")
    assert read.error.hint == OTHER_FORMAT


def test_r7_a_write_that_was_never_sent_is_superseded() -> None:
    bench = Bench()
    node = up(bench)
    bench.ask(node)
    waiting = bench.ask(node, write(5, idempotent=True))
    bench.ask(node, write(0), priority=URGENT)
    bench.listen()
    assert isinstance(waiting.error, Superseded)


def test_r7_a_write_that_was_refused_twice_was_not_carried_out() -> None:
    bench = Bench()
    asked = bench.ask(up(bench), write(5, idempotent=True), retries=2)
    for _ in range(2):
        assert bench.sent() == WRITE_5
        bench.hear(NAK, after=0.004)
    assert isinstance(asked.error, Refused)


def test_r7_a_write_that_was_refused_and_then_not_answered_is_unconfirmed() -> None:
    bench = Bench()
    asked = bench.ask(up(bench), write(5))
    assert bench.sent() == WRITE_5
    bench.hear(NAK, after=0.004)
    assert bench.sent() == WRITE_5
    bench.until_ready()
    assert isinstance(asked.error, WriteUnconfirmed)


def test_r7_a_write_says_what_else_came_after_it_was_not_answered() -> None:
    bench = Bench()
    node = up(bench)
    asked = bench.ask(node, write(5, idempotent=True), retries=2)
    bench.wait(REQUEST + 0.110)
    bench.arbiter.line_down("unplugged", bench.now)
    assert isinstance(asked.error, WriteUnconfirmed)
    assert "unplugged" in str(asked.error)


# a refused read


def test_r7_a_first_refusal_of_a_read_costs_the_max_reply_delay_and_the_second_its_silence_alone() -> None:
    """A parameter that a drive lacks: the second NAK is what the first one was, and no reply can follow it."""
    bench = Bench()
    node = up(bench)
    refused, following = bench.ask(node, hcp2.Read(9)), bench.ask(node)
    bench.sent()
    bench.hear(NAK, after=REQUEST + 0.002)
    assert bench.until_sent() == pytest.approx(MAX_REPLY_DELAY - 0.002)
    assert bench.sent() == READ_1_OF_NODE_1
    bench.hear(FIVE, after=0.004)
    assert bench.sent() == request_of(9)
    bench.hear(NAK, after=REQUEST + 0.002)
    assert isinstance(refused.error, Refused)
    bench.ask(node, hcp2.Read(3))
    assert bench.until_sent() == pytest.approx(QUIET)
    assert following.value == 5.0


# a bug in a protocol's reader


class Buggy(Reading):
    """Cannot read a 5."""

    def parse(self, field: bytes) -> float:
        if field == b"5":
            raise ZeroDivisionError("boom")
        return super().parse(field)


class BuggyRead(hcp2.Read):
    def open(self, address: int, timings: Timings) -> Reading:
        sound = super().open(address, timings)
        return Buggy(sound.request, sound.answers[0], timings.read)


class BuggyWriting(Writing):
    def feed(self, data: bytes) -> Any:
        raise KeyError("boom")


class BuggyWrite(hcp2.Write):
    def open(self, address: int, timings: Timings) -> BuggyWriting:
        return BuggyWriting(super().open(address, timings).request, timings.write)


def test_a_bug_in_a_reader_is_called_one_and_is_not_met_again() -> None:
    bench = Bench()
    node = up(bench)
    read = bench.ask(node, BuggyRead(1), retries=2)
    bench.sent()
    bench.hear(FIVE, after=0.004)
    assert type(read.error) is BusError
    assert isinstance(read.error.__cause__, ZeroDivisionError)
    assert "bug in the hcp2 reader" in str(read.error)
    assert "wiring" not in str(read.error)
    assert read.attempts == 1


def test_a_bug_in_a_reader_of_a_write_leaves_it_unconfirmed() -> None:
    bench = Bench()
    asked = bench.ask(up(bench), BuggyWrite(1, (5,)), idempotent=True, retries=2)
    bench.sent()
    bench.hear(ACK, after=0.004)
    assert isinstance(asked.error, WriteUnconfirmed)
    assert "bug" in str(asked.error)
    assert asked.attempts == 1


def test_a_bug_in_a_reader_is_no_dead_node_and_the_line_goes_on() -> None:
    bench = Bench()
    node = up(bench)
    for _ in range(4):
        bench.served(bench.ask(node, BuggyRead(1), retries=0))
        bench.until_ready()
        bench.wait(0.5)
    assert (node.health, node.counters.garbled) == (Health.UP, 4)
    assert bench.served(bench.ask(node, hcp2.Read(3))).value == 5.0


# a maximum reply delay that was raised


def raised(bench: Bench) -> NodeRecord:
    node = up(bench)
    bench.ask(node, retries=0)
    bench.sent()
    bench.hear(FIVE, after=REQUEST + 0.140)
    bench.until_ready()
    assert [type(event) for event in bench.events if isinstance(event, MaxReplyDelayRaised)] == [MaxReplyDelayRaised]
    assert node.max_reply_delay == pytest.approx(0.224)
    return node


def lowered(bench: Bench) -> list[MaxReplyDelayLowered]:
    return [event for event in bench.events if isinstance(event, MaxReplyDelayLowered)]


def test_r3_a_raised_max_reply_delay_comes_down_after_an_hour_of_prompt_replies() -> None:
    assert CALM_MAX_REPLY_DELAY == 3600.0, "as docs/promises.md says"
    bench = Bench()
    node = raised(bench)
    bench.wait(CALM_MAX_REPLY_DELAY - 1.0)
    bench.served(bench.ask(node))
    assert node.max_reply_delay == pytest.approx(0.224)
    assert not lowered(bench)
    bench.wait(2.0)
    bench.served(bench.ask(node))
    assert node.max_reply_delay == 0.150
    assert [(event.node, event.max_reply_delay) for event in lowered(bench)] == [(node, 0.150)]


def test_r3_a_late_reply_within_the_hour_keeps_a_raised_max_reply_delay_for_another() -> None:
    bench = Bench()
    node = raised(bench)
    bench.wait(CALM_MAX_REPLY_DELAY / 2)
    bench.ask(node)
    bench.until_sent()
    bench.answer(after=REQUEST + 0.080)
    assert (node.counters.late, node.counters.overdue) == (2, 1), "the one before raised it"
    bench.wait(CALM_MAX_REPLY_DELAY / 2 + 2.0)
    bench.served(bench.ask(node))
    assert node.max_reply_delay == pytest.approx(0.224)


def test_r3_a_max_reply_delay_raised_twice_comes_down_to_what_it_was_before_both() -> None:
    bench = Bench()
    node = raised(bench)
    bench.wait(11.0)
    bench.ask(node, retries=0)
    bench.until_sent()
    bench.sent()
    bench.hear(FIVE, after=REQUEST + 0.200)
    bench.until_ready()
    assert node.max_reply_delay == pytest.approx(0.320)
    bench.wait(CALM_MAX_REPLY_DELAY + 1.0)
    bench.served(bench.ask(node))
    assert node.max_reply_delay == 0.150


def test_r7_what_a_read_ends_with_is_of_its_last_attempt() -> None:
    bench = Bench()
    node = up(bench)
    silent, garbled = bench.ask(node, retries=0), bench.ask(node, hcp2.Read(3), retries=0)
    bench.sent()
    bench.until_sent()
    bench.sent()
    bench.hear("FF", after=0.004)
    assert isinstance(silent.error, NoReply)
    assert isinstance(garbled.error, GarbledReply)


def test_r7_a_point_that_is_refused_in_two_cycles_is_polled_every_ten_seconds_from_then_on() -> None:
    bench = Bench()
    node = up(bench)
    start = bench.now
    bench.poll(node, 1.0, 3)
    cycles: list[int] = []
    while len(cycles) < 4:
        bench.until_sent(limit=20.0)
        assert bench.sent() == request_of(3)
        bench.hear(NAK, after=0.004)
        if (cycle := int(bench.now - start)) not in cycles:
            cycles.append(cycle)
    assert cycles == [0, 1, 12, 23]


@pytest.mark.parametrize("command", [hcp2.Read(3), write(5, idempotent=True)])
def test_r15_what_may_be_repeated_is_asked_once_more_after_a_nak_that_may_be_anothers(command: Command[Any]) -> None:
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, other, write(5))
    asked = bench.ask(node, command, retries=0, priority=Priority.URGENT)
    bench.until_sent()
    bench.sent()
    bench.hear(NAK, after=0.002)
    bench.served(asked)
    assert (asked.error, asked.attempts) == (None, 2)


def test_what_a_removed_poll_has_queued_is_never_sent_and_what_it_has_on_the_wire_reaches_nobody() -> None:
    bench = Bench()
    node = up(bench)
    poll = bench.poll(node, 10.0, 3, 4)
    bench.until_sent()
    assert bench.sent() == request_of(3)
    bench.arbiter.remove_poll(poll, bench.now)
    bench.events.clear()
    bench.answer()
    bench.wait(20.0)
    assert (bench.sent(), bench.cycles) == ("", [])
    assert not any(isinstance(event, Sampled) for event in bench.events)
