"""Ends of a line that are not set alike: what a UART makes of it, in one piece and on a pseudo-terminal."""

from __future__ import annotations

import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from busmaster.contract.profile import LineSettings
from busmaster.emulator.line import Echo, Line
from busmaster.emulator.misheard import misheard
from busmaster.emulator.serve import serve_pty
from busmaster.protocols._comms.mint import EmulatedMint
from tests.emulator.lines import SETTINGS, arrivals, line_of
from tests.patience import PATIENCE

READ_1 = bytes.fromhex("07 30 31 02 30 31 05 07")
REPLY = bytes.fromhex("02 30 31 30 03 32")

framings = st.builds(
    LineSettings,
    st.sampled_from([1200, 9600, 57600, 115200]),
    st.sampled_from([7, 8]),
    st.sampled_from("NEOMS"),
    st.sampled_from([1, 1.5, 2]),
)


def heard(data: str, sent: LineSettings, by: LineSettings) -> list[tuple[str, bool]]:
    return [(f"{byte:02X}", whole) for byte, whole in misheard(bytes.fromhex(data), sent, by)]


@given(st.binary(max_size=40), framings)
def test_who_is_set_alike_hears_every_byte(data: bytes, settings: LineSettings) -> None:
    data = bytes(byte & (1 << settings.bytesize) - 1 for byte in data)
    assert list(misheard(data, settings, settings)) == [(byte, True) for byte in data]


@given(st.binary(max_size=20), framings, framings)
def test_whatever_is_said_ends_and_fits_into_bytes(data: bytes, sent: LineSettings, by: LineSettings) -> None:
    data = bytes(byte & (1 << sent.bytesize) - 1 for byte in data)
    found = list(misheard(data, sent, by))
    assert all(0 <= byte < 1 << by.bytesize for byte, _ in found)
    assert len(found) <= len(data) * sent.byte_time / (by.byte_time - 1 / by.baudrate) + 1


def test_seven_bits_with_even_parity_are_heard_with_the_parity_as_bit_7() -> None:
    assert heard("04 31 37 05", LineSettings(9600, 7, "E"), LineSettings(9600)) == [
        ("84", True),
        ("B1", True),
        ("B7", True),
        ("05", True),
    ]


@pytest.mark.parametrize(("parity", "bytes_"), [("E", "B1 33"), ("O", "31 B3"), ("M", "B1 B3"), ("S", "31 33")])
def test_the_parity_of_seven_bits_is_the_eighth_of_a_host_without_parity(parity: str, bytes_: str) -> None:
    found = heard("31 33", LineSettings(9600, 7, parity), LineSettings(9600))
    assert found == [(byte, True) for byte in bytes_.split()]


def test_a_wrong_parity_is_told_and_the_byte_too() -> None:
    assert heard("31 33", LineSettings(9600, 8, "O"), LineSettings(9600, 8, "E")) == [("31", False), ("33", False)]


def test_a_slow_byte_is_many_to_a_fast_receiver_and_its_low_ends_are_no_whole_bytes() -> None:
    # 00 is nine bits low: 54 of the receiver's, of which it takes one byte without a stop bit
    assert heard("00", LineSettings(9600), LineSettings(57600)) == [("00", False)]
    # six bits of the receiver's to one of the sender's: the start bit, and two bits high, are 11100000 from the top
    assert heard("FF", LineSettings(9600), LineSettings(57600)) == [("E0", True)]


def test_fast_bytes_run_together_for_a_slow_receiver() -> None:
    assert len(heard("07 30 31 02 30 31 05 07", LineSettings(57600), LineSettings(9600))) == 2


@pytest.mark.parametrize("host", [LineSettings(9600), LineSettings(115200), LineSettings(57600, 8, "E")])
def test_a_host_that_is_set_otherwise_gets_no_answer_until_it_is_set_alike(host: LineSettings) -> None:
    line = line_of(EmulatedMint(1))
    line.host = host
    line.send(READ_1, 0.0)
    assert arrivals(line, 1.0) == []
    line.host = None
    line.send(READ_1, 1.0)
    assert "".join(data for _, data in arrivals(line, 2.0)).replace(" ", "") == REPLY.hex().upper()


def test_what_a_host_that_is_set_otherwise_hears_is_not_what_was_said() -> None:
    line = line_of(EmulatedMint(1))
    line.send(READ_1, 0.0)
    line.host = LineSettings(SETTINGS.baudrate // 2)
    [(_, data)] = arrivals(line, 1.0)
    assert bytes.fromhex(data) == bytes(byte for byte, _ in misheard(REPLY, SETTINGS, line.host))
    assert bytes.fromhex(data) != REPLY


def test_the_echo_of_a_host_that_is_set_otherwise_is_what_it_said() -> None:
    line = line_of(EmulatedMint(1), echo=Echo())
    line.host = LineSettings(9600)
    line.send(READ_1, 0.0)
    assert arrivals(line, 1.0) == [(8 * LineSettings(9600).byte_time, READ_1.hex(" ").upper())]


def test_a_late_echo_of_a_host_that_is_set_otherwise_takes_as_long_as_it_said_it() -> None:
    for paced, sent in ((True, 8 * LineSettings(9600).byte_time), (False, 0.0)):
        line = line_of(EmulatedMint(1), echo=Echo(0.01), paced=paced)
        line.host = LineSettings(9600)
        line.send(READ_1, 1.0)
        [(when, data)] = arrivals(line, 2.0)
        assert when == pytest.approx(1.0 + sent + 0.01)
        assert data == READ_1.hex(" ").upper()


@pytest.mark.parametrize("baudrate", [57600, 123_456])
def test_a_pty_answers_at_the_lines_own_rate_and_at_no_other(baudrate: int) -> None:
    with serve_pty(Line(LineSettings(baudrate), [EmulatedMint(1)])) as server:
        for rate in (9600, baudrate, 115200, baudrate):
            with serial.Serial(server.path, rate, timeout=PATIENCE if rate == baudrate else 0.05) as port:
                port.write(READ_1)
                assert port.read(len(REPLY)) == (REPLY if rate == baudrate else b"")


def test_a_pty_shows_odd_parity() -> None:
    with serve_pty(Line(LineSettings(9600, 8, "O"), [EmulatedMint(1)])) as server:
        for parity in "NO":
            with serial.Serial(server.path, 9600, parity=parity, timeout=PATIENCE if parity == "O" else 0.05) as port:
                port.write(READ_1)
                assert port.read(len(REPLY)) == (REPLY if parity == "O" else b"")


def test_a_host_that_sets_nothing_is_heard() -> None:
    with (
        serve_pty(Line(LineSettings(19200), [EmulatedMint(1)])) as server,
        open(server.path, "r+b", buffering=0) as port,
    ):
        port.write(READ_1)
        data = b""
        while len(data) < len(REPLY):
            data += port.read(16)
        assert data == REPLY
