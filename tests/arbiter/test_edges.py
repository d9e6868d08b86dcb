"""When the last byte of what was said can have been received: R3's edges, each row of the table in step.py."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import pytest

from busmaster.arbiter.counters import LineState
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.transaction import Priority
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import NoReply, Refused, WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc
from tests.arbiter.bench import ACK, FIVE, MAX_REPLY_DELAY, NAK, QUIET, SEVEN, TAU, WRITE_5, Bench, up

REQUEST = 8 * TAU
JUST = 1e-6
READ_2008 = "02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74"
REPLY_1234 = "02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D"
FLAG_IS_ON = "02 01 00 08 00 00 52 46 4C 41 47 2C 00 01 01 A2"
MSC_TAU = 10 / 9600
MSC_REQUEST = 16 * MSC_TAU


# a request, one step


@pytest.mark.parametrize("latency", [0.0, 0.016])
@pytest.mark.parametrize("inside", [0.0001, 0.001])
def test_r3_a_start_bit_within_the_max_reply_delay_is_heard_a_byte_time_later_and_is_delivered(
    inside: float, latency: float
) -> None:
    bench = Bench(latency=latency)
    node = up(bench)
    first, second = bench.ask(node, retries=0), bench.ask(node, hcp2.Read(1), retries=0)
    bench.sent()
    bench.wait(REQUEST + 0.150 - inside + TAU + latency)
    assert bench.sent() == "", "it is on its way until then"
    bench.hear(FIVE)
    assert (first.value, first.late) == (5.0, True)
    bench.until_sent()
    bench.hear(SEVEN, after=0.004)
    assert second.value == 7.0


@pytest.mark.parametrize("latency", [0.0, 0.016])
def test_r3_a_line_that_stays_silent_is_free_one_byte_time_past_max_reply_delay_and_latency(latency: float) -> None:
    bench = Bench(latency=latency)
    bench.ask(bench.node())
    bench.sent()
    assert bench.until_sent() == pytest.approx(REQUEST + 0.150 + latency + TAU)


def test_r3_on_a_slow_line_a_byte_time_is_two_milliseconds() -> None:
    """Mentor II at 4800 baud, where a reply one millisecond within its maximum reply delay was given to the next
    request."""
    bench = Bench()
    bench.arbiter.byte_time = tau = 10 / 4800
    drive = bench.node(12, mentor.PROFILE)
    bench.wait(1.0)
    first, second = (bench.ask(drive, mentor.Read(1, 17), retries=0) for _ in range(2))
    said = len(bytes.fromhex(bench.sent())) * tau
    reply = "02 30 31 31 37 2D 30 34 37 36 03"
    reply = f"{reply} {checksum(reply):02X}"
    bench.hear(reply, after=said + 0.300 - 0.001 + tau)
    assert first.value == -476
    assert second.value is None


def checksum(telegram: str) -> int:
    """Mentor II: of all behind STX; below 20 hex one more 20."""
    check = 0
    for byte in bytes.fromhex(telegram)[1:]:
        check ^= byte
    return check + 0x20 if check < 0x20 else check


def test_what_was_refused_has_left_whatever_the_baud_rate_says() -> None:
    """On an unpaced port, requests that are refused at once do not add up."""
    bench = Bench()
    node = up(bench)
    for _ in range(5):
        refused = bench.ask(node, hcp2.Write(1, (5.0,)))
        while refused.error is None:
            bench.sent()
            bench.hear(NAK, after=JUST)
    asked = bench.now
    bench.ask(node, retries=0)
    assert bench.arbiter.poll_timeout() - asked == pytest.approx(REQUEST + 0.100)


def test_r3_an_answer_that_is_not_believed_proves_not_that_its_request_has_left() -> None:
    """On an unpaced port a reply may come before the baud rate says; an earlier one, held up, too."""
    bench = Bench()
    node = up(bench)
    bench.ask(node, hcp2.Write(1, (5.0,)))
    bench.sent()
    bench.wait(1.0)
    disabled = bench.ask(node, hcp2.Write(1, (5.0,)), priority=Priority.URGENT)
    said = len(bytes.fromhex(bench.sent())) * TAU
    bench.hear(ACK, after=TAU)
    assert isinstance(disabled.error, WriteUnconfirmed)
    bench.ask(node)
    assert bench.until_sent() == pytest.approx(said - TAU + MAX_REPLY_DELAY)


# the silence


@pytest.mark.parametrize("latency", [0.0, 0.016])
def test_r3_a_pause_within_a_frame_is_no_silence_however_long_an_adapter_holds_bytes(latency: float) -> None:
    """Its last byte, 06, would confirm another node's write."""
    bench = Bench(latency=latency)
    node, other = up(bench), up(bench, 2)
    bench.ask(other, retries=0)
    write = bench.ask(node, hcp2.Write(1, (5,)))
    bench.sent()
    bench.hear("02 30 31 31 35", after=REQUEST + 0.149 + latency)
    bench.hear("03", after=0.020 + latency + TAU - JUST)
    assert bench.sent() == ""
    bench.hear("06", after=0.020 + latency + TAU - JUST)
    assert bench.sent() == ""
    assert write.attempts == 0
    assert bench.until_sent() == pytest.approx(0.020 + latency + TAU)


def test_r3_the_silence_is_at_least_twenty_milliseconds_and_the_inter_byte_timeout_if_that_is_longer() -> None:
    for gap, silence in ((0.005, 0.020), (0.050, 0.050)):
        bench = Bench()
        timing = ReplyTiming(0.05, 0.1, 0.1, gap)
        bench.ask(bench.node(timings=Timings.uniform(timing)), hcp2.Read(1), retries=0)
        bench.hear("02 30", after=REQUEST + 0.099)
        last = bench.now
        bench.until_ready()
        assert bench.now - last == pytest.approx(silence + TAU)


def test_r2_an_inter_byte_timeout_bounds_the_pause_to_the_next_start_bit_which_is_heard_a_byte_time_later() -> None:
    bench = Bench()
    read = bench.ask(bench.node())
    bench.hear("02 30 31", after=REQUEST + 0.003)
    bench.hear("35 03 37", after=0.020 + TAU - JUST)
    assert read.value == 5.0


# the exemption of a whole frame


@pytest.mark.parametrize("pause", [TAU, 0.004, 0.020])
def test_r3_noise_before_a_checksum_makes_no_frame_whole_enough_to_release_the_line(pause: float) -> None:
    """`02 30 31 31 35 03 06` with 41 before its last byte: that byte would confirm another node's write."""
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    bench.ask(other, retries=0)
    write = bench.ask(node, hcp2.Write(1, (5,)))
    bench.sent()
    bench.hear("02 30 31 31 35 03 41", after=REQUEST + 0.003)
    assert bench.sent() == ""
    bench.hear("06", after=pause)
    assert bench.sent() == ""
    assert write.attempts == 0
    bench.until_sent()
    while bench.sent() != WRITE_5:
        bench.answer()
        bench.until_sent()
    bench.hear(ACK, after=0.004)
    assert (bench.ended(write), write.error) == (1, None)


def test_r3_a_whole_frame_with_a_bad_checksum_is_spared_the_max_reply_delay() -> None:
    bench = Bench()
    bench.ask(up(bench))
    bench.sent()
    bench.hear("02 30 31 31 35 03 41", after=REQUEST + 0.003)
    assert bench.until_sent() == pytest.approx(QUIET)


def test_r15_while_something_is_overdue_no_frame_is_spared_the_max_reply_delay() -> None:
    """It may be the overdue one, and its own still to come."""
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    bench.ask(other, retries=0)
    bench.sent()
    bench.until_ready()
    bench.ask(node, hcp2.Read(3))
    bench.sent()
    bench.hear("02 30 33 31 35 03 41", after=REQUEST + 0.003)
    assert bench.until_sent() == pytest.approx(MAX_REPLY_DELAY - 0.003)


# noise on an unpaced port


def test_r3_noise_before_a_request_is_out_does_not_bring_its_max_reply_delay_forward() -> None:
    bench = Bench()
    bench.ask(bench.node())
    bench.sent()
    bench.hear("FF")
    assert bench.until_sent() == pytest.approx(REQUEST + MAX_REPLY_DELAY)


# MSC: an ACK, then a packet, then the host's ACK


def msc_line(packet: float = 1.0, *, echo: bool = False) -> tuple[Bench, NodeRecord]:
    """A line at 9600 baud that has rested, and its node, with that maximum reply delay of packets."""
    bench = Bench(echo=echo)
    bench.arbiter.byte_time = MSC_TAU
    timings = msc.PROFILE.timings
    node = bench.node(1, msc.PROFILE, replace(timings, packet=replace(timings.packet, max_reply_delay=packet)))
    bench.wait(2.0)
    return bench, node


@pytest.mark.parametrize("packet", [1.0, 1.5])
def test_r3_behind_an_ack_the_packets_max_reply_delay_counts_from_that_acks_end(packet: float) -> None:
    bench, node = msc_line(packet)
    bench.ask(node, msc.DataRead(2008))
    bench.sent()
    bench.hear(ACK, after=MSC_REQUEST + 0.4)
    acked = bench.now
    bench.until_sent()
    assert bench.sent() == ACK, "whatever comes now is acknowledged already"
    bench.until_sent()
    gap = msc.PROFILE.timings.packet.inter_byte_timeout
    assert bench.now - acked == pytest.approx(packet + MSC_TAU + MSC_TAU + gap + MSC_TAU), "our ACK, and a silence"


@pytest.mark.parametrize("packet", [1.0, 1.5])
def test_r3_where_the_ack_was_lost_its_packet_is_waited_for_from_the_requests_end(packet: float) -> None:
    bench, node = msc_line(packet)
    bench.ask(node, msc.DataRead(2008))
    bench.sent()
    assert bench.until_sent() == pytest.approx(MSC_REQUEST + packet + MSC_TAU)


def test_r3_an_unexpected_byte_may_have_been_the_lost_ack_and_its_packet_is_waited_for_anew() -> None:
    bench, node = msc_line()
    bench.ask(node, msc.DataRead(2008))
    bench.sent()
    bench.hear("00", after=MSC_REQUEST + 0.8)
    heard = bench.now
    bench.until_sent()
    assert bench.sent() == ACK, "what was said in its place may be a packet"
    bench.until_sent()
    assert bench.now - heard == pytest.approx(1.0 + MSC_TAU)


def test_r3_a_damaged_byte_in_place_of_the_ack_may_have_been_it_and_its_packet_is_waited_for_anew() -> None:
    bench, node = msc_line()
    bench.ask(node, msc.DataRead(2008), retries=0)
    bench.ask(node, msc.DataRead(2012))
    bench.sent()
    bench.hear("07", after=MSC_REQUEST + 0.4)
    heard = bench.now
    bench.until_sent()
    assert bench.sent() == ACK, "what was said in its place may be a packet"
    bench.until_sent()
    assert bench.now - heard == pytest.approx(1.0 + MSC_TAU)


def test_r3_an_ack_that_is_taken_for_an_echo_may_be_followed_by_its_packet() -> None:
    """On a line that echoes: a byte from nowhere for an ACK, the echo for a packet, whose ACK does not echo."""
    bench, node = msc_line(echo=True)
    bench.ask(node, msc.DataRead(2008), retries=0)
    bench.ask(node, msc.DataRead(2012))
    request = bench.sent()
    bench.hear("FF", after=MSC_REQUEST)
    bench.hear(request)
    assert bench.sent() == ACK, "what looks like a packet is acknowledged"
    bench.hear(ACK, after=0.002)
    heard = bench.now
    bench.until_sent()
    assert bench.now - heard >= 1.0


def test_the_echo_of_a_closing_ack_delays_nothing() -> None:
    bench, node = msc_line(echo=True)
    read = bench.ask(node, msc.DataRead(2008))
    bench.hear(bench.sent(), after=MSC_REQUEST)
    bench.hear(f"{ACK} {REPLY_1234}", after=0.002)
    assert bench.sent() == ACK
    assert read.error is None
    bench.hear(ACK, after=MSC_TAU)
    assert bench.arbiter.state is LineState.READY
    assert bench.arbiter.poll_timeout() == inf
    assert bench.ask(node, msc.DataRead(2012)).attempts == 1


def test_r3_noise_does_not_use_up_the_knowledge_that_a_packet_follows_its_ack() -> None:
    """Noise at 0.6 s, the late ACK at 0.95 s, the packet 0.99 s after it: 18 bytes, and the line is not free before."""
    bench, node = msc_line()
    bench.ask(node, msc.DataRead(2008), retries=0)
    bench.ask(node, msc.DataRead(2012))
    bench.sent()
    bench.hear("00", after=MSC_REQUEST + 0.6)
    bench.until_sent()
    assert bench.sent() == ACK, "what was said in its place may be a packet"
    bench.hear(ACK, after=0.24)
    bench.wait(0.99)
    assert bench.sent() == ""
    bench.hear(REPLY_1234)
    assert bench.sent() == ACK


def test_r3_a_nak_may_be_noise_before_the_ack_and_its_packet_is_waited_for_anew() -> None:
    """The fourth NAK is nobody's: the unit's ACK comes 0.9 s after the request, and its packet up to a second later."""
    bench, node = msc_line()
    read = bench.ask(node, msc.DataRead(2008))
    bench.ask(node, msc.DataRead(2012))
    for _ in range(4):
        bench.sent()
        bench.hear("15", after=MSC_REQUEST)
    assert isinstance(read.error, Refused)
    bench.hear(ACK, after=0.9)
    assert bench.until_sent() == pytest.approx(1.0 + MSC_TAU)


def test_r3_a_nak_for_which_an_urgent_write_ends_a_read_may_be_noise_before_the_ack() -> None:
    bench, node = msc_line()
    bench.ask(node, msc.DataRead(2008))
    bench.ask(node, msc.SetFlag(5), priority=Priority.URGENT)
    bench.sent()
    bench.hear("15", after=MSC_REQUEST)
    assert bench.sent() == "", "the read is not said again while something urgent waits"
    bench.hear(ACK, after=0.9)
    assert bench.until_sent() == pytest.approx(1.0 + MSC_TAU)


def test_r3_what_comes_behind_a_nak_is_not_the_late_reply_of_an_earlier_read() -> None:
    bench, node = msc_line()
    bench.ask(node, msc.ReadFlag(5))
    unheard = bench.ask(node, msc.DataRead(2008), retries=0)
    bench.ask(node, msc.ReadFlag(5))
    bench.sent()
    bench.hear(f"{ACK} {FLAG_IS_ON}", after=MSC_REQUEST)
    bench.sent()
    bench.until_sent()
    assert isinstance(unheard.error, NoReply)
    bench.sent()
    bench.hear(f"{ACK} {FLAG_IS_ON}", after=MSC_REQUEST)
    assert bench.sent() == ACK
    bench.until_ready()
    refused = bench.ask(node, msc.DataRead(2008))
    bench.ask(node, msc.SetFlag(5))
    for _ in range(4):
        bench.sent()
        bench.hear("15", after=MSC_REQUEST)
    assert isinstance(refused.error, Refused)
    bench.hear(f"{ACK} {REPLY_1234}", after=0.5)
    assert bench.sent() == ACK
    assert bench.until_sent() == pytest.approx(1.0 + MSC_TAU), "of what was refused nothing has come for certain"


def test_r3_a_packet_that_came_in_noise_is_acknowledged_when_the_line_is_silent() -> None:
    """Else its unit would say it again, half a second to a second later, into the exchange of another."""
    bench, _ = msc_line()
    for _ in range(80):
        bench.hear("FF", after=0.015)
    assert bench.arbiter.noisy
    bench.hear(REPLY_1234, after=0.015)
    assert bench.sent() == "", "nothing is said into noise"
    assert bench.until_sent() <= 0.2
    assert bench.sent() == ACK
    bench.until_ready()
    assert bench.sent() == "", "once"


def test_r3_a_request_behind_two_acks_that_are_still_being_said_is_out_behind_both() -> None:
    """MSC: ACK for a stale packet, ACK for another, then the request: its times count from the end of all three."""
    bench, node = msc_line()
    bench.arbiter.byte_time = slow = 0.100
    bench.hear(REPLY_1234)
    bench.hear(REPLY_1234)
    assert bench.sent() == f"{ACK} {ACK}"
    heard = bench.now
    read = bench.ask(node, msc.DataRead(2008), retries=0)
    while not read.attempts:
        bench.to(bench.arbiter.poll_timeout())
    out = max(heard + 2 * slow, bench.now) + 16 * slow
    bench.to(out + 1.0 + slow - 0.001)
    assert not bench.ended(read)
    bench.wait(0.002)
    assert isinstance(read.error, NoReply)


def test_a_closing_ack_is_over_when_it_is_out() -> None:
    bench, node = msc_line()
    bench.ask(node, msc.DataRead(2008))
    bench.sent()
    bench.hear(ACK + REPLY_1234, after=MSC_REQUEST + 0.05)
    assert bench.sent() == ACK
    assert bench.arbiter.state is LineState.HOLDOFF
    acked = bench.now
    bench.until_ready()
    assert bench.now - acked == pytest.approx(MSC_TAU)


# echo, and broadcasts


def test_r3_on_an_echoing_port_the_max_reply_delay_counts_from_the_last_byte_of_the_echo() -> None:
    bench = Bench(echo=True)
    bench.ask(bench.node())
    bench.hear(bench.sent(), after=0.030)
    assert bench.until_sent() == pytest.approx(MAX_REPLY_DELAY)


@pytest.mark.parametrize("inside", [0.0001, 0.001])
def test_r3_on_an_echoing_port_a_reply_at_its_last_moment_is_delivered(inside: float) -> None:
    bench = Bench(echo=True)
    node = bench.node()
    first, second = bench.ask(node, retries=0), bench.ask(node, retries=0)
    bench.hear(bench.sent(), after=0.030)
    bench.wait(MAX_REPLY_DELAY - inside)
    assert second.attempts == 0
    bench.hear(FIVE)
    assert (first.value, second.value) == (5.0, None)


def test_r3_where_the_echo_is_lost_no_late_reply_is_awaited() -> None:
    """What came could not be told from the echo: the attempt is over with its window, and the line resynchronises."""
    bench = Bench(echo=True)
    read = bench.ask(bench.node(), retries=0)
    bench.ask(bench.node(2))
    bench.sent()
    bench.wait(REQUEST + 0.1001)
    assert str(read.error).startswith("node 1: no reply within 100 ms, and no echo of the request")
    bench.hear(FIVE, after=0.020)
    assert bench.until_sent() == pytest.approx(MAX_REPLY_DELAY - 0.1201)


def test_r1_a_node_whose_reply_was_lost_has_let_go_of_the_line_before_the_next_request() -> None:
    """The reply may have begun at the last moment: behind it the node's driver holds the line for its time."""
    released = 0.008
    reads = replace(hcp2.PROFILE.timings.read, driver_release_time=released)
    bench = Bench()
    node = bench.node(1, timings=replace(hcp2.PROFILE.timings, read=reads))
    bench.wait(1.0)
    bench.ask(node, retries=0)
    request = len(bytes.fromhex(bench.sent())) * TAU
    bench.ask(bench.node(2))
    assert bench.until_sent() == pytest.approx(request + MAX_REPLY_DELAY + released)


def test_a_broadcast_is_over_when_it_is_out_and_the_driver_release_time_later() -> None:
    bench = Bench()
    everybody, drive = bench.node(0, mentor.PROFILE), bench.node(12, mentor.PROFILE)
    bench.wait(1.0)
    bench.ask(everybody, mentor.Write(1, 17, 100))
    bench.ask(drive, mentor.Read(1, 17))
    said = len(bytes.fromhex(bench.sent())) * TAU
    driver_release_time = mentor.Write(1, 17, 100).open(0, mentor.PROFILE.timings).timing.driver_release_time
    assert driver_release_time > 0
    assert bench.until_sent() == pytest.approx(said + driver_release_time)


def test_a_broadcast_that_echoes_is_over_a_driver_release_time_behind_its_echo() -> None:
    bench = Bench(echo=True)
    everybody, drive = bench.node(0, mentor.PROFILE), bench.node(12, mentor.PROFILE)
    bench.wait(1.0)
    bench.ask(everybody, mentor.Write(1, 17, 100))
    bench.ask(drive, mentor.Read(1, 17))
    bench.hear(bench.sent(), after=0.030)
    driver_release_time = mentor.Write(1, 17, 100).open(0, mentor.PROFILE.timings).timing.driver_release_time
    assert bench.until_sent() == pytest.approx(driver_release_time)


def test_r1_what_is_said_behind_an_ack_is_calculated_from_the_end_of_both() -> None:
    bench, node = msc_line()
    bench.ask(node, msc.DataRead(2008))
    bench.ask(node, msc.DataRead(2008))
    assert bench.sent() == READ_2008
    bench.hear(ACK + REPLY_1234, after=MSC_REQUEST + 0.05)
    assert bench.sent() == f"{ACK} {READ_2008}"
    assert bench.until_sent() == pytest.approx(17 * MSC_TAU + 1.0 + MSC_TAU)
