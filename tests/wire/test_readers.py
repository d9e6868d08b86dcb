"""The shared reader, on telegrams as HCP and HCP2 send them: STX, element, data, ETX, exclusive-or."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster.contract.exchange import MORE, OTHER_FORMAT, Done, FrameError
from busmaster.contract.timing import ReplyTiming
from busmaster.errors import Refused
from busmaster.wire.checks import xor
from busmaster.wire.numbers import parse_number
from busmaster.wire.readers import AcknowledgeReader, TelegramReader, find_field, telegram_sizes

TIMING = ReplyTiming(0.05, 0.1, 0.15, 0.02)
REPLY = bytes.fromhex("02 30 31 31 32 33 2E 34 35 36 03 2B")  # Comms(1) = 123.456
HEADER = b"\x0201"


class Text(TelegramReader[bytes]):
    __slots__ = ()
    longest = 20
    sizes = telegram_sizes(echo=2, typical=7, longest=20)

    def parse(self, field: bytes) -> bytes:
        return field


def reader() -> Text:
    return Text(b"request", HEADER, TIMING)


def test_the_data_lies_between_the_echo_and_etx() -> None:
    assert reader().feed(REPLY) == Done(b"123.456")


def test_every_split_of_a_reply_equals_one_chunk() -> None:
    for cut in range(1, len(REPLY)):
        exchange = reader()
        assert exchange.feed(REPLY[:cut]) is MORE
        assert exchange.feed(REPLY[cut:]) == Done(b"123.456")


def test_bytes_after_the_reply_are_handed_back() -> None:
    assert reader().feed(REPLY + b"\x06x") == Done(b"123.456", rest=b"\x06x")
    assert AcknowledgeReader(b"", TIMING).feed(b"\x06\x06") == Done(None, rest=b"\x06")


def test_an_empty_chunk_changes_nothing() -> None:
    exchange = reader()
    assert exchange.feed(b"") is MORE
    exchange.feed(REPLY[:5])
    assert exchange.feed(b"") is MORE
    assert exchange.feed(REPLY[5:]) == Done(b"123.456")
    assert AcknowledgeReader(b"", TIMING).feed(b"") is MORE


@pytest.mark.parametrize("check", [b"\x02", b"\x03", b"\x04", b"\x05", b"\x06", b"\x07", b"\x15"])
def test_the_byte_after_etx_is_the_checksum_whatever_its_value(check: bytes) -> None:
    data = bytes([0x41, 0x41 ^ check[0] ^ xor(b"01\x03")])
    reply = b"\x0201" + data + b"\x03" + check
    exchange = reader()
    assert [exchange.feed(reply[i : i + 1]) for i in range(len(reply) - 1)] == [MORE] * (len(reply) - 1)
    assert exchange.feed(check) == Done(data)


def test_a_bad_checksum_is_a_whole_frame_unless_something_follows() -> None:
    bad = REPLY[:-1] + b"\x2a"
    with pytest.raises(FrameError, match="checksum") as alone:
        reader().feed(bad)
    assert alone.value.whole
    with pytest.raises(FrameError, match="checksum") as followed:
        reader().feed(bad + b"\x2b")
    assert not followed.value.whole


@pytest.mark.parametrize(
    ("reply", "why"),
    [
        (b"\x0202", "wrong echo"),
        (b"\x021", "wrong echo"),
        (b"\x0201\x04", "control character"),
        (b"\x0201\0", "control character"),
        (b"\x02011\x02", "control character"),
        (b"\x0201\xb1", "control character"),
        (b"\x06", "cannot begin with 06"),
        (b"x", "cannot begin with 78"),
    ],
)
def test_a_frame_that_cannot_be_right_fails_at_its_first_wrong_byte(reply: bytes, why: str) -> None:
    exchange = reader()
    for i in range(len(reply) - 1):
        assert exchange.feed(reply[i : i + 1]) is MORE
    with pytest.raises(FrameError, match=why) as failure:
        exchange.feed(reply[-1:])
    assert not failure.value.whole
    with pytest.raises(FrameError, match=why):
        reader().feed(reply)


def test_20_characters_of_data_are_read() -> None:
    body = b"01" + b"1" * 20 + b"\x03"
    assert reader().feed(b"\x02" + body + bytes([xor(body)])) == Done(b"1" * 20)


def too_long(check: int = 0) -> bytes:
    body = b"01" + b"1" * 24 + b"\x03"
    return b"\x02" + body + bytes([xor(body) ^ check])


def test_data_that_are_too_long_are_another_format_if_their_check_is_right() -> None:
    exchange = reader()
    for byte in too_long()[:-1]:
        assert exchange.feed(bytes([byte])) is MORE
    with pytest.raises(FrameError) as failure:
        exchange.feed(too_long()[-1:])
    what = "29 bytes came, right in their check but of another format: 24 characters of data where 20 are the most"
    assert failure.value.what == what
    assert (failure.value.hint, failure.value.whole, failure.value.heard) == (OTHER_FORMAT, False, b"")


@pytest.mark.parametrize(
    "heard",
    [
        pytest.param(too_long(check=1), id="wrong in their check"),
        pytest.param(HEADER + b"1" * 24 + b"\x04", id="with a control character in them"),
        pytest.param(HEADER + b"1" * 81, id="without an end"),
    ],
)
def test_data_that_are_too_long_otherwise_are_damaged(heard: bytes) -> None:
    exchange = reader()
    for byte in heard[:-1]:
        assert exchange.feed(bytes([byte])) is MORE
    for reading, rest in ((exchange, heard[-1:]), (reader(), heard)):
        with pytest.raises(FrameError, match="more than 20 characters") as failure:
            reading.feed(rest)
        assert (failure.value.hint, failure.value.whole) == (None, False)


class Number(Text):
    __slots__ = ()
    parse = staticmethod(parse_number)  # type: ignore[assignment]  # its value is a number


def test_data_that_mean_nothing_are_another_format() -> None:
    body = b"01+1.5V\x03"
    with pytest.raises(FrameError) as failure:
        Number(b"request", HEADER, TIMING).feed(b"\x02" + body + bytes([xor(body)]))
    assert failure.value.what == "10 bytes came, right in their check but of another format: b'+1.5V' is not a number"
    assert failure.value.hint == OTHER_FORMAT


@pytest.mark.parametrize("character", [0x20, 0x7E])
def test_data_are_made_of_printable_characters_to_the_first_and_the_last(character: int) -> None:
    body = b"01" + bytes([character]) + b"\x03"
    assert reader().feed(b"\x02" + body + bytes([xor(body)])) == Done(bytes([character]))


@pytest.mark.parametrize("character", [0x1F, 0x7F, 0x00, 0x80, 0xFF])
def test_what_lies_just_beside_them_is_no_data(character: int) -> None:
    with pytest.raises(FrameError, match="control character"):
        reader().feed(HEADER + bytes([character]))


def test_a_telegram_has_three_bytes_around_its_echo_and_data() -> None:
    sizes = telegram_sizes(echo=2, typical=7, longest=20)
    assert (sizes.typical, sizes.longest) == (12, 25)


def test_a_reader_says_what_it_heard_in_place_of_its_reply() -> None:
    for heard in (b"\x0202", b"\x06"):
        with pytest.raises(FrameError) as failure:
            reader().feed(heard)
        assert failure.value.heard == heard
    with pytest.raises(FrameError, match="cannot begin with 78"):
        reader().feed(b"x1")
    with pytest.raises(FrameError) as failure:
        AcknowledgeReader(b"", TIMING).feed(b"x1")
    assert failure.value.heard == b"x1"


def test_a_reader_names_what_it_may_still_be_overdue() -> None:
    assert (reader().answers, reader().overdue) == ((HEADER,), (HEADER,))
    acknowledge = AcknowledgeReader(b"", TIMING)
    assert (acknowledge.answers, acknowledge.overdue, acknowledge.starts) == ((b"\x06",), (b"\x06",), b"\x06\x15")
    assert (reader().answered, reader().closing, reader().later) == (True, 0, ())


def test_silence_and_a_cut_frame_are_told_apart() -> None:
    with pytest.raises(FrameError, match="no reply"):
        reader().expired(started=False)
    with pytest.raises(FrameError, match="no reply"):
        AcknowledgeReader(b"", TIMING).expired(started=False)
    exchange = reader()
    exchange.feed(REPLY[:5])
    with pytest.raises(FrameError, match="cut short after 5 bytes"):
        exchange.expired(started=True)


def test_a_value_needs_a_parser() -> None:
    with pytest.raises(NotImplementedError):
        TelegramReader.parse(reader(), b"1")


@given(st.binary(max_size=30))
def test_garbage_is_more_or_a_frame_error(garbage: bytes) -> None:
    try:
        field = find_field(HEADER + garbage, HEADER, 20, xor)
        assert field is None or garbage.startswith(field + b"\x03")
    except FrameError:
        pass


def test_a_lone_nak_is_a_refusal() -> None:
    with pytest.raises(Refused) as read:
        reader().feed(b"\x15")
    with pytest.raises(Refused) as write:
        AcknowledgeReader(b"", TIMING).feed(b"\x15")
    assert read.value.confirm
    assert write.value.confirm
