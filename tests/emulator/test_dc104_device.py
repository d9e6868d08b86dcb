"""A DC104-SER drive, as "Serial Host Interface" describes it."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from busmaster.emulator.device import Delay
from busmaster.emulator.traceable import TraceableMemory, traceable_value
from busmaster.errors import InvalidCommand
from busmaster.protocols.dc104.device import EmulatedDc104, packet
from busmaster.wire.checks import sum8
from tests.emulator.lines import ask, ask_bytewise, hexed, line_of

ACK, NAK, SILENCE = "06", "15", ""


def read(parameter: int) -> str:
    return hexed(bytes((0x02, 0xAA, parameter, (0xAA + parameter) & 0xFF)))


def write(parameter: int, value: int) -> str:
    between = bytes((0x55, parameter)) + value.to_bytes(2, "big")
    return hexed(b"\x02" + between + bytes((sum8(between),)))


@pytest.mark.parametrize(
    ("value", "text", "heard"),
    [
        (1234, "02 AA 01 AB", "02 01 04 D2 D7"),
        (65535, "02 AA 02 AC", "02 02 FF FF 00"),
        (0, "02 AA 06 B0", "02 06 00 00 06"),  # a checksum that looks like ACK
        (0, "02 AA 5C 06", "02 5C 00 00 5C"),
        (0, "02 AA 6B 15", "02 6B 00 00 6B"),
        (0, "02 AA 15 BF", "02 15 00 00 15"),
        (0, "02 AA 02 AC", "02 02 00 00 02"),
        (65535, "02 AA FF A9", "02 FF FF FF FD"),
        (21762, "02 AA AA 54", "02 AA 55 02 01"),  # 170: the reply begins like a read
        (0, "02 AA 01 AC", NAK),  # a wrong checksum
        (0, "02 AA 00 AA", NAK),  # parameter 0
        (0, "02 55 01 04 D2 2C", ACK),
        (0, "02 55 02 FF FF 55", ACK),
        (0, "02 55 AA 55 02 56", ACK),
        (0, "02 55 01 04 D2 2D", NAK),
        (0, "02 55 00 00 00 55", NAK),
        (7, "02 02 AA 01 AB", "02 01 00 07 08"),  # the second byte fixes the length: else look for the next STX
        (7, "02 06 15 AA 02 AA 01 AB", "02 01 00 07 08"),
        (7, "02 AA", SILENCE),
        (7, "02 55 01 04 D2", SILENCE),
    ],
)
def test_it_answers_as_the_document_says(value: int, text: str, heard: str) -> None:
    for asking in (ask, ask_bytewise):
        drive = EmulatedDc104()
        drive.registers = [value] * 256
        assert asking(line_of(drive), text) == heard


def test_every_parameter_keeps_what_was_written() -> None:
    line = line_of(EmulatedDc104())
    for parameter in range(1, 256):
        value = parameter * 257 % 65536
        assert ask(line, write(parameter, value), parameter * 2.0) == ACK
        assert ask(line, read(parameter), parameter * 2.0 + 1) == hexed(packet(parameter, value))


def test_a_write_is_acknowledged_when_it_is_completed() -> None:
    line = line_of(EmulatedDc104(eeprom=Delay(0.3)))
    assert ask(line, write(1, 5), 0.0, 0.3) == SILENCE
    assert ask(line, "", 0.3, 0.1) == ACK
    assert ask(line, read(1), 0.5, 0.05) == "02 01 00 05 06"


def test_what_it_has_not_is_refused_or_by_option_met_with_silence() -> None:
    drive = EmulatedDc104(maximum=10, read_only=frozenset({3}))
    line = line_of(drive)
    drive.registers[3] = 33
    assert ask(line, read(11), 0.0) == NAK
    assert ask(line, write(11, 1), 1.0) == NAK
    assert ask(line, write(3, 1), 2.0) == NAK
    assert ask(line, read(3), 3.0) == hexed(packet(3, 33))
    drive.silent = True
    assert ask(line, read(11), 4.0) == SILENCE
    assert ask(line, "02 AA 01 AC", 5.0) == SILENCE
    assert ask(line, write(11, 1), 6.0) == NAK


def test_parameter_0_is_there_by_option() -> None:
    line = line_of(EmulatedDc104(allow_zero=True))
    assert ask(line, write(0, 9), 0.0) == ACK
    assert ask(line, read(0), 1.0) == "02 00 00 09 09"


def test_what_was_begun_is_forgotten_after_50_ms() -> None:
    for pause, heard in ((0.04, NAK), (0.06, "02 01 00 00 01")):
        line = line_of(EmulatedDc104())
        assert ask(line, "02 AA 01", 0.0, pause) == SILENCE
        assert ask(line, read(1), pause)[: len(heard)] == heard


def test_parameters_outlive_a_power_failure_and_half_a_packet_does_not() -> None:
    drive = EmulatedDc104()
    line = line_of(drive)
    ask(line, write(1, 1234), 0.0)
    ask(line, "02 AA", 1.0)
    line.restart(drive, 1.51)
    assert ask(line, read(1), 1.52) == "02 01 04 D2 D7"


def test_half_a_packet_is_lost_in_a_restart_however_short() -> None:
    drive = EmulatedDc104()
    line = line_of(drive)
    ask(line, "02 AA", 0.0, 0.01)
    line.restart(drive, 0.02)
    assert ask(line, read(1), 0.03) == "02 01 00 00 01"


def test_the_oracle_answers_and_counts_writes() -> None:
    traceable = TraceableMemory(0, 2**16)
    line = line_of(EmulatedDc104(traceable=traceable))
    assert ask(line, write(7, traceable_value(0, 7, 0, 2**16)), 0.0) == ACK
    assert (traceable.writes[7], traceable.foreign_writes) == (1, 0)
    assert ask(line, read(7), 1.0) == hexed(packet(7, traceable_value(0, 7, 1, 2**16)))


def test_what_no_dc104_is_cannot_be_made() -> None:
    for bad in (0, 256):
        with pytest.raises(InvalidCommand):
            EmulatedDc104(maximum=bad)
    with pytest.raises(InvalidCommand, match=r"2\*\*16 traceable values"):
        EmulatedDc104(traceable=TraceableMemory(0))


def test_initial_values_are_those_of_parameters_in_a_row() -> None:
    drive = EmulatedDc104()
    drive.preset("254", 5, 65535)
    assert drive.registers[253:] == [0, 5, 65535]


@pytest.mark.parametrize(
    ("item", "values", "reason"),
    [
        ("0", (1,), "cannot store the values at '0': its last parameter is 10"),
        ("11", (1,), "its last parameter is 10"),
        ("10", (1, 2), "its last parameter is 10"),
        ("x", (1,), "cannot store the values at 'x'"),
        ("5", (0, 65536), "parameter 6 holds a whole number, 0 to 65535, not 65536"),
        ("5", (-1,), "parameter 5 holds"),
    ],
)
def test_an_initial_value_that_a_drive_cannot_hold_is_refused(
    item: str, values: tuple[float, ...], reason: str
) -> None:
    with pytest.raises(InvalidCommand, match=reason):
        EmulatedDc104(maximum=10).preset(item, *values)


@pytest.mark.parametrize(("item", "values", "moves"), [("1", (5,), False), ("0", (4, 5), False), ("2", (5,), True)])
def test_a_parameter_that_is_given_stands_and_others_go_on_moving(
    item: str, values: tuple[float, ...], moves: bool
) -> None:
    drive = EmulatedDc104(lively=True, allow_zero=True)
    drive.preset(item, *values)
    seen = {ask(line_of(drive), read(1), now) for now in (0.5, 1.0, 2.0)}
    assert len(seen) == (3 if moves else 1)


@given(st.binary(max_size=20), st.booleans())
@settings(max_examples=60)
def test_whatever_it_hears_it_answers_after_a_pause(data: bytes, bytewise: bool) -> None:
    line = line_of(EmulatedDc104(read_only=frozenset(range(256))))
    (ask_bytewise if bytewise else ask)(line, data.hex())
    assert ask(line, read(1), 10.0) == "02 01 00 00 01"


def test_a_disguised_reply_names_another_parameter_with_a_right_checksum() -> None:
    drive = EmulatedDc104()
    drive.registers[1] = 1234
    drive.faults.wrong = 1.0
    heard = bytes.fromhex(ask(line_of(drive), read(1)))
    assert heard[1] != 1
    assert heard == packet(heard[1], 1234)
    assert ask(line_of(drive), write(1, 5)) == ACK
