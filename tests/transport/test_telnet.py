"""The telnet codec of RFC 2217: data and commands, split anywhere, and streams that break the rules."""

from __future__ import annotations

import random

import pytest

from busmaster.contract.profile import LineSettings
from busmaster.transport.telnet import (
    LONGEST_SUBNEGOTIATION,
    Negotiation,
    Piece,
    Set,
    Subnegotiation,
    TelnetError,
    TelnetReader,
    escaped,
    subnegotiation,
    value_text,
    values_of,
)

SAID = bytes.fromhex(
    "61 ff ff 62 0d 00"  # data with a byte 255, and a CR that stays as it is
    "ff fd 2c"  # DO COM-PORT-OPTION
    "ff f1"  # NOP
    "ff fa 2c 65 00 00 ff ff 00 ff f0"  # a baud rate with a byte 255
    "ff fa 18 01 ff f0"  # a subnegotiation of another option
    "ff ff ff fb 00"  # a byte 255, then WILL BINARY
    "f0 fa"  # SE and SB as data
)
HEARD: list[Piece] = [
    b"a\xffb\r\0",
    Negotiation(253, 44),
    Subnegotiation(101, bytes.fromhex("0000ff00")),
    b"\xff",
    Negotiation(251, 0),
    b"\xf0\xfa",
]


def joined(pieces: list[Piece]) -> list[Piece]:
    """Data that follows data is one piece: how it was cut does not matter."""
    whole: list[Piece] = []
    for piece in pieces:
        if whole and isinstance(piece, bytes) and isinstance(before := whole[-1], bytes):
            whole[-1] = before + piece
        else:
            whole.append(piece)
    return whole


def test_data_and_commands_are_separated_wherever_the_stream_is_split() -> None:
    for first in range(len(SAID) + 1):
        for second in range(first, len(SAID) + 1):
            reader = TelnetReader()
            chunks = (SAID[:first], SAID[first:second], SAID[second:])
            assert joined([piece for chunk in chunks for piece in reader.take(chunk)]) == HEARD


def test_data_with_every_byte_survives_both_directions_byte_by_byte() -> None:
    data = bytes(range(256)) * 2 + b"\xff\xff\xff"
    reader = TelnetReader()
    pieces = [piece for byte in escaped(data) for piece in reader.take(bytes((byte,)))]
    assert joined(pieces) == [data]


def test_random_streams_mean_the_same_however_they_are_split() -> None:
    chance = random.Random(1)
    for _ in range(300):
        parts = [bytes((255, 250, 44)), bytes((255, 240)), b"\xff\xff", b"\xff", b"\x2c", b"a", bytes((251,)), b"\xf0"]
        stream = b"".join(chance.choices(parts, k=40))
        assert read(stream, [stream]) == read(stream, [bytes((byte,)) for byte in stream])


def read(stream: bytes, chunks: list[bytes]) -> list[Piece] | str:
    """What a reader makes of the stream, or that it breaks the rules."""
    reader = TelnetReader()
    try:
        return joined([piece for chunk in chunks for piece in reader.take(chunk)])
    except TelnetError:
        return "error"


@pytest.mark.parametrize("filling", [b"a", b"\xff\xff"])
@pytest.mark.parametrize("size", [1, 7, 100_000])
def test_a_subnegotiation_that_does_not_end_is_bounded(filling: bytes, size: int) -> None:
    reader = TelnetReader()
    taken = 0
    for chunk in (b"\xff\xfa\x2c", *[filling * size] * (100_000 // size)):
        if taken + len(chunk) > LONGEST_SUBNEGOTIATION:
            with pytest.raises(TelnetError, match="longer than 256 bytes"):
                reader.take(chunk)
            return
        reader.take(chunk)
        taken += len(chunk)
    raise AssertionError("it was taken")


def test_a_long_subnegotiation_that_ends_is_rejected_too() -> None:
    longest = subnegotiation(100, b"s" * (LONGEST_SUBNEGOTIATION - 6))
    assert TelnetReader().take(longest) == [Subnegotiation(100, b"s" * (LONGEST_SUBNEGOTIATION - 6))]
    with pytest.raises(TelnetError):
        TelnetReader().take(subnegotiation(100, b"s" * (LONGEST_SUBNEGOTIATION - 5)))


def test_a_subnegotiation_that_another_command_breaks_off_is_an_error() -> None:
    with pytest.raises(TelnetError, match="broken off"):
        TelnetReader().take(bytes.fromhex("ff fa 2c 65 ff fb 00"))


def test_settings_are_written_as_rfc_2217_has_them() -> None:
    assert values_of(LineSettings(57600, 7, "E", 2)) == {
        Set.BAUDRATE: bytes.fromhex("00 00 e1 00"),
        Set.DATASIZE: b"\x07",
        Set.PARITY: b"\x03",
        Set.STOPSIZE: b"\x02",
    }
    assert values_of(LineSettings(9600, 8, "M", 1.5))[Set.STOPSIZE] == b"\x03"
    assert [values_of(LineSettings(9600, 8, parity))[Set.PARITY][0] for parity in "NOEMS"] == [1, 2, 3, 4, 5]
    assert subnegotiation(1, bytes.fromhex("00 00 ff 00")).hex(" ") == "ff fa 2c 01 00 00 ff ff 00 ff f0"


def test_values_are_shown_as_text() -> None:
    assert value_text(Set.BAUDRATE, bytes.fromhex("00002580")) == "9600 baud"
    assert value_text(Set.PARITY, b"\x03") == "parity E"
    assert value_text(Set.STOPSIZE, b"\x03") == "stop bits 1.5"
    assert value_text(Set.PARITY, b"\x09") == "parity 9"


def test_any_amount_of_data_may_follow_a_subnegotiation() -> None:
    data = b"a" * 10 * LONGEST_SUBNEGOTIATION
    assert TelnetReader().take(subnegotiation(101, b"\0") + data) == [Subnegotiation(101, b"\0"), data]
