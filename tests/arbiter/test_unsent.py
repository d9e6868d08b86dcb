"""Time starts when bytes have left: a process that stood still, a port that holds what it was given (R1-R4)."""

from __future__ import annotations

from dataclasses import replace

import pytest

from busmaster.arbiter.counters import LineState
from busmaster.errors import GarbledReply, NoReply
from busmaster.protocols.msc import codec as msc
from tests.arbiter.bench import ACK, FIVE, MAX_REPLY_DELAY, READ_1_OF_NODE_1, SEVEN, TAU, Bench, up

REQUEST = 8 * TAU
LOOK = 0.002
"""So often a port that holds bytes is asked again, so well is it known when they left."""


def given_late(bench: Bench, seconds: float) -> str:
    """The owner was stopped between the arbiter's call and the port's write. Returns what was sent."""
    sent = bench.sent()
    bench.now += seconds
    bench.arbiter.transmitted(bench.now)
    return sent


# the process stood still before the write


@pytest.mark.parametrize("stall", [0.005, 0.160, 0.410, 2.0])
def test_r2_the_wait_for_a_reply_counts_from_when_the_port_took_the_request(stall: float) -> None:
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    given_late(bench, stall)
    bench.wait(REQUEST + MAX_REPLY_DELAY - 0.0001)
    assert not bench.ended(read)
    bench.wait(0.0002)
    assert isinstance(read.error, NoReply)


@pytest.mark.parametrize("stall", [0.160, 0.410])
def test_r3_a_stall_before_the_write_shifts_the_max_reply_delay_too(stall: float) -> None:
    bench = Bench()
    bench.ask(bench.node())
    given_late(bench, stall)
    assert bench.until_sent() == pytest.approx(REQUEST + MAX_REPLY_DELAY)


def test_r2_a_reply_is_not_late_because_its_request_was() -> None:
    bench = Bench()
    read = bench.ask(bench.node())
    given_late(bench, 0.300)
    bench.hear(FIVE, after=REQUEST + 0.049)
    assert (read.value, read.late) == (5.0, False)


def test_r4_a_stall_before_the_write_shifts_what_taints() -> None:
    bench = Bench(paced=True)
    read = bench.ask(bench.node(), retries=0)
    given_late(bench, 0.300)
    bench.hear(FIVE, after=0.8 * REQUEST)
    assert isinstance(read.error, GarbledReply)


def test_r4_a_stall_before_the_write_taints_no_reply_that_came_in_its_time() -> None:
    bench = Bench(paced=True)
    read = bench.ask(bench.node(), retries=0)
    given_late(bench, 0.300)
    bench.hear(FIVE, after=REQUEST + 0.001)
    assert read.value == 5.0


def test_r3_a_stall_before_a_closing_ack_shifts_the_resynchronisation() -> None:
    """MSC: a stale packet is ACKed; the line is free no sooner than a silence after the ACK is out."""
    bench = Bench()
    bench.arbiter.byte_time = tau = 10 / 9600
    node = bench.node(1, msc.PROFILE)
    bench.wait(2.0)
    bench.hear("02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D")
    assert bench.arbiter.state is LineState.RESYNCHRONISING
    due = bench.arbiter.poll_timeout()
    assert given_late(bench, 0.300) == ACK
    assert bench.arbiter.poll_timeout() == pytest.approx(due + 0.300)
    bench.ask(node, msc.DataRead(2008))
    bench.until_sent()
    assert bench.now >= due + 0.300 + tau - 0.002


def test_a_stall_before_an_ack_within_an_exchange_makes_no_request_later() -> None:
    """MSC repeats its packet; the value may be as old as the request, so nobody may take it for a later one."""
    bench = Bench()
    bench.arbiter.byte_time = 10 / 9600
    node = bench.node(1, msc.PROFILE)
    bench.wait(2.0)
    read = bench.ask(node, msc.DataRead(2008))
    assert bench.sent() == "02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74"
    asked = read.started
    bench.hear("02 0D 00 0A 00 00 44 52 45 41 44 2C 41 48 79 CB 03 70")  # node 13 says again what it was asked before
    assert read.started == bench.now == asked
    assert given_late(bench, 0.300) == ACK
    assert read.started == asked


def test_a_request_that_waits_behind_an_ack_starts_when_both_are_taken() -> None:
    bench = Bench()
    bench.arbiter.byte_time = 10 / 9600
    node = bench.node(1, msc.PROFILE)
    bench.wait(2.0)
    read = bench.ask(node, msc.DataRead(2008))
    bench.hear("02 0D 00 0A 00 00 44 52 45 41 44 2C 41 48 79 CB 03 70")
    sent = given_late(bench, 0.300)
    assert sent.endswith(" 02 74 " + ACK)
    assert read.started == bench.now


def test_a_stall_is_no_part_of_how_slow_a_node_is() -> None:
    bench = Bench()
    node = up(bench)
    slowest = node.slowest
    bench.ask(node)
    given_late(bench, 0.300)
    bench.hear(FIVE, after=REQUEST + 0.004)
    assert node.slowest == pytest.approx(slowest)
    assert node.counters.latency.highest < 0.1


def test_what_was_taken_at_once_shifts_nothing() -> None:
    bench = Bench()
    bench.ask(bench.node())
    due = bench.arbiter.poll_timeout()
    given_late(bench, 0.0)
    assert bench.arbiter.poll_timeout() == due


# the port holds it


def test_r2_nothing_runs_out_while_the_port_holds_what_was_said() -> None:
    bench = Bench()
    node = bench.node()
    read, following = bench.ask(node, retries=0), bench.ask(node)
    assert bench.sent() == READ_1_OF_NODE_1
    bench.unsent = 8
    bench.wait(5.0)
    assert not bench.ended(read)
    assert bench.sent() == ""
    assert following.attempts == 0


@pytest.mark.parametrize("held", [0.120, 0.350, 3.0])
def test_r2_the_wait_for_a_reply_counts_from_when_the_last_byte_has_left(held: float) -> None:
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    bench.unsent = 8
    bench.wait(REQUEST + held)
    bench.unsent = 0
    left = bench.now
    bench.to(left + MAX_REPLY_DELAY - 0.0001)
    assert not bench.ended(read)
    bench.to(left + MAX_REPLY_DELAY + 0.0001 + LOOK)
    assert isinstance(read.error, NoReply)


@pytest.mark.parametrize("held", [0.120, 0.350, 3.0])
def test_r3_the_max_reply_delay_counts_from_when_the_last_byte_has_left(held: float) -> None:
    bench = Bench()
    bench.ask(bench.node())
    bench.sent()
    bench.unsent = 8
    bench.wait(REQUEST + held)
    bench.unsent = 0
    left = bench.now
    bench.until_sent()
    assert MAX_REPLY_DELAY <= bench.now - left <= MAX_REPLY_DELAY + 2 * LOOK


def test_r2_a_reply_to_what_was_held_is_believed_and_prompt() -> None:
    bench = Bench()
    read = bench.ask(bench.node())
    bench.unsent = 8
    bench.wait(1.0)
    bench.unsent = 0
    bench.wait(2 * LOOK)
    bench.hear(FIVE, after=0.030)
    assert (read.value, read.late) == (5.0, False)


def test_what_is_held_is_asked_for_no_sooner_than_it_can_have_left() -> None:
    bench = Bench()
    bench.arbiter.byte_time = slow = 0.010
    bench.wait(2.0)
    bench.ask(bench.node())
    bench.until_sent()
    bench.unsent = 5
    bench.to(bench.arbiter.poll_timeout())
    assert bench.arbiter.poll_timeout() == pytest.approx(bench.now + 5 * slow)


def test_r3_a_resynchronisation_does_not_run_out_while_the_port_holds_an_ack() -> None:
    """MSC: the ACK of a stale packet is held; the packet is said again, and its ACK must not meet a request."""
    bench = Bench()
    bench.arbiter.byte_time = 10 / 9600
    node = bench.node(1, msc.PROFILE)
    bench.wait(2.0)
    bench.hear("02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D")
    bench.ask(node, msc.DataRead(2008))
    assert bench.sent() == ACK
    bench.unsent = 1
    bench.wait(3.0)
    assert bench.sent() == ""
    bench.unsent = 0
    assert bench.until_sent() < 0.1, "the silence, and no reply is awaited"
    assert bench.sent().startswith("02 01 00 08"), "the read, when nothing lies before it in the port"


def test_r2_while_the_bus_is_being_closed_a_window_still_counts_from_when_the_request_has_left() -> None:
    bench = Bench()
    read = bench.ask(bench.node(), retries=0)
    bench.arbiter.unsent(8, bench.now)
    bench.arbiter.close(bench.now)
    bench.now += 5.0
    bench.arbiter.unsent(0, bench.now)
    assert bench.arbiter.poll_timeout() == pytest.approx(bench.now + 0.100)
    bench.hear(FIVE, after=0.004)
    assert read.value == 5.0


def test_r1_a_holdoff_does_not_run_out_while_the_port_holds_a_closing_ack() -> None:
    bench = Bench()
    bench.arbiter.byte_time = 10 / 9600
    node = bench.node(1, msc.PROFILE)
    bench.wait(2.0)
    bench.ask(node, msc.DataRead(2008))
    bench.sent()
    bench.hear(f"{ACK} 02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D", after=0.1)
    assert bench.sent() == ACK
    bench.unsent = 1
    bench.ask(node, msc.DataRead(2012))
    bench.wait(1.0)
    assert bench.sent() == ""
    bench.unsent = 0
    bench.until_sent()
    assert bench.sent().startswith("02 01 00 08"), "the next read, and nothing lies before it in the port"


def test_r1_a_driver_release_time_counts_from_when_a_held_closing_ack_has_left() -> None:
    bench = Bench()
    bench.arbiter.byte_time = 10 / 9600
    slow = replace(msc.PROFILE.timings, packet=replace(msc.PROFILE.timings.packet, driver_release_time=0.300))
    node = bench.node(1, msc.PROFILE, slow)
    bench.wait(2.0)
    bench.ask(node, msc.DataRead(2008))
    bench.sent()
    bench.hear(f"{ACK} 02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D", after=0.1)
    assert bench.sent() == ACK
    bench.unsent = 1
    bench.ask(node, msc.DataRead(2012))
    bench.wait(1.0)
    bench.unsent = 0
    assert 0.300 <= bench.until_sent() <= 0.300 + LOOK


def test_r4_bytes_that_come_while_the_whole_request_is_held_are_not_its_reply() -> None:
    """An overdue reply of before: nothing of the request has been said yet."""
    bench = Bench(paced=True)
    read = bench.ask(bench.node(), retries=0)
    bench.unsent = 8
    bench.wait(0.110)
    bench.hear(FIVE)
    assert read.value is None


@pytest.mark.parametrize("after", [0.0005, 0.030])
def test_r4_what_comes_when_a_held_request_is_out_is_its_reply(after: float) -> None:
    """Even before the port was to be asked again: it is asked before it is heard."""
    bench = Bench(paced=True)
    read = bench.ask(bench.node(), retries=0)
    bench.unsent = 8
    bench.wait(0.500)
    assert bench.held
    bench.unsent = 0
    bench.hear(SEVEN, after=after)
    assert read.value == 7.0


def test_r2_what_echoes_has_left() -> None:
    """An adapter that counts nothing, or counts wrongly, is not believed against the wire."""
    bench = Bench(echo=True)
    read = bench.ask(bench.node(), retries=0)
    bench.unsent = 8
    bench.wait(0.500)
    bench.unsent, bench.held = None, False
    bench.hear(bench.sent())
    bench.hear(SEVEN, after=0.030)
    assert read.value == 7.0


def test_r13_what_a_lost_port_held_is_not_held_by_the_next_one() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node)
    bench.sent()
    bench.unsent = 8
    bench.wait(1.0)
    bench.arbiter.line_down("unplugged", bench.now)
    bench.unsent, bench.held = None, False
    bench.arbiter.line_up(bench.now)
    read = bench.served(bench.ask(node))
    assert read.value == 5.0


# a loop that stood still


def test_r3_a_reply_that_lay_unread_while_the_loop_stood_still_raises_no_max_reply_delay() -> None:
    bench = Bench()
    node = up(bench)
    bench.ask(node, retries=0)
    bench.sent()
    bench.wait(0.105)
    bench.now += 0.300
    bench.arbiter.data_received(bytes.fromhex(FIVE), bench.now)
    assert node.max_reply_delay == 0.150


def test_r3_a_timer_that_comes_before_the_bytes_that_lie_unread_gives_nothing_up() -> None:
    """A blocked loop may run a timer before it reads: the silence would be a mistake."""
    bench = Bench()
    node = up(bench)
    read = bench.ask(node, retries=0)
    following = bench.ask(node)
    bench.sent()
    bench.wait(0.105)
    bench.now += 0.300
    bench.arbiter.handle_timeout(bench.now, unread=True)
    assert bench.sent() == ""
    bench.arbiter.data_received(bytes.fromhex(FIVE), bench.now)
    assert read.value == 5.0
    assert bench.sent() == READ_1_OF_NODE_1
    bench.hear(SEVEN, after=0.004)
    assert following.value == 7.0
    assert node.max_reply_delay == 0.150


def test_a_reply_in_time_is_delivered_when_the_loop_stood_still_past_its_window() -> None:
    bench = Bench()
    read = bench.ask(up(bench))
    bench.sent()
    bench.now += 1.0
    bench.arbiter.handle_timeout(bench.now, unread=True)
    bench.arbiter.data_received(bytes.fromhex(FIVE), bench.now)
    assert read.value == 5.0


def test_r3_an_overdue_reply_that_was_seen_to_come_late_raises_the_max_reply_delay() -> None:
    """The line was looked at all the while: so late it was."""
    bench = Bench()
    node = up(bench)
    bench.ask(node, retries=0)
    bench.sent()
    bench.hear(FIVE, after=REQUEST + 0.140)
    assert node.max_reply_delay == pytest.approx(0.224)


@pytest.mark.parametrize("stall", [0.050, 0.200, 1.0])
def test_r3_a_stall_in_the_midst_of_a_resynchronisation_raises_no_max_reply_delay(stall: float) -> None:
    """The overdue reply came at 0.111 s, and was handed over when the loop went on."""
    bench = Bench()
    node = up(bench)
    bench.ask(node, retries=0)
    bench.sent()
    bench.to(bench.now + REQUEST + 0.110)
    bench.now += stall
    bench.arbiter.data_received(bytes.fromhex(FIVE), bench.now)
    assert node.max_reply_delay == 0.150


def test_when_a_request_will_have_left_is_known_and_follows_the_port() -> None:
    bench = Bench()
    bench.ask(up(bench))
    asked = bench.now
    assert bench.arbiter.sent_until == pytest.approx(asked + 8 * TAU)
    bench.arbiter.transmitted(asked + 0.25)
    assert bench.arbiter.sent_until == pytest.approx(asked + 0.25 + 8 * TAU)


def test_r2_what_has_left_earlier_than_the_baud_rate_says_makes_no_window_shorter() -> None:
    bench = Bench()
    bench.ask(up(bench))
    ends = bench.arbiter.sent_until
    bench.arbiter.unsent(3, bench.now)
    bench.arbiter.unsent(0, bench.now + TAU)
    assert bench.arbiter.sent_until == ends
