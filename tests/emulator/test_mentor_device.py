"""A Mentor II drive, as its user guide and docs/protocols/mentor.md describe it."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from busmaster.emulator.line import Line
from busmaster.emulator.traceable import TraceableMemory, traceable_value
from busmaster.errors import InvalidCommand
from busmaster.protocols.mentor.device import EVEN_PARITY, SPEED_REFERENCE, EmulatedMentor, make_device, telegram
from busmaster.wire.checks import bcc
from tests.emulator.lines import ask, ask_bytewise, hexed, line_of

ACK, NAK, BS, EOT, SILENCE = "06", "15", "08", "04", ""
BACKWARDS = "02 30 31 31 37 2D 30 34 37 36 03 2C"  # 01.17 = -0476
NEXT = "02 30 31 31 38 2B 30 30 30 30 03 20"  # 01.18 = +0000


def address(drive: int) -> bytes:
    return b"\x04" + f"{drive:02d}"[0].encode() * 2 + f"{drive:02d}"[1].encode() * 2


def read(drive: int, parameter: str) -> str:
    return hexed(address(drive) + parameter.encode() + b"\x05")


def write(drive: int, text: str) -> str:
    """`text`: parameter and data, "0117-0476"."""
    body = text.encode() + b"\x03"
    return hexed(address(drive) + b"\x02" + body + bytes([bcc(body)]))


def backwards(drive: int, *, short_after_write: bool = False) -> tuple[EmulatedMentor, Line]:
    """A drive whose speed reference is -47.6 %."""
    device = EmulatedMentor(drive, short_after_write=short_after_write)
    device.set_value(SPEED_REFERENCE, -476, 0.0)
    return device, line_of(device)


# The frames of the guide, and those that follow from its rules


@pytest.mark.parametrize("bytewise", [False, True])
@pytest.mark.parametrize(
    ("drive", "text", "heard"),
    [
        (14, "04 31 31 34 34 02 30 31 31 37 2D 30 34 37 36 03 2C", ACK),  # 47.6 % in reverse; BCC ","
        (12, "04 31 31 32 32 30 31 31 37 05", BACKWARDS),
        (14, "04 31 31 34 34 02 30 31 31 37 2B 30 34 37 36 35 03 3F", ACK),  # 47.65 %
        (23, "04 32 32 33 33 02 30 34 32 36 31 03 32", ACK),  # a bit as "1"
        (23, "04 32 32 33 33 02 30 34 32 36 30 31 03 22", ACK),  # and as "01"
        (5, "04 30 30 35 35 02 31 35 36 30 35 34 33 32 31 03 30", ACK),  # the wide integer 15.60 = 54321
        (12, "04 31 31 32 32 31 37 32 33 05", EOT),  # 17.23: no such parameter
        (12, "04 31 31 32 32 02 30 31 31 37 2D 30 34 37 36 03 2D", NAK),  # a bad BCC
        (12, "04 31 31 33 33 02 30 31 31 37 2D 30 34 37 36 03 2C", SILENCE),  # for drive 13
        (12, "04 31 32 32 32 02 30 31 31 37 2D 30 34 37 36 03 2C", SILENCE),  # digits that are not doubled
        (12, "04 31 31 32 32 02 30 31 31 37 2D 34 37 36 03 3C", ACK),  # short data, as another host sends it
        (12, "00 FF 04 31 31 04 31 31 32 32 30 31 31 37 05 00", BACKWARDS),  # EOT begins anew; idle bytes
    ],
)
def test_it_answers_as_the_guide_says(drive: int, text: str, heard: str, bytewise: bool) -> None:
    _, line = backwards(drive)
    assert (ask_bytewise if bytewise else ask)(line, text) == heard


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0117-0476", -476),
        ("0117+04765", 476),  # tenths of the last digit are kept, and not shown
        ("0117476", 476),
        ("0117+476", 476),
        ("011700476", 476),  # five digits without a sign
        ("0117-1000", -1000),
        ("04261", 1),
        ("0426+0000", 0),
        ("156065535", 65535),
        ("156300000", 0),
        ("1314+1234", 1234),
    ],
)
def test_what_is_written_is_read_back(text: str, value: int) -> None:
    drive = EmulatedMentor(14)
    line = line_of(drive)
    assert ask(line, write(14, text)) == ACK
    parameter = int(text[:4])
    assert drive.value(parameter, 1.0) == value
    assert ask(line, read(14, text[:4]), 1.0) == hexed(telegram(parameter, value, parameter > 1300))


@pytest.mark.parametrize(
    "text",
    [
        "0117+1001",  # out of limits
        "0117-10001",  # the same, in high resolution
        "0117+47.6",  # a decimal point
        "0117",  # no data
        "0117-",
        "0117+047655",  # too long
        "0117004765",  # six digits without a sign
        "0117" + "1" * 60,
        "0117 0476",
        "0302+0001",  # read-only
        "1111+0013",
        "04262",
        "0426+00001",  # a bit in high resolution
        "1560-0001",
        "1560+54321",  # a wide integer has no sign, and no high resolution
        "156065536",
        "17231",  # it does not exist
        "01X7+0000",
    ],
)
def test_it_says_nak_to_what_it_cannot_take(text: str) -> None:
    for asking in (ask, ask_bytewise):
        drive, line = backwards(14)
        assert asking(line, write(14, text)) == NAK
        assert drive.value(SPEED_REFERENCE, 1.0) == -476


@pytest.mark.parametrize(
    "text",
    [
        "04 31 31 32 32 30 31 31 58 05",  # a letter in the parameter
        "04 31 31 32 32 30 31 31 37 06",  # not ended by ENQ
        "04 31 31 32 32 30 31 31 37 35 05",
        "04 31 31 32 32 30 31 05",
    ],
)
def test_a_malformed_read_request_gets_silence_or_by_option_nak(text: str) -> None:
    for asking in (ask, ask_bytewise):
        assert asking(line_of(EmulatedMentor(12)), text) == SILENCE
        assert asking(line_of(EmulatedMentor(12, refuse_malformed=True)), text) == NAK
        assert asking(line_of(EmulatedMentor(13, refuse_malformed=True)), text) == SILENCE


@pytest.mark.parametrize(
    "text",
    [
        "04 31 31 32 32 02 30 31 07",
        "04 31 31 32 32 02 30 31 03 20",
        "04 31 31 32 32 02 30 31 31 37 31 01 03 20",
        "04 02",
    ],
)
def test_a_control_character_inside_a_frame_ends_it_unanswered(text: str) -> None:
    for asking in (ask, ask_bytewise):
        assert asking(line_of(EmulatedMentor(12, refuse_malformed=True)), text) == SILENCE


# All drives at once


def test_a_broadcast_is_taken_by_all_and_answered_by_none() -> None:
    for asking in (ask, ask_bytewise):
        drives = [EmulatedMentor(number) for number in (1, 14, 99)]
        line = line_of(*drives)
        assert asking(line, "04 30 30 30 30 02 30 31 31 37 2B 30 30 30 30 03 2F") == SILENCE
        assert asking(line, write(0, "0117+0250"), 1.0) == SILENCE
        assert [drive.value(SPEED_REFERENCE, 2.0) for drive in drives] == [250] * 3
        assert asking(line, write(0, "0117+9999"), 2.0) == SILENCE
        assert asking(line, read(0, "0117"), 3.0) == SILENCE


# Short commands


def test_next_previous_and_same_again_after_a_read() -> None:
    """A transcript with an independent node of the same protocol, in Mentor II's five characters."""
    _, line = backwards(12)
    asked = ["04 31 31 32 32 30 31 31 37 05", ACK, BS, NAK, "04 31 31 32 32 31 37 32 33 05", NAK]
    heard = [ask(line, text, number) for number, text in enumerate(asked)]
    assert heard == [BACKWARDS, NEXT, BACKWARDS, BACKWARDS, EOT, EOT]


def test_a_run_goes_through_a_gap_and_back() -> None:
    line = line_of(EmulatedMentor(12))
    heard = [ask(line, text, number) for number, text in enumerate([read(12, "0135"), ACK, ACK, ACK, BS, BS])]
    last = hexed(telegram(136, 0))
    assert heard == [hexed(telegram(135, 0)), last, EOT, EOT, EOT, last]


@pytest.mark.parametrize(
    "between",
    [
        "04 31 31 33 33 30 31 31 37 05",  # a read of another drive
        "04 31 31 33 33 02 30 31 31 37 2D 30 34 37 36 03 2C",
        "04 30 30 30 30 02 30 31 31 37 2B 30 30 30 30 03 2F",  # to all
        "04",  # EOT alone
        "41",  # another character
        "02",  # a re-write is no Mentor II command
        "04 31 31 32 32 30 31 31 37 06",  # a read not ended by ENQ
        "04 31 31 32 32 02 30 31 31 37 2D 30 34 37 36 03 2C",  # a write to the drive itself
    ],
)
def test_what_ends_short_commands(between: str) -> None:
    for asking in (ask, ask_bytewise):
        line = line_of(EmulatedMentor(12))
        asking(line, read(12, "0117"))
        asking(line, between, 1.0)
        assert asking(line, ACK, 2.0) == SILENCE


@pytest.mark.parametrize("between", ["00", "FF 00 7F"])
def test_idle_bytes_do_not_end_them(between: str) -> None:
    line = line_of(EmulatedMentor(12))
    ask(line, read(12, "0117"))
    ask(line, between, 1.0)
    assert ask(line, ACK, 2.0) == NEXT


def test_short_commands_after_a_write_are_an_option() -> None:
    _, line = backwards(12, short_after_write=True)
    assert ask(line, write(12, "0117-0476")) == ACK
    assert ask(line, NAK, 1.0) == BACKWARDS
    assert ask(line, write(12, "0117+9999"), 2.0) == NAK
    assert ask(line, NAK, 3.0) == SILENCE


def test_another_drives_acknowledgement_is_not_taken_for_a_short_command() -> None:
    line = line_of(*(EmulatedMentor(number) for number in range(11, 16)))
    for now, drive in enumerate([12, 13, 14, 12, 15]):
        assert ask(line, read(12, "0117"), now) == hexed(telegram(117, 0))
        assert ask(line, write(drive, "0118+0001"), now + 0.5) == ACK
    assert line.collisions == 0


# Seven bits


def test_the_parity_bit_is_dropped_and_given_where_it_was_heard() -> None:
    """On a link of 8 bits without parity the host may set even parity in bit 7 itself."""
    for asking in (ask, ask_bytewise):
        _, line = backwards(12)
        with_parity = hexed(bytes.fromhex(read(12, "0117")).translate(EVEN_PARITY))
        assert with_parity.startswith("84 B1 B1")
        assert asking(line, with_parity) == hexed(bytes.fromhex(BACKWARDS).translate(EVEN_PARITY))
        assert asking(line, "95", 1.0) == hexed(bytes.fromhex(BACKWARDS).translate(EVEN_PARITY))
        assert asking(line, read(12, "0117"), 2.0) == BACKWARDS
        assert asking(line, with_parity, 2.5) == hexed(bytes.fromhex(BACKWARDS).translate(EVEN_PARITY))
        assert asking(line, hexed(bytes.fromhex(write(12, "0117-0476")).translate(EVEN_PARITY)), 3.0) == ACK


# The drive


def test_the_speed_follows_its_reference_on_a_ramp() -> None:
    drive = EmulatedMentor(14, acceleration=500.0)
    line = line_of(drive)
    assert ask(line, read(14, "0302"), 0.0) == "02 30 33 30 32 2B 30 30 30 30 03 29"
    assert ask(line, write(14, "0117+1000"), 10.0) == ACK
    assert drive.value(302, 11.0) == pytest.approx(500, abs=5)
    assert ask(line, read(14, "0302"), 13.0) == hexed(telegram(302, 1000))
    assert ask(line, write(14, "0117-0500"), 14.0) == ACK
    assert ask(line, read(14, "0302"), 20.0) == hexed(telegram(302, -500))
    drive.ripple = 0.1
    seen = {drive.value(302, 20.0 + number / 10) for number in range(20)}
    assert len(seen) > 5
    assert all(-550 <= speed <= -450 for speed in seen)


def test_it_knows_its_own_address_and_forgets_the_rest_when_power_fails() -> None:
    drive, line = backwards(14)
    assert ask(line, read(14, "1111"), 1.0) == hexed(telegram(1111, 14))
    line.restart(drive, 2.0)
    assert ask(line, ACK, 3.0) == SILENCE
    assert ask(line, read(14, "0117"), 4.0) == hexed(telegram(117, 0))
    assert drive.value(302, 10.0) == 0
    with pytest.raises(KeyError):
        drive.value(1723, 10.0)


def test_the_oracle_answers_for_every_parameter_and_counts_writes() -> None:
    traceable = TraceableMemory(14, 10**4)
    line = line_of(EmulatedMentor(14, traceable=traceable))
    sent = traceable_value(14, 117, 0, 10**4)
    assert ask(line, write(14, f"0117{sent:+05d}")) == ACK
    assert (traceable.writes[117], traceable.foreign_writes) == (1, 0)
    assert ask(line, read(14, "0117"), 1.0) == hexed(telegram(117, traceable_value(14, 117, 1, 10**4)))
    assert ask(line, read(14, "1563"), 2.0) == hexed(telegram(1563, traceable_value(14, 1563, 0, 10**4), True))


def test_what_no_mentor_ii_is_cannot_be_made() -> None:
    for bad in (0, 100):
        with pytest.raises(InvalidCommand):
            EmulatedMentor(bad)
    with pytest.raises(InvalidCommand, match=r"10\*\*4 traceable values"):
        EmulatedMentor(1, traceable=TraceableMemory(1))


@pytest.mark.parametrize("whole", [True, False])
def test_a_write_whose_checksum_arrives_as_enq_is_refused_and_no_read(whole: bool) -> None:
    """05 is also the byte that ends a read request."""
    line = line_of(EmulatedMentor(5))
    garbled = "04 30 30 35 35 02 30 31 31 37 2d 30 34 37 36 03 05"
    assert (ask if whole else ask_bytewise)(line, garbled) == NAK
    assert ask(line, read(5, "0117"), 1.0) == hexed(telegram(117, 0))


def test_the_feedback_stays_within_full_speed_whatever_the_ripple() -> None:
    for speed in (1000, -1000):
        drive = EmulatedMentor(14, ripple=0.5)
        drive.preset("3.02", speed)
        drive.preset("1.17", speed)
        seen = {drive.value(302, now / 10) for now in range(50)}
        assert len(seen) > 2
        assert max(map(abs, seen)) == 1000


def test_initial_values_are_those_of_parameters_in_a_row_and_missing_ones_are_added() -> None:
    drive = EmulatedMentor(14)
    drive.preset("1.17", -1000, 1000)
    drive.preset("3.02", 200)
    drive.preset("7.05", -9999, 9999)
    drive.preset("15.60:wide", 65535)
    values = {117: -1000, 118: 1000, 302: 200, 705: -9999, 706: 9999, 1560: 65535}
    assert {name: drive.value(name, 0.0) for name in values} == values
    assert drive.value(302, 0.2) == 100, "it follows the reference from there"


@pytest.mark.parametrize(
    ("item", "values", "reason"),
    [
        ("117", (1,), "has no '117': use a parameter such as 1.17"),
        ("1.17", (1001,), r"1\.17, without its decimals, holds a whole number, -1000 to 1000, not 1001"),
        ("1.17", (-1001,), "-1000 to 1000, not -1001"),
        ("1.17", (0, 0.5), "a whole number"),
        ("7.05", (10000,), "-9999 to 9999"),
        ("15.60", (-1,), "0 to 65535"),
        ("11.11", (5,), "is the drive's address: it cannot be given"),
        ("11.10", (0, 5), "is the drive's address: it cannot be given"),
    ],
)
def test_an_initial_value_that_a_drive_cannot_hold_is_refused(
    item: str, values: tuple[float, ...], reason: str
) -> None:
    with pytest.raises(InvalidCommand, match=reason):
        EmulatedMentor(14).preset(item, *values)


@pytest.mark.parametrize(
    ("settings", "writes"),
    [
        ({}, {"+9999": ACK, "-9999": ACK, "+00001": NAK}),
        ({"low": -5, "high": 5}, {"+0005": ACK, "-0005": ACK, "+0006": NAK, "-0006": NAK}),
        ({"wide": True}, {"65535": ACK, "65536": NAK, "-0001": NAK}),
        ({"wide": True, "low": 3}, {"00003": ACK, "00002": NAK}),
        ({"read_only": True}, {"+0001": NAK}),
        ({"fine": True}, {"+00001": ACK}),
    ],
)
@pytest.mark.parametrize("item", ["7.05", "4.26"])
def test_a_parameter_of_a_file_has_its_limits_also_if_the_drive_knows_it(
    item: str, settings: dict[str, Any], writes: dict[str, str]
) -> None:
    line = line_of(make_device(14, lively=False, parameters={item: settings}))
    menu, _, number = item.partition(".")
    for now, (data, answer) in enumerate(writes.items()):
        assert ask(line, write(14, f"{int(menu):02d}{int(number):02d}{data}"), now) == answer, data


@pytest.mark.parametrize(
    ("item", "settings"),
    [("7", {}), ("7.05", {"low": -10000}), ("7.05", {"low": 5, "high": 4}), ("7.05", {"wide": True, "low": -1})],
)
def test_a_parameter_that_cannot_be_is_refused(item: str, settings: dict[str, Any]) -> None:
    with pytest.raises(InvalidCommand):
        make_device(14, lively=False, parameters={item: settings})


def test_a_drive_has_the_same_acceleration_after_a_restart() -> None:
    drive = EmulatedMentor(14, acceleration=100.0)
    line = line_of(drive)
    line.restart(drive, 5.0)
    assert ask(line, write(14, "0117+1000"), 6.0) == ACK
    assert drive.value(302, 7.0) == pytest.approx(100, abs=2)


def test_the_feedback_of_a_lively_drive_has_a_ripple_unless_it_is_given_as_0() -> None:
    assert [make_device(14, lively=lively).ripple for lively in (True, False)] == [0.01, 0.0]
    assert make_device(14, lively=True, ripple=0.0).ripple == 0
    assert make_device(14, lively=False, ripple=0.5).ripple == 0.5


# Properties


@given(st.binary(max_size=40), st.booleans())
@settings(max_examples=100)
def test_whatever_it_hears_it_answers_again(data: bytes, bytewise: bool) -> None:
    """A write that was begun may take the next EOT for its checksum, once."""
    _, line = backwards(12)
    (ask_bytewise if bytewise else ask)(line, data.hex())
    ask(line, read(12, "0101"), 10.0)
    assert ask(line, read(12, "1314"), 20.0) == hexed(telegram(1314, 0, True))


def test_a_disguised_reply_names_another_parameter_with_a_right_bcc() -> None:
    drive, line = backwards(12)
    drive.faults.wrong = 1.0
    with_parity = hexed(bytes.fromhex(read(12, "0117")).translate(EVEN_PARITY))
    for now, text in enumerate((read(12, "0117"), with_parity)):
        heard = bytes(byte & 0x7F for byte in bytes.fromhex(ask(line, text, now)))
        assert heard[1:5] != b"0117"
        assert heard[5:10] == b"-0476"
        assert heard[-1] == bcc(heard[1:-1])
    assert ask(line, write(12, "0117-0476"), 5.0) == ACK  # it names nothing


def test_it_does_not_wait_for_anything_between_requests_to_others() -> None:
    """What a read leaves behind is gone with the next request to another drive: then it need not hear every byte."""
    drive = EmulatedMentor(12)
    line = line_of(drive, EmulatedMentor(13))
    waits = []
    for now, number in enumerate((12, 13)):
        ask(line, read(number, "0117"), now)
        waits.append(drive.attentive)
    assert waits == [True, False]
