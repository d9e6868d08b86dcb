"""The sixth protocol: it keeps the contract that the five keep, and its device is not fooled by its own exchange.

The frames are those of the Modbus application protocol, V1.1b3, sections 6.3, 6.6 and 6.12, as RTU.
"""

from __future__ import annotations

import struct
from itertools import combinations

import pytest

from busmaster import InvalidCommand, Refused
from busmaster.testing import Case, Foreign, RoundTrip, answers_of, check_protocol
from busmaster.testing.virtual_time import run_in_virtual_time
from examples import modbus_rtu
from examples.modbus_rtu import PROFILE, EmulatedUnit, ReadRegisters, WriteRegisters, with_crc

UNIT = 0x11
ECHO = bytes.fromhex("11 06 00 01 00 03 9a 9b")

CASES = [
    Case(ReadRegisters(0x6B, 3), UNIT, [with_crc(bytes.fromhex("11 03 06 022b 0000 0064"))], (555, 0, 100)),
    Case(ReadRegisters(7), UNIT, [bytes.fromhex("11 03 02 02 2b 38 f8")], (555,)),
    Case(ReadRegisters(7), UNIT, [with_crc(bytes.fromhex("11 83 02"))], raises=Refused),
    Case(
        WriteRegisters(1, (3,)),
        UNIT,
        [bytes.fromhex("11 06 00 01 00 03 9a 9b")],
        request=bytes.fromhex("110600010003 9a9b"),
    ),
    Case(WriteRegisters(1, (3,)), UNIT, [with_crc(bytes.fromhex("11 86 03"))], raises=Refused),
    Case(WriteRegisters(1, (10, 258)), UNIT, [with_crc(bytes.fromhex("11 10 0001 0002"))]),
    Case(WriteRegisters(1, (3,)), 0, []),
]


def what_a_reply_names(command: object, address: int) -> object:
    """A reply to a read names unit and size, not the registers."""
    return (address, command.count) if isinstance(command, ReadRegisters) else (address, command)


def test_modbus_keeps_the_contract() -> None:
    tally = check_protocol(
        PROFILE,
        CASES,
        names=what_a_reply_names,
        foreign=[Foreign(ReadRegisters(7), UNIT, with_crc(bytes.fromhex("12 03 02 02 2b")), "another unit's reply")],
        invalid=[
            lambda: ReadRegisters(65536),
            lambda: ReadRegisters(0, 126),
            lambda: ReadRegisters(65535, 2),
            lambda: WriteRegisters(0, ()),
            lambda: WriteRegisters(0, (65536,)),
            lambda: WriteRegisters(0, (1,) * 124),
        ],
        round_trips=[
            RoundTrip(UNIT, lambda value: WriteRegisters(7, (value,)), ReadRegisters(7), [0, 1, 65535], lambda v: (v,)),
            RoundTrip(UNIT, lambda values: WriteRegisters(7, values), ReadRegisters(7, 2), [(1, 2), (65535, 0)]),
        ],
        device=answers_of(EmulatedUnit(UNIT)),
    )
    assert min(tally.values()) > 0


def test_a_read_is_never_sent_to_all() -> None:
    with pytest.raises(InvalidCommand, match="nobody answers"):
        ReadRegisters(0).open(0, PROFILE.timings)


def heard_by(unit: EmulatedUnit, *chunks: tuple[float, bytes]) -> list[bytes]:
    for start, chunk in chunks:
        unit.hear(chunk, start)
    return [said for _, said in unit.outbox]


REQUEST = with_crc(bytes.fromhex("11 03 0007 0001"))


@pytest.mark.parametrize("cut", range(1, len(REQUEST)))
def test_a_request_in_two_pieces_is_one_and_a_cut_one_is_forgotten_after_a_silence(cut: int) -> None:
    whole = heard_by(EmulatedUnit(UNIT), (0.0, REQUEST[:cut]), (0.0005, REQUEST[cut:]))
    assert whole == heard_by(EmulatedUnit(UNIT), (0.0, REQUEST)) != []
    assert heard_by(EmulatedUnit(UNIT), (0.0, REQUEST[:cut]), (0.1, REQUEST)) == whole


def test_a_unit_lets_pass_what_is_for_others_even_where_its_own_address_stands_in_it() -> None:
    reply_of_another = with_crc(b"\x12\x03\x08" + REQUEST)
    assert heard_by(EmulatedUnit(UNIT), (1.0, reply_of_another)) == []
    assert len(heard_by(EmulatedUnit(UNIT), (1.0, reply_of_another), (1.01, REQUEST))) == 1


@pytest.mark.parametrize("bits", list(combinations(range(8), 2)))
def test_damaged_requests_are_not_answered(bits: tuple[int, int]) -> None:
    damaged = bytearray(REQUEST)
    for bit in bits:
        damaged[3] ^= 1 << bit
    assert heard_by(EmulatedUnit(UNIT), (0.0, bytes(damaged))) == []


def test_what_goes_to_all_is_done_and_not_answered() -> None:
    unit = EmulatedUnit(UNIT)
    assert heard_by(unit, (0.0, WriteRegisters(2, (7, 8)).open(0, PROFILE.timings).request)) == []
    assert unit.registers[2:4] == [7, 8]


def test_taken_whole_or_heard_byte_by_byte_a_request_gets_the_same_answer() -> None:
    requests = [REQUEST, with_crc(bytes.fromhex("11 04 0000 0001")), with_crc(struct.pack(">BBHH", UNIT, 3, 90, 11))]
    for request in requests:
        taking, hearing = EmulatedUnit(UNIT), EmulatedUnit(UNIT)
        assert taking.take(request, 1.0)
        hearing.hear(request, 1.0)
        assert taking.outbox == hearing.outbox != []


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    run_in_virtual_time(modbus_rtu.main())
    said = capsys.readouterr().out
    assert "press: (7, 8, 9)" in said
    assert "oven: (215, 220)" in said
    assert "illegal data address" in said
