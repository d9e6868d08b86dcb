"""A MicroFlex drive, as the last section of AN00129 describes it."""

from __future__ import annotations

import math
from typing import Any

import pytest

from busmaster.emulator.line import Line
from busmaster.emulator.traceable import TraceableMemory, traceable_value
from busmaster.errors import InvalidCommand
from busmaster.protocols.hcp2.microflex_device import AMBIENT, FULL_SPEED, EmulatedMicroFlex, make_device
from busmaster.wire.checks import xor
from tests.emulator.lines import ask, hexed, line_of

ACK, NAK = "06", "15"
ENABLED, HARDWARE, STOP, ERROR = 128, 64, 32, 8


def write(line: Line, element: int, data: str, now: float) -> str:
    body = f"07\x02{element:02X}{data}\x03".encode()
    return ask(line, hexed(b"\x07" + body + bytes([xor(body)])), now)


def read_request(element: int) -> str:
    body = f"07\x02{element:02X}\x05".encode()
    return hexed(b"\x07" + body + bytes([xor(body)]))


def read(line: Line, element: int, now: float) -> float:
    return float(bytes.fromhex(ask(line, read_request(element), now))[3:-2])


@pytest.fixture
def drive() -> EmulatedMicroFlex:
    return EmulatedMicroFlex(7)


@pytest.fixture
def line(drive: EmulatedMicroFlex) -> Line:
    return line_of(drive)


def test_the_documents_frames_enable_it_set_its_speed_and_read_its_status(line: Line) -> None:
    assert ask(line, "07 30 37 02 36 43 31 32 38 03 48") == ACK  # 108 = 128
    assert ask(line, "07 30 37 02 37 36 2D 32 35 2E 35 03 36", 1) == ACK  # 118 = -25.5
    assert ask(line, "07 30 37 02 36 44 05 72", 2) == "02 36 44 31 39 32 03 4B"  # 109 = 192


def test_the_measured_speed_follows_the_reference_and_the_position_integrates(line: Line) -> None:
    write(line, 108, "128", 0)
    write(line, 118, "50", 1)
    assert 0 < read(line, 120, 1.5) < 50
    assert read(line, 121, 1.51) > 0
    assert read(line, 120, 4) == 50
    start = read(line, 100, 5)
    assert read(line, 100, 6) - start == pytest.approx(FULL_SPEED / 2, abs=2)
    assert read(line, 117, 7) > 0
    assert read(line, 127, 8) > 0
    assert read(line, 128, 9) + read(line, 129, 9.0) != 0
    assert read(line, 111, 10) == pytest.approx(read(line, 100, 10) + read(line, 107, 10), abs=3000)


def test_a_disabled_drive_keeps_its_reference_and_stands(line: Line) -> None:
    write(line, 118, "50", 0)
    assert read(line, 118, 1) == 50
    assert read(line, 119, 2) == read(line, 120, 3) == 0
    write(line, 108, "128", 4)
    assert read(line, 120, 9) == 50
    write(line, 108, "0", 10)
    assert read(line, 120, 19) == 0
    assert read(line, 109, 20) == HARDWARE


def test_it_is_not_enabled_without_the_hardware_enable(drive: EmulatedMicroFlex, line: Line) -> None:
    drive.set_hardware_enable(False, 0.0)
    assert write(line, 108, "128", 1) == ACK
    assert read(line, 109, 2) == 0
    drive.set_hardware_enable(True, 3.0)
    assert read(line, 109, 4) == HARDWARE
    write(line, 108, "128", 5)
    assert read(line, 109, 6) == HARDWARE | ENABLED


def test_an_error_latches_disables_and_is_cancelled_by_bit_6(drive: EmulatedMicroFlex, line: Line) -> None:
    write(line, 108, "128", 0)
    write(line, 118, "50", 1)
    drive.trip(4, 5.0)
    assert read(line, 103, 6) == 4
    assert read(line, 109, 7) == HARDWARE | ERROR
    assert read(line, 222, 7.5) == 1
    write(line, 108, "128", 8)  # cannot be enabled over an error
    assert read(line, 109, 9) == HARDWARE | ERROR
    write(line, 108, "192", 10)
    assert read(line, 103, 11) == 0
    assert read(line, 109, 12) == HARDWARE | ENABLED
    assert read(line, 120, 13) == 0  # motion waits for bit 6 to be cleared
    write(line, 108, "128", 14)
    assert read(line, 120, 20) == 50


def test_an_error_whose_cause_is_still_there_cannot_be_cancelled(drive: EmulatedMicroFlex, line: Line) -> None:
    drive.causes = 4
    drive.trip(5, 0.0, drive_errors=1)
    assert read(line, 110, 1) == 1
    write(line, 108, "64", 2)
    assert read(line, 103, 3) == 4
    assert read(line, 110, 4) == 0


def test_a_cancel_bit_left_high_keeps_errors_from_latching(drive: EmulatedMicroFlex, line: Line) -> None:
    write(line, 108, "192", 0)
    drive.trip(4, 1.0)
    assert read(line, 103, 2) == 0
    assert read(line, 108, 3) == 192


def test_an_active_stop_input_shows_and_stops(drive: EmulatedMicroFlex, line: Line) -> None:
    write(line, 108, "128", 0)
    write(line, 118, "50", 1)
    drive.stop_input = True
    write(line, 118, "50", 5)
    assert read(line, 109, 9) == HARDWARE | ENABLED | STOP
    assert read(line, 120, 10) == 0


@pytest.mark.parametrize(
    ("current_control", "host_reference", "torque", "speed"),
    [(False, True, NAK, ACK), (True, True, ACK, NAK), (False, False, NAK, NAK), (True, False, NAK, NAK)],
)
def test_a_reference_is_taken_only_in_its_mode_and_from_the_host(
    current_control: bool, host_reference: bool, torque: str, speed: str
) -> None:
    line = line_of(EmulatedMicroFlex(7, current_control=current_control, host_reference=host_reference))
    assert write(line, 116, "10", 0) == torque
    assert write(line, 118, "10", 1) == speed


def test_in_current_control_the_torque_reference_drives_it() -> None:
    line = line_of(EmulatedMicroFlex(7, current_control=True))
    write(line, 108, "128", 0)
    write(line, 116, "40", 1)
    assert read(line, 117, 2) == 40
    assert read(line, 127, 3) == pytest.approx(1.2)
    assert read(line, 120, 9) > 0


@pytest.mark.parametrize("element", [100, 103, 109, 117, 119, 126, 132, 220, 222, 239, 242])
def test_every_other_mapped_element_is_read_only(line: Line, element: int) -> None:
    assert write(line, element, "1", 0) == NAK
    read(line, element, 1)


UNMAPPED = (1, 2, 99, 101, 102, 104, 106, 112, 115, 122, 133, 219, 221, 223, 225, 236, 240, 241, 243, 255)


@pytest.mark.parametrize("element", UNMAPPED)
def test_unmapped_elements_are_refused_by_default(line: Line, element: int) -> None:
    assert write(line, element, "1", 0) == NAK
    assert ask(line, read_request(element), 1) == NAK


@pytest.mark.parametrize("element", UNMAPPED)
def test_a_drive_that_ignores_unmapped_elements_does_not_reply_to_a_read_of_one(element: int) -> None:
    line = line_of(EmulatedMicroFlex(7, ignore_unmapped=True))
    assert ask(line, read_request(element), 0) == ""
    assert ask(line, read_request(element), 1) == "", "the same request once more"
    assert read(line, 109, 2) == 64


def test_with_an_oracle_every_element_is_mapped() -> None:
    line = line_of(EmulatedMicroFlex(7, ignore_unmapped=True, traceable=TraceableMemory(7)))
    assert read(line, 1, 0) == traceable_value(7, 1, 0)


@pytest.mark.parametrize("word", ["-1", "256"])
def test_a_command_word_of_more_than_eight_bits_is_refused(line: Line, word: str) -> None:
    assert write(line, 108, word, 0) == NAK
    assert read(line, 108, 1) == 0


def test_unmapped_elements_read_zero_if_so_set() -> None:
    line = line_of(EmulatedMicroFlex(7, refuse_unmapped=False))
    assert read(line, 50, 0) == read(line, 101, 1) == read(line, 236, 2) == 0


def test_it_reports_firmware_bus_voltage_and_a_temperature_that_rises_under_load(line: Line) -> None:
    assert read(line, 239, 0) >= 5221
    assert read(line, 126, 1) == 320
    assert read(line, 242, 2) == AMBIENT
    write(line, 108, "128", 3)
    write(line, 118, "100", 4)
    warm = read(line, 242, 30)
    assert AMBIENT < warm < read(line, 242, 100)
    write(line, 108, "0", 101)
    assert read(line, 242, 2000) == pytest.approx(AMBIENT, abs=0.01)


def test_a_drive_has_the_acceleration_the_ripple_and_the_firmware_of_its_options() -> None:
    drive = make_device(7, lively=False, acceleration=200.0, firmware=6000)
    line = line_of(drive)
    for now in (0.0, 20.0):  # and again after a restart
        write(line, 108, "128", now)
        write(line, 118, "100", now)
        assert read(line, 120, now + 0.25) == pytest.approx(50, abs=2)
        line.restart(drive, now + 10)
    assert read(line, 239, 40) == 6000
    assert make_device(7, lively=True).ripple == 0.01
    assert make_device(7, lively=True, ripple=0.0).ripple == 0
    assert make_device(7, lively=False).ripple == 0


def test_a_drive_in_current_control_forgets_its_torque_reference_in_a_restart() -> None:
    drive = EmulatedMicroFlex(7, current_control=True)
    line = line_of(drive)
    write(line, 116, "40", 0)
    line.restart(drive, 1.0)
    assert read(line, 116, 2) == 0
    write(line, 108, "128", 3)
    assert read(line, 120, 9) == 0


def test_the_currents_of_the_phases_and_the_hall_sensors_turn_with_the_shaft() -> None:
    """120 degrees lie between two phases, 60 between two codes; a turn has 4096 counts."""
    seen = []
    for twelfth in range(12):
        drive = EmulatedMicroFlex(7, current_control=True)
        drive.preset("116", 40)
        drive.preset("108", 128)
        drive.preset("100", 4096 / 12 * (twelfth + 0.5))
        angle = math.radians(30 * twelfth + 15)
        line = line_of(drive)
        assert read(line, 128, 0.0) == pytest.approx(1.2 * math.sqrt(2) * math.sin(angle), abs=0.01)
        assert read(line, 129, 0.0) == pytest.approx(1.2 * math.sqrt(2) * math.sin(angle - math.radians(120)), abs=0.01)
        seen.append(round(read(line, 130, 0.0)))
    assert seen == [code for code in (1, 3, 2, 6, 4, 5) for _ in range(2)]


def test_the_demanded_position_is_ahead_of_the_measured_one_by_the_following_error(
    drive: EmulatedMicroFlex, line: Line
) -> None:
    for now, speed, ahead in ((0.0, "50", 100), (10.0, "-50", -100)):
        write(line, 108, "128", now)
        write(line, 118, speed, now + 0.1)
        position, error, demanded = (drive.read_element(element, now + 9) for element in (100, 107, 111))
        assert error == ahead
        assert demanded == pytest.approx((position or 0) + ahead, abs=1)


def test_a_restart_disables_it_and_forgets_its_references(drive: EmulatedMicroFlex, line: Line) -> None:
    write(line, 108, "128", 0)
    write(line, 118, "50", 1)
    drive.trip(4, 4.0)
    line.restart(drive, 5.0)
    assert [read(line, element, element) for element in (103, 108, 109, 118, 120)] == [0, 0, HARDWARE, 0, 0]


def test_a_drive_that_was_enabled_is_disabled_after_a_restart(drive: EmulatedMicroFlex, line: Line) -> None:
    write(line, 108, "128", 0)
    line.restart(drive, 1.0)
    assert read(line, 109, 2) == HARDWARE
    assert write(line, 118, "50", 3) == ACK
    assert read(line, 120, 9) == 0, "it stands until the next command"


def test_a_drive_error_alone_disables_the_drive_and_sets_its_error_output(drive: EmulatedMicroFlex, line: Line) -> None:
    write(line, 108, "128", 0)
    drive.trip(0, 1.0, drive_errors=2)
    assert [read(line, element, element) for element in (103, 109, 110, 222)] == [0, HARDWARE | ERROR, 2, 1]
    write(line, 108, "64", 300)
    assert [read(line, element, 300 + element) for element in (109, 110, 222)] == [HARDWARE, 0, 0]


def test_a_restart_cancels_a_drive_error_and_keeps_an_error_whose_cause_exists(
    drive: EmulatedMicroFlex, line: Line
) -> None:
    drive.causes = 4
    drive.trip(5, 0.0, drive_errors=2)
    line.restart(drive, 1.0)
    assert [read(line, element, element) for element in (103, 110)] == [4, 0]


def test_errors_come_after_their_delay_from_the_first_request(line: Line, drive: EmulatedMicroFlex) -> None:
    drive.trip_after(2.0, 4, 2)
    assert read(line, 103, 10.0) == 0
    assert read(line, 103, 11.9) == 0
    assert [read(line, 103, 12.1), read(line, 110, 13.0)] == [4, 2]
    write(line, 108, "64", 14)
    assert [read(line, 103, 20), read(line, 110, 21)] == [0, 0], "they come once"


def test_in_reverse_torque_speed_and_their_errors_have_the_other_sign(line: Line) -> None:
    write(line, 108, "128", 0)
    write(line, 118, "-50", 1)
    assert read(line, 121, 1.2) < 0
    assert read(line, 107, 1.3) < 0
    assert read(line, 117, 1.4) < 0
    assert [read(line, element, element) for element in (117, 120, 121)] == [-5, -50, 0]


@pytest.mark.parametrize("torque", [150, -150])
def test_an_overload_is_what_exceeds_full_torque_in_either_direction(torque: int) -> None:
    line = line_of(EmulatedMicroFlex(7, current_control=True))
    write(line, 108, "128", 0)
    write(line, 116, str(torque), 1)
    assert [read(line, 117, 2), read(line, 124, 3), read(line, 125, 4)] == [torque, 50, 50]
    assert read(line, 126, 5) == 312.5


@pytest.mark.parametrize(
    ("item", "values", "element", "read_back"),
    [
        ("100", (4096,), 100, 4096),
        ("131", (-4096,), 100, -4096),
        ("103", (4,), 109, HARDWARE | ERROR),
        ("110", (4,), 110, 4),
        ("108", (128,), 109, HARDWARE | ENABLED),
        ("116", (12.5,), 116, 12.5),
        ("118", (-12.5,), 118, -12.5),
        ("220", (65535,), 220, 65535),
        ("224", (-1.5,), 224, -1.5),
        ("239", (6000,), 239, 6000),
    ],
)
def test_initial_values(item: str, values: tuple[float, ...], element: int, read_back: float) -> None:
    drive = EmulatedMicroFlex(7)
    drive.preset(item, *values)
    assert read(line_of(drive), element, 0) == read_back


@pytest.mark.parametrize(
    ("item", "values"),
    [("109", (1,)), ("x", (1,)), ("108", (256,)), ("220", (65536,)), ("103", (0.5,)), ("118", (1, 2)), ("116", (2e9,))],
)
def test_an_initial_value_that_a_drive_cannot_hold_is_refused(item: str, values: tuple[float, ...]) -> None:
    with pytest.raises(InvalidCommand):
        EmulatedMicroFlex(7).preset(item, *values)


@pytest.mark.parametrize(
    ("options", "status", "errors"),
    [
        ({}, HARDWARE, (0, 0)),
        ({"lively": True}, HARDWARE | ENABLED, (0, 0)),
        ({"stop_input": True}, HARDWARE | STOP, (0, 0)),
        ({"hardware_enable": False}, 0, (0, 0)),
        ({"hardware_enable": False, "lively": True}, 0, (0, 0)),
        ({"axis_error": 4}, HARDWARE | ERROR, (4, 0)),
        ({"drive_error": 4}, HARDWARE | ERROR, (0, 4)),
        ({"axis_error": 4, "drive_error": 2, "trips_after": 1.0}, HARDWARE, (4, 2)),
    ],
)
def test_a_drive_of_a_file_begins_as_its_options_state(
    options: dict[str, Any], status: int, errors: tuple[int, int]
) -> None:
    line = line_of(make_device(7, **{"lively": False, **options}))
    assert read(line, 109, 10.0) == status
    assert (read(line, 103, 12.0), read(line, 110, 12.5)) == errors


def test_a_ripple_makes_the_measured_speed_live(drive: EmulatedMicroFlex, line: Line) -> None:
    drive.ripple = 0.01
    write(line, 108, "128", 0)
    write(line, 118, "50", 1)
    speeds = {read(line, 120, 10 + n * 0.7) for n in range(10)}
    assert len(speeds) > 5
    assert all(49.4 < speed < 50.6 for speed in speeds)
