"""What the UART says of bytes: a damaged one, or a break, is nobody's answer."""

from __future__ import annotations

import pytest

from busmaster.arbiter.counters import LineState, Mark
from busmaster.errors import GarbledReply, WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import ACK, FIVE, MAX_REPLY_DELAY, QUIET, TAU, WRITE_5, Bench, request_of, up

REQUEST = 8 * TAU


def mark(bench: Bench, what: Mark = Mark.DAMAGED, after: float = 0.0) -> None:
    bench.wait(after)
    bench.arbiter.byte_marked(what, bench.now)
    bench.listen()


@pytest.mark.parametrize("what", Mark)
def test_a_marked_byte_fails_the_attempt_and_says_so(what: Mark) -> None:
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    mark(bench, what, after=REQUEST + 0.003)
    assert isinstance(read.error, GarbledReply)
    assert what.value in str(read.error)


def test_damaged_bytes_and_breaks_are_counted_apart() -> None:
    bench = Bench()
    for what in (Mark.DAMAGED, Mark.DAMAGED, Mark.BREAK):
        mark(bench, what)
    counted = bench.arbiter.statistics(bench.now)
    assert (counted.damaged, counted.breaks) == (2, 1)


def test_a_reply_with_a_marked_byte_within_it_is_no_value_whatever_its_checksum_says() -> None:
    """Two bits of two bytes flipped, and the 8-bit checksum right: only the UART knows."""
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    bench.hear(FIVE[:11], after=REQUEST + 0.003)
    mark(bench)
    bench.hear(FIVE[12:])
    assert isinstance(read.error, GarbledReply)
    assert read.value is None


def test_a_marked_byte_is_no_acknowledgement() -> None:
    bench = Bench()
    asked = bench.ask(bench.node(), hcp2.Write(1, (5,)))
    assert bench.sent() == WRITE_5
    mark(bench, after=REQUEST + 0.003)
    assert isinstance(asked.error, WriteUnconfirmed)


def test_r3_after_a_marked_byte_the_line_resynchronises_for_the_whole_max_reply_delay() -> None:
    bench = Bench()
    bench.ask(up(bench))
    bench.sent()
    mark(bench, after=REQUEST + 0.003)
    assert bench.until_sent() == pytest.approx(MAX_REPLY_DELAY - 0.003)


def test_r3_a_marked_byte_on_an_idle_line_resynchronises_too() -> None:
    bench = Bench()
    node = up(bench)
    bench.wait(1.0)
    mark(bench)
    assert bench.arbiter.state is LineState.RESYNCHRONISING
    bench.ask(node)
    assert bench.sent() == ""
    assert bench.until_sent() == pytest.approx(QUIET)


def test_r15_what_followed_a_marked_byte_never_confirms_a_write() -> None:
    """The rest of that reply may be held up, and end in 06."""
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    bench.ask(other, retries=0)
    bench.sent()
    mark(bench, after=REQUEST + 0.003)
    asked = bench.ask(node, hcp2.Write(1, (5,)))
    bench.until_sent()
    assert bench.answer() in (request_of(1), request_of(1, 2), request_of(2), request_of(2, 2)), "a check"
    bench.until_sent()
    assert bench.sent() == WRITE_5
    bench.hear(ACK, after=0.004)
    assert asked.error is None


def test_an_echo_with_a_marked_byte_is_not_taken_for_a_collision_later() -> None:
    bench = Bench(echo=True)
    node = bench.node()
    bench.ask(node, retries=0)
    bench.hear(bench.sent()[:11])
    mark(bench)
    bench.until_ready()
    assert bench.arbiter.statistics(bench.now).collisions == 0
    read = bench.ask(node)
    while not bench.ended(read):
        bench.until_sent()
        bench.hear(bench.sent())
        bench.answer()
    assert (read.value, bench.arbiter.statistics(bench.now).collisions) == (5.0, 0)


def test_marks_on_a_lost_port_are_counted_and_change_nothing() -> None:
    bench = Bench()
    bench.arbiter.line_down("unplugged", bench.now)
    mark(bench, Mark.BREAK)
    assert bench.arbiter.state is LineState.OFFLINE
    assert bench.arbiter.statistics(bench.now).breaks == 1
