"""MSC on the wire: ACK, packet, the host's ACK; packets sent again; stale ones; ways out."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest

from busmaster.contract.exchange import MORE, OTHER_FORMAT, Done, Expect, FrameError, Refused
from busmaster.protocols.msc.codec import PROFILE, BlockRead, DataRead, DataWrite, ReadFlag, ReadStatus
from busmaster.protocols.msc.exchange import PacketExchange, StalePacketListener, packet, packet_size

ACK, NAK = b"\x06", b"\x15"
TIMINGS = PROFILE.timings
REPLY = bytes.fromhex("02 01 00 0a 00 00 44 52 45 41 44 2c 00 00 04 d2 02 6d")
BAD = REPLY[:-1] + b"\x6e"
STALE = packet(9, b"RFLAG,\0\1")


def reading() -> PacketExchange[int]:
    return DataRead(2008).open(1, TIMINGS)


def acked() -> PacketExchange[int]:
    exchange = reading()
    assert exchange.feed(ACK) == Expect(TIMINGS.packet, exchange.later[0].sizes)
    return exchange


def writing() -> PacketExchange[None]:
    return DataWrite(2008, 1234).open(1, TIMINGS)


def feed_in_chunks(exchange: PacketExchange[Any], data: bytes, chunk: int) -> None:
    for start in range(0, len(data), chunk):
        exchange.feed(data[start : start + chunk])


def says(progress: object) -> bytes:
    assert isinstance(progress, Expect)
    return progress.send


# as IB-11A002 has it


def test_a_read_is_overdue_an_ack_and_its_packet_and_once_it_is_acked_its_packet_alone() -> None:
    assert reading().overdue == (ACK, *reading().answers)
    assert acked().overdue == acked().answers


def test_a_read_is_an_ack_and_a_packet_that_the_host_acks() -> None:
    exchange = acked()
    assert exchange.feed(REPLY) == Done(1234, send=ACK)


def test_a_write_is_done_with_its_ack() -> None:
    assert writing().feed(ACK) == Done(None)
    assert (writing().later, writing().closing) == ((), 0)


def test_a_read_announces_its_packet_and_its_closing_ack() -> None:
    exchange = BlockRead(0).open(1, TIMINGS)
    (step,) = exchange.later
    assert (step.timing, step.sizes.typical, step.sent) == (TIMINGS.packet, 142, 0)
    assert (exchange.sizes.typical, exchange.closing) == (1, 1)


def test_the_block_sequence_number_is_not_used() -> None:
    body = REPLY[1:-2].replace(b"\x0a\0\0", b"\x0a\x12\x34")
    numbered = b"\x02" + body + sum(body).to_bytes(2, "big")
    assert acked().feed(numbered) == Done(1234, send=ACK)


def test_what_follows_the_packet_is_handed_back() -> None:
    assert acked().feed(REPLY + b"\x02\x01") == Done(1234, send=ACK, rest=b"\x02\x01")
    assert writing().feed(ACK + ACK) == Done(None, rest=ACK)


# the device says NAK


def test_a_naked_request_is_sent_again_three_times_and_then_refused() -> None:
    for exchange in (reading(), writing()):
        for _ in range(3):
            assert exchange.feed(NAK) == Expect(exchange.timing, exchange.sizes, exchange.request)
        with pytest.raises(Refused, match="refused 4 times") as refusal:
            exchange.feed(NAK)
        assert not refusal.value.confirm


def test_an_ack_after_two_naks_is_as_good_as_at_once() -> None:
    exchange = reading()
    assert says(exchange.feed(NAK)) == says(exchange.feed(NAK)) == exchange.request
    exchange.feed(ACK)
    assert exchange.feed(REPLY) == Done(1234, send=ACK)


def test_a_byte_behind_a_nak_is_never_taken_for_the_ack_of_the_packet_sent_again() -> None:
    exchange = writing()
    assert exchange.feed(NAK + ACK) is MORE
    with pytest.raises(FrameError, match="2 bytes that are not a packet"):
        exchange.expired(True)


# the packet is damaged


def test_a_bad_packet_is_naked_five_times_and_then_acked_away() -> None:
    exchange = acked()
    for _ in range(5):
        assert exchange.feed(BAD) == Expect(TIMINGS.packet, exchange.later[0].sizes, NAK)
    with pytest.raises(FrameError, match="bad checksum") as error:
        exchange.feed(BAD)
    assert (error.value.whole, error.value.send) == (True, ACK)


def test_a_packet_that_comes_well_after_five_bad_ones_still_counts() -> None:
    exchange = acked()
    for _ in range(5):
        exchange.feed(BAD)
    assert exchange.feed(REPLY) == Done(1234, send=ACK)


def test_a_cut_packet_is_naked_when_the_line_pauses() -> None:
    exchange = acked()
    assert exchange.feed(REPLY[:9]) is MORE
    assert says(exchange.expired(True)) == NAK
    assert exchange.feed(REPLY) == Done(1234, send=ACK)


@pytest.mark.parametrize(
    "heard",
    [
        pytest.param(b"\x03" + REPLY[1:], id="no STX"),
        pytest.param(b"\x02\x01\x01" + REPLY[3:], id="a length that no packet has"),
        pytest.param(b"\x02\x00" + REPLY[2:], id="a unit that does not exist"),
        pytest.param(REPLY[:3] + b"\x08" + REPLY[4:], id="a length that ends too early"),
        pytest.param(REPLY[:3] + b"\x8a" + REPLY[4:], id="a length that ends too late"),
        pytest.param(BAD + b"\x00", id="a byte too many"),
    ],
)
def test_a_reader_that_has_lost_count_says_nak_only_when_the_line_pauses(heard: bytes) -> None:
    for chunks in ([heard], [bytes((byte,)) for byte in heard[:-1]]):
        exchange = acked()
        progresses = [exchange.feed(chunk) for chunk in chunks]
        if progresses[-1] is MORE:
            assert says(exchange.expired(True)) == NAK
        assert exchange.feed(REPLY) == Done(1234, send=ACK)


def test_a_babbling_line_is_not_listened_to_without_end() -> None:
    exchange = acked()
    assert all(exchange.feed(b"\xaa") is MORE for _ in range(248))
    with pytest.raises(FrameError, match="without a pause"):
        exchange.feed(b"\xaa")


@pytest.mark.parametrize("data", [241, 255])
def test_a_packet_that_is_longer_than_any_may_be_is_another_format_if_its_check_is_right(data: int) -> None:
    of_another_format = f"right in their check but of another format: {data} bytes of data where 240 are the most"
    for chunk in (1, 99, 999):
        exchange = acked()
        with pytest.raises(FrameError) as error:
            feed_in_chunks(exchange, packet(1, b"DREAD," + bytes(data - 6)), chunk)
        assert error.value.what == f"{data + 8} bytes came, {of_another_format}"
        assert (error.value.hint, error.value.send, error.value.whole) == (OTHER_FORMAT, ACK, False)


@pytest.mark.parametrize(
    ("heard", "after"),
    [
        pytest.param(packet(1, b"DREAD," + bytes(235))[:-1] + b"x", 249, id="wrong in its check"),
        pytest.param(packet(1, b"DREAD," + bytes(235)) + b"x", 250, id="with a byte behind it"),
        pytest.param(b"\x02\x01\x02" + bytes(600), 249, id="longer than is listened to"),
    ],
)
def test_another_packet_that_is_too_long_is_not_answered(heard: bytes, after: int) -> None:
    exchange = acked()
    with pytest.raises(FrameError, match="without a pause") as error:
        exchange.feed(heard[:after])
    assert (error.value.hint, error.value.send) == (None, b"")


def test_a_packet_of_another_length_than_asked_for_is_another_format_if_none_follows() -> None:
    exchange = acked()
    assert says(exchange.feed(packet(1, b"DREAD," + bytes(6)))) == ACK
    with pytest.raises(FrameError) as error:
        exchange.expired(False)
    assert error.value.what == "20 bytes came, right in their check but of another format: the requested packet has 18"
    assert (error.value.hint, error.value.send) == (OTHER_FORMAT, ACK)


def test_no_packet_after_the_ack_fails_with_an_ack_for_one_that_was_lost() -> None:
    with pytest.raises(FrameError, match="no packet followed the ACK") as error:
        acked().expired(False)
    assert (error.value.whole, error.value.send) == (False, ACK)


def test_no_ack_is_no_reply() -> None:
    exchange = reading()
    assert exchange.feed(b"") is MORE
    with pytest.raises(FrameError, match="no reply") as error:
        exchange.expired(False)
    assert error.value.send == b""


# packets that answer something else


def test_a_packet_before_the_ack_is_acked_dropped_and_the_ack_awaited() -> None:
    exchange = reading()
    assert exchange.feed(REPLY) == Expect(exchange.timing, exchange.sizes, ACK)
    exchange.feed(ACK)
    assert exchange.feed(packet(1, b"DREAD,\0\0\0\7")) == Done(7, send=ACK)


def test_an_ack_glued_to_a_stale_packet_is_the_requests_once_the_line_pauses() -> None:
    exchange = writing()
    assert says(exchange.feed(STALE + ACK)) == ACK
    assert exchange.feed(b"") is MORE
    assert exchange.expired(False) == Done(None)


def test_a_writes_ack_behind_a_stale_packet_counts_once_the_line_pauses() -> None:
    exchange = writing()
    assert says(exchange.feed(STALE)) == ACK
    assert exchange.feed(ACK) is MORE
    assert exchange.expired(True) == Done(None)


TWICE = packet(6, b"RFLAG,\0\1")
"""Said twice at once, the host's ACK destroys the second one's STX. Unit 6 remains, and looks like an ACK."""


@pytest.mark.parametrize("chunk", [1, 4, 99])
def test_a_stale_packet_said_twice_is_no_writes_ack(chunk: int) -> None:
    exchange = writing()
    assert says(exchange.feed(TWICE)) == ACK
    with pytest.raises(FrameError, match="within other bytes") as error:
        feed_in_chunks(exchange, TWICE[1:], chunk)
    assert error.value.send == b"", "nobody talks into a packet"


def test_a_stale_packet_said_twice_is_no_reads_ack_and_the_reply_is_not_asked_for_again() -> None:
    """A NAK would make its device send it once more, and it may be of the unit and the command that were asked."""
    exchange = reading()
    assert says(exchange.feed(TWICE)) == ACK
    assert says(exchange.feed(TWICE[1:2])) == b""
    assert exchange.feed(TWICE[2:]) is MORE
    with pytest.raises(FrameError, match="that are not a packet"):
        exchange.expired(True)


def test_six_stale_packets_are_dropped_and_the_seventh_ends_the_attempt() -> None:
    for exchange in (reading(), acked()):
        for _ in range(6):
            assert says(exchange.feed(STALE)) == ACK
        with pytest.raises(FrameError, match="a packet for another request") as error:
            exchange.feed(STALE)
        assert error.value.send == ACK


@pytest.mark.parametrize(
    "other",
    [
        pytest.param(packet(2, b"DREAD,\0\0\0\7"), id="of another unit"),
        pytest.param(packet(1, b"BREAD," + bytes(128)), id="of another command"),
        pytest.param(packet(1, b"RREAD,\0\0\0\7"), id="of another command of equal length"),
        pytest.param(packet(1, b"DREAD,\0\7"), id="of another length"),
    ],
)
def test_a_packet_that_names_something_else_is_never_the_reply(other: bytes) -> None:
    exchange = acked()
    assert exchange.feed(other) == Expect(TIMINGS.packet, exchange.later[0].sizes, ACK)
    assert exchange.feed(REPLY) == Done(1234, send=ACK)


def test_a_damaged_packet_before_the_ack_ends_the_attempt_when_the_line_pauses() -> None:
    """No byte in the middle of it may be taken for the ACK."""
    exchange = writing()
    assert exchange.feed(BAD + ACK) is MORE
    with pytest.raises(FrameError, match="that are not a packet") as error:
        exchange.expired(True)
    assert error.value.send == ACK


def test_bytes_that_are_no_packet_are_told_by_their_number_and_the_first_of_them() -> None:
    exchange = reading()
    exchange.feed(b"\x41\x42\x43")
    with pytest.raises(FrameError, match="3 bytes that are not a packet, the first of them 41"):
        exchange.expired(True)


def test_a_packet_before_the_ack_that_is_cut_short_ends_the_attempt() -> None:
    exchange = writing()
    assert exchange.feed(STALE[:5]) is MORE
    with pytest.raises(FrameError, match="cut short after 5 bytes") as error:
        exchange.expired(True)
    assert error.value.send == ACK


def test_the_requests_own_echo_is_named_as_such() -> None:
    """Or the echo of the ACK that answers it would be taken for the device's."""
    exchange = writing()
    with pytest.raises(FrameError, match="echo=True"):
        exchange.feed(exchange.request)


# ways out


def test_a_read_that_must_not_go_on_acks_the_bad_packet_away() -> None:
    exchange = acked()
    exchange.feed(BAD)
    failure = exchange.abandon()
    assert isinstance(failure, FrameError)
    assert (failure.whole, failure.send) == (True, ACK)


def test_a_cut_or_stale_packet_is_acked_away_and_the_line_resynchronises() -> None:
    cut, stale = acked(), reading()
    cut.feed(REPLY[:9])
    cut.expired(True)
    stale.feed(STALE)
    for exchange in (cut, stale):
        failure = exchange.abandon()
        assert isinstance(failure, FrameError)
        assert (failure.whole, failure.send) == (False, ACK)


def test_a_naked_request_that_must_not_be_repeated_now_is_refused_until_it_is_confirmed() -> None:
    exchange = writing()
    exchange.feed(NAK)
    failure = exchange.abandon()
    assert isinstance(failure, Refused)
    assert failure.confirm


@pytest.mark.parametrize(
    ("heard", "size"),
    [
        ("02 01 00 05", 13),
        ("02 0F 00 F0", 248),
        ("02 0F 00 F1", None),
        ("02 00 00 05", None),
        ("02 10 00 05", None),
        ("06 01 00 05", None),
        ("02 01 00", 0),
    ],
)
def test_a_packet_begins_with_stx_a_unit_and_the_length_of_its_body(heard: str, size: int | None) -> None:
    assert packet_size(bytes.fromhex(heard)) == size


# while nothing is asked


def test_a_stale_packet_is_acked_and_dropped_in_any_chunks() -> None:
    listener = StalePacketListener()
    for _ in range(2):
        assert listener.feed(b"") is MORE
        assert all(listener.feed(bytes((byte,))) is MORE for byte in STALE[:-1])
        assert listener.feed(STALE[-1:]) == Done(None, send=ACK)


@pytest.mark.parametrize("chunk", [1, 2, 7, 100])
@pytest.mark.parametrize("before", [ACK, ACK + ACK, STALE, ACK + STALE, STALE + ACK])
def test_an_ack_or_a_packet_in_front_does_not_hide_a_stale_packet(before: bytes, chunk: int) -> None:
    listener = StalePacketListener()
    heard = before + REPLY
    said = []
    for start in range(0, len(heard), chunk):
        with suppress(FrameError):
            said.append(listener.feed(heard[start : start + chunk]))
    assert said[-1] == Done(None, send=ACK)


def test_the_ack_of_a_stale_packet_is_not_said_into_the_next_one() -> None:
    listener = StalePacketListener()
    assert listener.feed(STALE + REPLY[:5]) is MORE
    assert listener.feed(REPLY[5:]) == Done(None, send=ACK), "one for both"


def test_a_stale_packet_with_noise_behind_it_is_acked_all_the_same() -> None:
    with pytest.raises(FrameError, match="unexpected") as error:
        StalePacketListener().feed(STALE + b"\xff")
    assert error.value.send == ACK


def test_a_damaged_stale_packet_is_acked_when_the_line_pauses() -> None:
    listener = StalePacketListener()
    for heard in (BAD, STALE[:7], b"\x02\xff\xff\xff"):
        assert listener.feed(heard) is MORE
        assert listener.expired() == Done(None, send=ACK)


@pytest.mark.parametrize("unexpected", [ACK, NAK, b"\x00" + STALE, b"\x02\xff" + bytes(300)])
def test_what_is_no_stale_packet_is_not_answered(unexpected: bytes) -> None:
    listener = StalePacketListener()
    with pytest.raises(FrameError, match="unexpected") as error:
        listener.feed(unexpected)
    assert error.value.send == b""
    assert listener.feed(STALE) == Done(None, send=ACK)


def test_the_end_of_a_packet_that_was_asked_for_again_is_passed_over_and_not_asked_for_twice() -> None:
    """A noise byte before the checksum pushes its last byte out; a unit says its packet once for each NAK."""
    exchange = acked()
    pushed = REPLY[:-2] + b"\x23" + REPLY[-2:]
    assert says(exchange.feed(pushed[: len(REPLY)])) == NAK
    assert exchange.feed(pushed[len(REPLY) :]) is MORE
    assert says(exchange.expired(True)) == b""
    assert exchange.feed(REPLY) == Done(1234, send=ACK)


@pytest.mark.parametrize("noise", [NAK, REPLY[:1], REPLY[:7]])
def test_fewer_bytes_than_a_packet_has_before_it_are_passed_over_and_not_asked_for_again(noise: bytes) -> None:
    """Another unit's NAK, say: a NAK of ours would have the packet said twice, into the next exchange."""
    exchange = acked()
    assert exchange.feed(noise) is MORE
    assert says(exchange.expired(True)) == b""
    assert exchange.feed(REPLY) == Done(1234, send=ACK)


def test_what_never_becomes_a_packet_is_passed_over_a_few_times_and_no_more() -> None:
    exchange = acked()
    assert says(exchange.feed(BAD)) == NAK
    for _ in range(4):
        exchange.feed(b"\x55")
        assert says(exchange.expired(True)) == b""
    exchange.feed(b"\x55")
    with pytest.raises(FrameError, match="that are not a packet"):
        exchange.expired(True)


def test_a_bad_unit_byte_with_the_right_length_is_no_exemption_from_resynchronising() -> None:
    heard = REPLY[:1] + b"\x03" + REPLY[2:]
    exchange = acked()
    for _ in range(5):
        assert says(exchange.feed(heard)) == NAK
    with pytest.raises(FrameError, match="bad checksum") as error:
        exchange.feed(heard)
    assert not error.value.whole


def test_a_flags_reply_like_its_request_is_taken_after_the_ack() -> None:
    """RFLAG of flag 1: the packet "it is on" is the request's own bytes."""
    exchange = ReadFlag(1).open(4, TIMINGS)
    exchange.feed(ACK)
    assert exchange.feed(exchange.request) == Done(True, send=ACK)


def test_a_short_open_ended_packet_with_a_bad_checksum_is_naked_after_a_pause() -> None:
    short = packet(1, b"RQSTAT,\x00\x41")
    exchange = ReadStatus().open(1, TIMINGS)
    exchange.feed(ACK)
    assert exchange.feed(short[:-1] + b"\xff") is MORE
    assert says(exchange.expired(True)) == NAK
    assert exchange.feed(short) == Done(65, send=ACK)
