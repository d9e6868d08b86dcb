"""DC104: every byte of its manual, and what is no reply."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster.contract.exchange import MORE, Done, FrameError
from busmaster.errors import InvalidCommand, Refused
from busmaster.protocols.dc104.codec import PROFILE, Read, Write
from tests.protocols.asking import vectors

FRAMES = vectors("DC104")
ACK, NAK = b"\x06", b"\x15"
PARAMETERS = st.integers(1, 255)
VALUES = st.integers(0, 65535)


def frames(prefix: str) -> list[tuple[list[int], bytes]]:
    """The numbers in the name of each frame of that kind, and its bytes."""
    return [
        ([int(word) for word in name.split() if word.isdigit()], data)
        for name, data in FRAMES.items()
        if name.startswith(prefix)
    ]


def reply(parameter: int, value: int) -> bytes:
    body = bytes((parameter, value >> 8, value & 255))
    return b"\x02" + body + bytes((sum(body) % 256,))


@pytest.mark.parametrize(("numbers", "frame"), frames("read param"))
def test_a_read_is_sent_as_the_published_frame(numbers: list[int], frame: bytes) -> None:
    assert Read(*numbers).open(0, PROFILE.timings).request == frame


@pytest.mark.parametrize(("numbers", "frame"), frames("write param"))
def test_a_write_is_sent_as_the_published_frame(numbers: list[int], frame: bytes) -> None:
    assert Write(*numbers).open(0, PROFILE.timings).request == frame


@pytest.mark.parametrize(("numbers", "frame"), frames("reply param"))
def test_a_published_reply_gives_its_value(numbers: list[int], frame: bytes) -> None:
    parameter, value = numbers
    assert Read(parameter).open(0, PROFILE.timings).feed(frame) == Done(value)


def test_every_frame_of_the_vectors_is_one_of_the_three_kinds() -> None:
    assert len(FRAMES) == sum(len(frames(kind)) for kind in ("read param", "write param", "reply param"))


@given(PARAMETERS, VALUES)
def test_the_checksum_is_the_sum_of_all_bytes_between_stx_and_itself(parameter: int, value: int) -> None:
    read = Read(parameter).open(0, PROFILE.timings).request
    write = Write(parameter, value).open(0, PROFILE.timings).request
    assert (read[1], write[1]) == (0xAA, 0x55)
    for request in (read, write):
        assert request[-1] == sum(request[1:-1]) % 256


@given(PARAMETERS, VALUES)
def test_any_reply_gives_its_value_one_byte_at_a_time_too(parameter: int, value: int) -> None:
    exchange = Read(parameter).open(0, PROFILE.timings)
    *cut, last = reply(parameter, value)
    assert all(exchange.feed(bytes((byte,))) is MORE for byte in cut)
    assert exchange.feed(bytes((last,))) == Done(value)


@given(PARAMETERS, PARAMETERS, VALUES)
def test_a_reply_for_another_parameter_is_an_error_and_no_exemption_from_resynchronising(
    a: int, b: int, value: int
) -> None:
    if a != b:
        with pytest.raises(FrameError, match="wrong echo") as error:
            Read(a).open(0, PROFILE.timings).feed(reply(b, value))
        assert not error.value.whole


def test_a_bad_checksum_with_nothing_behind_it_is_a_whole_frame() -> None:
    for heard, whole in ((b"\x02\x01\x04\xd2\xd8", True), (b"\x02\x01\x04\xd2\xd8\x00", False)):
        with pytest.raises(FrameError, match="bad checksum") as error:
            Read(1).open(0, PROFILE.timings).feed(heard)
        assert error.value.whole is whole


def test_bytes_after_a_reply_are_handed_back() -> None:
    assert Read(1).open(0, PROFILE.timings).feed(reply(1, 1234) + b"\x02\x01") == Done(1234, rest=b"\x02\x01")
    assert Write(1, 1).open(0, PROFILE.timings).feed(ACK + NAK) == Done(None, rest=NAK)


def test_a_nak_refuses_a_read_and_a_write() -> None:
    for command in (Read(1), Write(1, 1)):
        with pytest.raises(Refused) as error:
            command.open(0, PROFILE.timings).feed(NAK)
        assert error.value.confirm


def test_an_ack_is_no_reply_to_a_read_and_a_packet_none_to_a_write() -> None:
    with pytest.raises(FrameError):
        Read(6).open(0, PROFILE.timings).feed(ACK)
    with pytest.raises(FrameError):
        Write(1, 1234).open(0, PROFILE.timings).feed(reply(1, 1234))


def test_nothing_is_harmless_and_silence_is_an_error() -> None:
    for command in (Read(1), Write(1, 1)):
        exchange = command.open(0, PROFILE.timings)
        assert exchange.feed(b"") is MORE
        with pytest.raises(FrameError, match="no reply"):
            exchange.expired(False)


def test_a_reply_cut_short_says_how_short() -> None:
    exchange = Read(1).open(0, PROFILE.timings)
    assert exchange.feed(b"\x02\x01\x04") is MORE
    with pytest.raises(FrameError, match="cut short after 3 bytes"):
        exchange.expired(True)


@pytest.mark.parametrize(
    ("parameter", "limits"),
    [
        (0, {}),
        (256, {}),
        (-1, {}),
        (121, {"maximum": 120}),
        (1.5, {}),
        (True, {}),
        ("1", {}),
        (5, {"maximum": 256}),
        (5, {"minimum": 2}),
        (0, {"minimum": 0, "maximum": 0}),
    ],
)
def test_a_parameter_that_the_drive_does_not_have_is_never_sent(parameter: int, limits: dict[str, int]) -> None:
    for build in (lambda: Read(parameter, **limits), lambda: Write(parameter, 0, **limits)):
        with pytest.raises(InvalidCommand):
            build()


@pytest.mark.parametrize("value", [-1, 65536, 1.0, None, False])
def test_a_value_that_is_no_word_is_never_sent(value: int) -> None:
    with pytest.raises(InvalidCommand):
        Write(1, value)


def test_parameter_0_takes_the_option_for_it() -> None:
    assert Read(0, minimum=0).open(0, PROFILE.timings).request == bytes.fromhex("02 aa 00 aa")
    assert Write(0, 1, minimum=0).parameter == 0


@pytest.mark.parametrize("maximum", [1, 255])
def test_a_drive_may_have_one_parameter_or_all_that_can_be_named(maximum: int) -> None:
    assert Read(maximum, maximum=maximum).parameter == maximum
    with pytest.raises(InvalidCommand):
        Read(maximum + 1, maximum=maximum)


def test_commands_say_what_they_do() -> None:
    assert (str(Read(7)), repr(Read(7))) == ("read parameter 7", "Read(parameter=7)")
    assert str(Write(7, 300)) == "write parameter 7 = 300"
    assert (Read(7).writes, Read(7).idempotent) == (False, True)
    assert (Write(7, 1).writes, Write(7, 1).idempotent) == (True, False)
    assert Read(7) == Read(7, maximum=9) == Read(7, minimum=0)
    assert Write(7, 1) == Write(7, 1, maximum=9) == Write(7, 1, minimum=0)


def test_a_write_waits_for_the_eeprom_and_the_line_has_one_drive() -> None:
    assert Write(1, 1).open(0, PROFILE.timings).timing.window == 0.5
    assert Read(1).open(0, PROFILE.timings).timing.window == 0.1
    assert (PROFILE.line.baudrate, PROFILE.line.framing) == (19200, "8N1")
    assert (list(PROFILE.addresses), PROFILE.label(0)) == ([0], "the drive")
