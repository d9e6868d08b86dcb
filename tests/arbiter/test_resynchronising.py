"""After every uncertain outcome the line is discarded until nothing can come any more (R3, echo, noise)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from busmaster.arbiter.counters import LineState
from busmaster.arbiter.events import CameUnexpected, LineChange, LineChanged, MaxReplyDelayRaised
from busmaster.contract.exchange import Command
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import GarbledReply, LineNoisy, Refused
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc
from tests.arbiter.bench import (
    ACK,
    ANOTHER_ELEMENT,
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


@pytest.mark.parametrize("delay", [0.101, 0.120, 0.149])
def test_r3_a_late_reply_is_delivered_and_never_taken_for_the_next_one(delay: float) -> None:
    bench = Bench()
    node = bench.node()
    first = bench.ask(node, retries=0)
    second = bench.ask(node, retries=0)
    assert bench.sent() == READ_1_OF_NODE_1
    bench.wait(REQUEST + delay)
    assert (bench.sent(), second.attempts) == ("", 0), "the line waits for it, whatever the window is"
    bench.hear(FIVE)
    assert (first.value, first.late, first.attempts) == (5.0, True, 1)
    assert bench.sent() == READ_1_OF_NODE_1, "and goes on at once"
    bench.hear(SEVEN, after=0.004)
    assert second.value == 7.0


def test_r3_nothing_is_sent_before_max_reply_delay_has_passed() -> None:
    bench = Bench()
    bench.ask(bench.node())
    bench.sent()
    assert bench.until_sent() == pytest.approx(REQUEST + MAX_REPLY_DELAY)


def test_r3_nothing_is_sent_before_the_line_is_silent() -> None:
    bench = Bench()
    bench.ask(bench.node())
    bench.sent()
    bench.hear("FF", after=REQUEST + 0.145)
    assert bench.until_sent() == pytest.approx(QUIET)


def test_r3_a_wrong_echo_resynchronises_for_the_whole_max_reply_delay() -> None:
    bench = Bench()
    read = bench.ask(bench.node())
    bench.sent()
    bench.hear(ANOTHER_ELEMENT, after=REQUEST + 0.002)
    assert read.attempts == 1
    assert bench.until_sent() == pytest.approx(MAX_REPLY_DELAY - 0.002)


def test_r3_bytes_after_a_reply_resynchronise_but_the_value_stands() -> None:
    bench = Bench()
    node = bench.node()
    read = bench.ask(node)
    bench.ask(node)
    bench.sent()
    bench.hear(FIVE + "15", after=REQUEST + 0.002)
    assert read.value == 5.0
    assert bench.arbiter.state is LineState.RESYNCHRONISING
    assert bench.until_sent() == pytest.approx(MAX_REPLY_DELAY - 0.002)


def test_r3_what_comes_behind_a_reply_is_told_as_nobodys() -> None:
    bench = Bench()
    read = bench.ask(bench.node())
    bench.sent()
    bench.hear(f"{FIVE} 41 42", after=0.004)
    assert read.value == 5.0
    assert [event.data for event in bench.events if isinstance(event, CameUnexpected)] == [b"AB"]
    assert bench.arbiter.statistics(bench.now).unexpected_bytes == 2


def test_r3_unexpected_bytes_on_an_idle_line_resynchronise_too() -> None:
    bench = Bench()
    node = bench.node()
    bench.hear("55")
    bench.ask(node)
    assert bench.sent() == ""
    assert bench.until_sent() == pytest.approx(QUIET)
    assert bench.arbiter.statistics(bench.now).unexpected_bytes == 1


def test_r3_an_overdue_reply_raises_its_nodes_max_reply_delay() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node, retries=0)
    bench.hear(FIVE, after=REQUEST + 0.140)
    raised = [event for event in bench.events if isinstance(event, MaxReplyDelayRaised)]
    assert [event.node for event in raised] == [node]
    assert node.max_reply_delay == pytest.approx(0.224)


def test_r3_an_overdue_reply_in_good_time_raises_nothing() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node, retries=0)
    bench.hear(FIVE, after=REQUEST + 0.111)
    assert node.max_reply_delay == 0.150


def test_r3_a_late_reply_that_is_wrong_raises_no_max_reply_delay() -> None:
    """It may be noise: nothing shows whose it is."""
    bench = Bench()
    node = bench.node()
    bench.ask(node, retries=0)
    bench.hear("FF", after=REQUEST + 0.140)
    assert node.max_reply_delay == 0.150


def test_r3_an_overdue_reply_beyond_max_reply_delay_is_known_as_one_and_max_reply_delay_is_at_most_500_ms() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node, retries=0)
    bench.hear(FIVE, after=REQUEST + 0.400)
    bench.wait(QUIET)
    assert node.max_reply_delay == 0.5


@pytest.mark.parametrize("noise", ["FF", ACK, NAK, "02", reply_of(80, 5)])
@pytest.mark.parametrize("command", [hcp2.Read(1), hcp2.Write(1, (2,))], ids=["read", "write"])
def test_r3_bytes_that_are_no_overdue_reply_make_no_node_slower(noise: str, command: Command[Any]) -> None:
    bench = Bench()
    node, other = bench.node(), bench.node(2)
    bench.served(bench.ask(other))
    bench.ask(node, command, retries=0)
    bench.until_sent()
    bench.hear(noise, after=REQUEST + 0.400)
    bench.wait(1.0)
    bench.ask(node, command, retries=0)
    bench.wait(REQUEST + 0.160)
    bench.ask(other, retries=0)  # what comes in place of its reply is nobody's
    bench.until_sent()
    bench.hear(noise, after=0.005)
    bench.wait(1.0)
    assert (node.max_reply_delay, other.max_reply_delay) == (0.150, 0.150)
    assert not [event for event in bench.events if isinstance(event, MaxReplyDelayRaised)]


def test_r3_an_overdue_reply_that_lay_unread_makes_no_node_slower_than_is_known() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node, retries=0)
    bench.wait(REQUEST + 0.160)
    bench.now += 0.300  # the program stood still: nobody knows when it came
    bench.arbiter.data_received(bytes.fromhex(FIVE), bench.now)
    bench.listen()
    bench.wait(QUIET)
    assert node.max_reply_delay < 0.300


def test_r3_after_opening_the_port_an_earlier_masters_reply_is_waited_out() -> None:
    bench = Bench()
    bench.arbiter.line_down("unplugged", bench.now)
    bench.arbiter.line_up(bench.now)
    node = bench.node()
    bench.ask(node)
    assert bench.sent() == ""
    bench.hear(SEVEN, after=0.1)
    assert bench.until_sent() == pytest.approx(MAX_REPLY_DELAY - 0.1)


@pytest.mark.parametrize("known", [True, False])
def test_r3_a_slower_node_is_waited_out_from_when_the_port_was_opened_be_it_added_then_or_later(known: bool) -> None:
    slow = Timings.uniform(replace(hcp2.PROFILE.timings.read, max_reply_delay=0.700))
    bench = Bench()
    bench.wait(6.54)
    node = bench.node(timings=slow) if known else None
    bench.arbiter.line_down("unplugged", bench.now)
    bench.arbiter.line_up(bench.now)
    opened = bench.now
    bench.wait(0.5)
    bench.ask(node or bench.node(timings=slow))
    bench.until_sent()
    assert bench.now - opened == pytest.approx(0.700 + TAU)


def test_r3_a_line_that_does_not_fall_silent_is_noisy_and_recovers_by_itself() -> None:
    bench = Bench()
    node = bench.node()
    waiting = bench.ask(node, retries=0)
    bench.sent()
    for _ in range(130):
        bench.hear("FF", after=0.010)
    assert waiting.error is not None
    changes = [e.change for e in bench.events if isinstance(e, LineChanged)]
    assert changes == [LineChange.NOISY]
    refused = bench.ask(node)
    assert isinstance(refused.error, LineNoisy)
    assert bench.sent() == ""
    bench.wait(0.021)
    assert [e.change for e in bench.events if isinstance(e, LineChanged)] == [LineChange.NOISY, LineChange.QUIET]
    healed = bench.ask(node)
    bench.checked()
    assert bench.sent() == READ_1_OF_NODE_1
    bench.hear(FIVE, after=0.003)
    assert healed.value == 5.0


def test_r3_whoever_waits_when_the_line_turns_noisy_is_told() -> None:
    bench = Bench()
    node = bench.node()
    bench.hear("FF")
    waiting = bench.ask(node)
    for _ in range(120):
        bench.hear("FF", after=0.010)
    assert isinstance(waiting.error, LineNoisy)
    assert bench.ended(waiting) == 1


def test_r7_a_nak_to_a_read_resynchronises_and_is_confirmed_once() -> None:
    bench = Bench()
    read = bench.ask(bench.node())
    bench.sent()
    bench.hear(NAK, after=REQUEST + 0.002)
    assert not bench.ended(read)
    assert bench.until_sent() == pytest.approx(MAX_REPLY_DELAY - 0.002)
    bench.sent()
    bench.hear(NAK, after=REQUEST + 0.002)
    assert isinstance(read.error, Refused)
    assert read.attempts == 2
    assert bench.ended(read) == 1


def test_r7_a_nak_that_was_noise_costs_no_value() -> None:
    bench = Bench()
    read = bench.ask(bench.node())
    bench.sent()
    bench.hear(NAK, after=REQUEST + 0.002)
    bench.hear(FIVE, after=0.001)
    bench.until_sent()
    bench.hear(SEVEN, after=0.004)
    assert read.value == 7.0


def test_r3_after_a_nak_the_packet_is_waited_for_as_behind_an_ack_that_is_lost() -> None:
    """The NAK may be noise before the true ACK."""
    slow = replace(msc.PROFILE.timings.packet, max_reply_delay=2.0)
    bench = Bench()
    node = bench.node(1, msc.PROFILE, replace(msc.PROFILE.timings, packet=slow))
    read = bench.ask(node, msc.DataRead(2008))
    while not bench.ended(read):
        bench.until_sent()
        length = len(bytes.fromhex(bench.sent())) * TAU
        bench.hear(NAK, after=length + 0.010)
    assert isinstance(read.error, Refused)
    bench.ask(node, msc.DataRead(2008))
    assert bench.until_sent() == pytest.approx(slow.max_reply_delay + TAU)


def test_r7_a_nak_to_a_write_is_confirmed_at_once() -> None:
    bench = Bench()
    write = bench.ask(bench.node(), hcp2.Write(1, (5,)))
    assert bench.sent() == WRITE_5
    bench.hear(NAK, after=0.004)
    assert bench.sent() == WRITE_5
    bench.hear(ACK, after=0.004)
    assert write.error is None


def test_r7_a_nak_to_several_values_is_final_and_says_that_a_prefix_may_be_stored() -> None:
    bench = Bench()
    write = bench.ask(bench.node(), hcp2.Write(99, (7, 8)))
    bench.sent()
    bench.hear(NAK, after=0.004)
    assert isinstance(write.error, Refused)
    assert "stored" in str(write.error)
    assert bench.sent() == ""


def test_echo_is_stripped_and_the_window_starts_at_its_last_byte() -> None:
    bench = Bench(echo=True)
    read = bench.ask(bench.node(), retries=0)
    bench.hear(READ_1_OF_NODE_1[:11], after=0.010)
    bench.hear(READ_1_OF_NODE_1[12:], after=0.010)
    bench.wait(0.099)
    assert not bench.ended(read)
    bench.hear(FIVE)
    assert read.value == 5.0


def test_echo_and_reply_may_come_in_one_chunk() -> None:
    bench = Bench(echo=True)
    read = bench.ask(bench.node())
    bench.hear(READ_1_OF_NODE_1 + FIVE, after=0.010)
    assert read.value == 5.0


def test_an_echo_that_differs_is_a_collision() -> None:
    bench = Bench(echo=True)
    read = bench.ask(bench.node(), retries=0)
    bench.hear("07 30 31 02 30 33", after=0.010)
    assert isinstance(read.error, GarbledReply)
    assert bench.arbiter.statistics(bench.now).collisions == 1
    assert any(isinstance(e, CameUnexpected) and e.collision for e in bench.events)


def test_an_echo_that_never_comes_is_named_in_the_error() -> None:
    bench = Bench(echo=True)
    read = bench.ask(bench.node(), retries=0)
    bench.wait(0.2)
    assert "no echo" in str(read.error)


def test_r3_behind_a_slow_adapter_an_earlier_masters_reply_is_waited_out_for_as_much_longer() -> None:
    bench = Bench(latency=0.016)
    bench.arbiter.line_down("unplugged", bench.now)
    bench.arbiter.line_up(bench.now)
    up = bench.now
    bench.node()
    read = bench.poll(bench.node(), 10.0, 1)
    bench.until_sent()
    assert read.running
    assert bench.now - up == pytest.approx(MAX_REPLY_DELAY + 0.016)


def test_r3_noise_that_a_tolerant_profile_skips_is_no_silence() -> None:
    bench = Bench()
    patient = Timings.uniform(ReplyTiming(0.05, 0.1, 0.1, 0.02))
    node = bench.node(profile=replace(hcp2.PROFILE, noise_tolerant=True), timings=patient)
    bench.ask(node)
    bench.sent()
    bench.hear("FF", after=REQUEST + 0.099)
    assert bench.until_sent() == pytest.approx(QUIET)


def test_a_broadcast_whose_echo_never_came_leaves_nothing_to_be_taken_for_a_collision() -> None:
    bench = Bench(echo=True)
    everyone = bench.node(0, mentor.PROFILE)
    for _ in range(3):
        bench.ask(everyone, mentor.Write(1, 17, 100))
        bench.wait(1.0)
        bench.sent()
    assert bench.arbiter._echo.pending == b""


def test_r2_a_reply_is_late_by_the_time_from_the_end_of_its_echo() -> None:
    bench = Bench(echo=True)
    prompt = bench.ask(bench.node())
    request = bench.sent()
    bench.hear(request, after=0.030)
    bench.hear("02 30 31 35 03 37", after=0.049)
    assert (prompt.value, prompt.late) == (5.0, False)


def test_r3_a_line_that_comes_up_waits_for_the_slowest_of_its_nodes() -> None:
    """An earlier master may have asked that one, whichever was added first."""
    bench = Bench()
    first = bench.node(1)
    bench.node(2, timings=hcp2.PROFILE.timings.with_max_reply_delay(0.4))
    bench.arbiter.line_down("lost", bench.now)
    bench.arbiter.line_up(bench.now)
    bench.ask(first)
    assert bench.until_sent() >= 0.4


def test_a_tolerant_profile_skips_the_noise_in_front_of_a_reply() -> None:
    bench = Bench()
    node = bench.node(profile=replace(hcp2.PROFILE, noise_tolerant=True))
    read = bench.ask(node)
    bench.sent()
    bench.hear("FF FE 02 30 31 35 03 37", after=REQUEST + 0.004)
    assert (read.value, read.attempts) == (5.0, 1)
    assert bench.arbiter.statistics(bench.now).noise_bytes == 2


def test_r13_a_line_that_is_reported_lost_twice_is_lost_once() -> None:
    bench = Bench()
    for _ in range(2):
        bench.arbiter.line_down("unplugged", bench.now)
        bench.listen()
    assert bench.arbiter.statistics(bench.now).losses == 1
    assert [event.change for event in bench.events if isinstance(event, LineChanged)] == [LineChange.DOWN]
