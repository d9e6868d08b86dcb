"""MSC's packets: two steps, a closing ACK, stale packets, and a limit on one exchange (docs/protocols/msc.md, R9)."""

from __future__ import annotations

import pytest

from busmaster.arbiter.counters import LineState
from busmaster.arbiter.transaction import Priority, Transaction
from busmaster.errors import GarbledReply, NoReply, Refused
from busmaster.protocols.msc import codec as msc
from tests.arbiter.bench import Bench

READ_2008 = "02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74"
READ_2012 = "02 01 00 08 00 00 44 52 45 41 44 2C 07 DC 02 78"
REPLY_1234 = "02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D"
BAD_REPLY = "02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D3 02 6D"
ACK, NAK = "06", "15"
TAU = 10 / 9600


def bench(*, strict: bool = False) -> Bench:
    made = Bench(strict=strict)
    made.arbiter.byte_time = TAU
    return made


def test_ack_then_packet_then_the_hosts_ack_with_the_next_request_right_behind_it() -> None:
    line = bench()
    node = line.node(1, msc.PROFILE)
    line.wait(1.0)
    read = line.ask(node, msc.DataRead(2008))
    following = line.ask(node, msc.DataRead(2008))
    assert line.sent() == READ_2008
    line.hear(ACK, after=0.03)
    line.hear(REPLY_1234, after=0.1)
    assert (read.value, line.sent()) == (1234, f"{ACK} {READ_2008}")
    line.hear(ACK + REPLY_1234, after=0.05)
    assert (following.value, line.sent()) == (1234, ACK)
    assert line.arbiter.state is LineState.HOLDOFF, "nothing follows, but the ACK is not out yet"


def test_the_times_of_a_request_behind_the_hosts_ack_start_at_the_end_of_both() -> None:
    line = bench()
    node = line.node(1, msc.PROFILE)
    line.wait(1.0)
    line.ask(node, msc.DataRead(2008))
    following = line.ask(node, msc.DataRead(2012), retries=0)
    line.sent()
    line.hear(ACK + REPLY_1234, after=0.05)
    said = len(bytes.fromhex(line.sent())) * TAU
    line.wait(said + msc.PROFILE.timings.read.max_reply_delay + TAU - 0.001)
    assert following.error is None
    line.wait(0.002)
    assert isinstance(following.error, NoReply)


def test_a_bad_packet_is_naked_and_comes_again() -> None:
    line = bench()
    node = line.node(1, msc.PROFILE)
    line.wait(1.0)
    read = line.ask(node, msc.DataRead(2008))
    line.sent()
    line.hear(ACK + BAD_REPLY, after=0.05)
    assert line.sent() == NAK
    line.hear(REPLY_1234, after=0.05)
    assert (read.value, read.attempts) == (1234, 1)
    assert line.sent() == ACK


def test_a_device_that_naks_is_asked_three_times_more_and_then_refuses() -> None:
    line = bench()
    node = line.node(1, msc.PROFILE)
    line.wait(1.0)
    read = line.ask(node, msc.DataRead(2008))
    for _ in range(3):
        assert line.sent() == READ_2008
        line.hear(NAK, after=0.03)
    assert line.sent() == READ_2008
    line.hear(NAK, after=0.03)
    assert isinstance(read.error, Refused)
    assert read.attempts == 1


def test_r9_with_an_urgent_request_waiting_a_bad_packet_is_acked_away_and_the_silence_kept() -> None:
    line = bench()
    node = line.node(1, msc.PROFILE)
    line.wait(1.0)
    read = line.ask(node, msc.DataRead(2008), retries=0)
    urgent = line.ask(node, msc.ReadStatus(), priority=Priority.URGENT)
    line.sent()
    line.hear(ACK + BAD_REPLY, after=0.05)
    assert isinstance(read.error, GarbledReply)
    assert line.sent() == ACK
    own = TAU  # while our ACK is out, nothing can be heard
    assert line.until_sent() == pytest.approx(own + 0.100 + TAU), "the packet has begun: no maximum reply delay"
    assert line.sent().startswith("02 01 00 07"), "the urgent request"
    assert urgent.attempts == 1


def test_r9_an_exchange_past_its_limit_does_not_ask_again() -> None:
    line = bench()
    node = line.node(1, msc.PROFILE)
    line.wait(1.0)
    read = line.ask(node, msc.DataRead(2008), retries=0)
    line.sent()
    line.hear(ACK, after=0.4)
    line.hear(BAD_REPLY, after=0.9)
    assert line.sent() == NAK
    line.hear(BAD_REPLY, after=0.9)
    assert line.sent() == ACK
    assert isinstance(read.error, GarbledReply)


@pytest.mark.parametrize("stale", [REPLY_1234, BAD_REPLY])
def test_a_stale_packet_on_an_idle_line_is_acked_and_dropped(stale: str) -> None:
    line = bench()
    node = line.node(1, msc.PROFILE)
    line.wait(1.0)
    line.hear(stale)
    line.wait(0.2)
    assert line.sent() == ACK
    read = line.ask(node, msc.DataRead(2008))
    line.until_sent()
    line.sent()
    line.hear(ACK + REPLY_1234.replace("04 D2 02 6D", "04 D3 02 6E"), after=0.05)
    assert read.value == 1235


def test_a_stale_packet_while_the_line_resynchronises_is_acked_too() -> None:
    line = bench()
    node = line.node(1, msc.PROFILE)
    line.wait(1.0)
    read = line.ask(node, msc.DataRead(2008), retries=0)
    line.sent()
    line.hear("00", after=0.3)
    line.until_sent()
    assert line.sent() == ACK, "what was said in place of the ACK may be a packet"
    assert read.error is not None
    line.hear(REPLY_1234, after=0.1)
    assert line.sent() == ACK


def test_r3_on_a_noisy_line_nothing_is_sent_not_even_an_ack() -> None:
    line = bench()
    line.node(1, msc.PROFILE)
    line.wait(1.0)
    for _ in range(100):
        line.hear("FF", after=0.015)
    assert line.arbiter.noisy
    line.hear(REPLY_1234, after=0.015)
    assert line.sent() == ""
    line.wait(2.0)
    line.sent()
    line.hear(REPLY_1234)
    assert line.sent() == ACK


@pytest.mark.parametrize("chunk", [1, 10, 100])
def test_r3_a_late_ack_and_the_packet_behind_it_are_delivered(chunk: int) -> None:
    """Each step begins within its own maximum reply delay, so the packet may begin one maximum reply delay after the
    latest ACK."""
    line = bench()
    node = line.node(1, msc.PROFILE)
    line.wait(1.0)
    read = line.ask(node, msc.DataRead(2008), retries=0)
    line.ask(node, msc.DataRead(2012))
    request = len(bytes.fromhex(line.sent())) * TAU
    line.hear(ACK, after=request + 1.0)
    line.wait(0.99)
    assert line.sent() == ""
    packet = REPLY_1234.split()
    for start in range(0, len(packet), chunk):
        line.hear(" ".join(packet[start : start + chunk]), after=TAU)
    assert (read.value, read.late, read.attempts) == (1234, True, 1)
    assert line.sent() == f"{ACK} {READ_2012}"


def test_r3_a_late_ack_without_a_packet_behind_it_confirms_no_read() -> None:
    line = bench()
    node = line.node(1, msc.PROFILE)
    line.wait(1.0)
    read = line.ask(node, msc.DataRead(2008), retries=0)
    line.sent()
    line.hear(ACK, after=0.9)
    line.until_ready()
    assert str(read.error).startswith("node 1: no packet followed the ACK")
    assert line.now >= 1.0 + 0.9 + 1.0


@pytest.mark.parametrize(
    "heard",
    [
        REPLY_1234,
        ACK + BAD_REPLY,
        "FF" + ACK + REPLY_1234,
        ACK + ACK + REPLY_1234,
        ACK + "02 02 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6E",  # unit 2
        ACK + "02 01 00 08 00 00 52 46 4C 41 47 2C 00 01 01 A2",  # RFLAG
    ],
)
def test_r5_a_late_reply_has_to_match_in_all_that_one_in_time_has_to(heard: str) -> None:
    line = bench()
    node = line.node(1, msc.PROFILE)
    line.wait(1.0)
    read = line.ask(node, msc.DataRead(2008), retries=0)
    line.sent()
    line.hear(heard, after=0.9)
    line.until_ready()
    assert (line.ended(read), read.value) == (1, None)


def test_r3_an_ack_that_lies_behind_a_lost_port_is_followed_by_its_packet_too() -> None:
    line = bench()
    node = line.node(1, msc.PROFILE)
    line.wait(1.0)
    line.ask(node, msc.DataRead(2008))
    line.sent()
    line.arbiter.line_down("unplugged", line.now)
    line.wait(0.1)
    line.arbiter.line_up(line.now)
    line.ask(node, msc.DataRead(2012))
    line.hear(ACK, after=0.7)
    line.wait(0.95)
    assert line.sent() == ""


def test_half_a_packet_from_before_the_port_was_lost_is_not_gone_on_with() -> None:
    line = bench()
    line.node(1, msc.PROFILE)
    line.wait(1.0)
    line.hear(REPLY_1234[:20])
    line.arbiter.line_down("unplugged", line.now)
    line.arbiter.line_up(line.now)
    line.hear(REPLY_1234, after=0.1)
    assert line.sent() == ACK, "a whole packet, acknowledged at once"
    line.until_ready()
    assert line.sent() == "", "and the half one not at all"


def asked_twice_alike() -> tuple[Bench, Transaction]:
    """What is asked second of a unit could be answered by what its first answer was, said again."""
    line = bench(strict=True)
    node = line.node(1, msc.PROFILE)
    line.wait(1.0)
    line.ask(node, msc.DataRead(2008))
    line.sent()
    line.hear(ACK, after=0.030)
    line.hear(REPLY_1234, after=0.010)
    line.until_ready()
    second = line.ask(node, msc.DataRead(2012), retries=0)
    assert line.sent() == f"{ACK} {READ_2012}"
    line.hear(ACK, after=0.030)
    line.hear(REPLY_1234, after=0.010)
    return line, second


def test_r15_an_ambiguous_packet_is_acknowledged_at_once_and_held() -> None:
    """A unit says its packet again until it is acknowledged."""
    line, second = asked_twice_alike()
    assert (line.ended(second), line.sent()) == (0, ACK)
    line.until_ready()
    assert (line.ended(second), second.value, line.sent()) == (1, 1234, ""), "and acknowledged once"


def test_r15_an_ack_behind_a_packet_that_was_held_takes_it_away() -> None:
    """A unit that heard the first request twice answers it twice; only then comes the second one's answer."""
    line, second = asked_twice_alike()
    line.hear(ACK, after=0.003)
    assert isinstance(second.error, GarbledReply)


def test_bytes_that_begin_no_packet_get_no_ack_on_an_idle_line() -> None:
    line = bench()
    line.node(1, msc.PROFILE)
    line.wait(1.0)
    line.hear("00 55")
    line.wait(1.0)
    assert line.sent() == ""


def test_r3_an_ack_that_leaves_late_delays_the_end_of_the_silence() -> None:
    waited = []
    for late in (0.0, 0.05):
        line = bench()
        node = line.node(1, msc.PROFILE)
        line.wait(1.0)
        line.ask(node, msc.DataRead(2008), retries=0)
        line.sent()
        line.hear("00", after=0.3)
        line.until_sent()
        line.sent()
        line.hear(REPLY_1234, after=0.1)
        assert line.sent() == ACK
        acknowledged = line.now
        line.now += late
        line.arbiter.transmitted(line.now)
        line.ask(node, msc.DataRead(2008))
        line.until_sent()
        waited.append(line.now - acknowledged)
    assert waited[1] - waited[0] == pytest.approx(0.05)
