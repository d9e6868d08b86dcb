"""A Mint controller, as AN00110 (HCP) and AN00129 (HCP2) describe it."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from busmaster.emulator.motion import Motion
from busmaster.emulator.traceable import TraceableMemory, traceable_value
from busmaster.errors import InvalidCommand
from busmaster.protocols._comms.device import HCP, HCP2, number_text, numbers
from busmaster.protocols._comms.mint import EmulatedMint, command_handshake, jog_on_comms1, make_mint, winding
from busmaster.wire.checks import xor
from tests.emulator.lines import TAU, ask, ask_bytewise, hexed, line_of

ACK, NAK, SILENCE = "06", "15", ""


def write(node: int, element: int, data: str) -> str:
    body = f"{node:02X}\x02{element:02X}{data}\x03".encode()
    return hexed(b"\x07" + body + bytes([xor(body)]))


def read(node: int, element: int) -> str:
    body = f"{node:02X}\x02{element:02X}\x05".encode()
    return hexed(b"\x07" + body + bytes([xor(body)]))


def value(reply: str) -> str:
    """The data field of a reply telegram."""
    return bytes.fromhex(reply)[3:-2].decode()


# Frames as AN00110 and AN00129 describe them


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        ("07 30 32 02 30 31 31 32 33 2E 34 35 36 03 2B", ACK),  # write node 2 Comms(1) = 123.456
        ("07 30 32 02 30 31 05 04", "02 30 31 31 32 33 2E 34 35 36 03 2B"),  # read it: checksum EOT
        ("07 30 32 02 46 46 05 05", "02 46 46 30 03 33"),  # read Comms(255): reserved, 0
    ],
)
def test_hcp2_answers_the_documents_own_scenarios(request_: str, reply: str) -> None:
    mint = EmulatedMint(2)
    mint.comms[1] = 123.456
    assert ask(line_of(mint), request_) == reply


@pytest.mark.parametrize(
    ("node", "request_", "reply"),
    [
        (2, "04 32 32 02 30 31 31 32 33 2E 34 35 36 03 2B", ACK),  # AN00110 "Writing Data"
        (2, "04 32 32 02 30 31 05", "02 30 31 31 32 33 2E 34 35 36 03 2B"),
        (13, "04 44 44 02 31 32 35 03 35", ACK),
        (13, "04 64 64 02 31 32 35 03 35", SILENCE),  # lower case: ignored
        (13, "04 44 45 02 31 32 35 03 35", SILENCE),  # the two node characters differ
        (1, "04 31 31 02 39 39 31 2C 32 03 2C", NAK),  # past Comms(99)
        (1, "04 31 31 02 30 30 05", NAK),  # Comms(00)
        (1, "04 31 31 02 30 31 31 35 03 06", ACK),  # a checksum that looks like ACK
        (1, "04 31 31 02 30 31 31 37 03 04", ACK),  # a checksum that looks like EOT
        (1, "04 31 31 02 30 31 31 37 03 05", NAK),  # a wrong checksum
    ],
)
def test_hcp_answers_as_the_document_says(node: int, request_: str, reply: str) -> None:
    for asking in (ask, ask_bytewise):
        mint = EmulatedMint(node, HCP)
        mint.comms[1] = 123.456
        assert asking(line_of(mint), request_) == reply


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        ("07 30 31 02 30 31 35 03 34", ACK),  # the checksum begins after BEL
        ("07 30 31 02 30 31 35 03 37", NAK),  # that of HCP
        ("07 30 31 02 32 36 31 03 35", ACK),  # element "26" is Comms(38)
        ("07 30 31 02 36 33 37 2C 38 03 26", NAK),  # 99 is stored, 100 is read-only
        ("07 30 31 02 46 45 31 2C 32 2C 33 03 33", NAK),  # 254, 255, 256
        ("07 30 31 02 44 45 35 03 34", ACK),  # Comms(222), the outputs
        ("07 30 31 02 66 65 05 04", NAK),  # a lower-case element
        ("07 30 31 02 30 30 05 06", NAK),  # element 00
        ("07 30 31 02 36 34 31 03 32", NAK),  # Comms(100): read-only
        ("07 30 31 02 30 31 03 01", NAK),  # no data
        ("07 30 32 02 30 31 35 03 37", SILENCE),  # another node
        ("00 00 07 30 31 02 30 31 35 03 34", ACK),  # idle bytes in front
        ("07 30 07 30 31 02 30 31 35 03 34", ACK),  # a reset byte begins anew
        ("07 30 31 02 30 31 35 02 34", SILENCE),  # a control character in the data: no frame
        ("07 30 31 02 30 31 35 01 03 35", SILENCE),
        ("07 30 31 02 01 31 05 36", SILENCE),  # and in the element
        ("07 30 31 02 30 31 35 03", SILENCE),  # cut
    ],
)
def test_hcp2_acknowledges_refuses_and_ignores_as_the_document_says(request_: str, reply: str) -> None:
    for asking in (ask, ask_bytewise):
        assert asking(line_of(EmulatedMint(1)), request_) == reply


def test_every_element_can_be_read_and_names_itself_in_hex() -> None:
    for node in (0, 1, 13, 255):
        mint = EmulatedMint(node)
        line = line_of(mint)
        for element in range(1, 256):
            reply = bytes.fromhex(ask(line, read(node, element), element))
            assert reply[1:3] == f"{element:02X}".encode()
            assert reply[-1] == xor(reply[1:-1])


def test_a_byte_behind_a_request_does_not_change_its_reply() -> None:
    for asking in (ask, ask_bytewise):
        assert value(asking(line_of(EmulatedMint(1)), read(1, 1) + " 41")) == "0"


def test_the_length_of_one_request_does_not_count_in_the_next() -> None:
    line = line_of(EmulatedMint(1))
    for now in (0.0, 1.0):
        assert ask_bytewise(line, write(1, 1, "0" * 39 + "7"), now) == ACK
    assert value(ask_bytewise(line, read(1, 1), 2.0)) == "7"


# Values


def test_a_multi_value_write_stores_up_to_the_first_bad_one_and_is_then_refused() -> None:
    mint = EmulatedMint(1)
    assert ask(line_of(mint), write(1, 10, "1,x,3")) == NAK
    assert mint.comms[10:13] == [1, 0, 0]
    assert ask(line_of(mint), write(1, 10, "10,20,30")) == ACK
    assert mint.comms[10:13] == [10, 20, 30]


def test_all_or_nothing_stores_nothing_of_a_bad_write() -> None:
    mint = EmulatedMint(1, all_or_nothing=True)
    assert ask(line_of(mint), write(1, 99, "7,8")) == NAK
    assert mint.comms[99] == 0
    assert ask(line_of(mint), write(1, 98, "7,8")) == ACK
    assert ask(line_of(mint), write(1, 10, "1,x,3")) == NAK
    assert mint.comms[10] == 0
    assert ask(line_of(mint), write(1, 222, "5")) == ACK
    assert mint.outputs == 5


@pytest.mark.parametrize("data", ["5.", "5 ", "1,5.", "5 x", "1,"])
def test_data_that_do_not_end_with_a_digit_are_refused(data: str) -> None:
    for asking in (ask, ask_bytewise):
        mint = EmulatedMint(1)
        assert asking(line_of(mint), write(1, 10, data)) == NAK
        assert mint.comms[10] == 0


def test_a_data_field_of_sixty_characters_is_taken_and_one_of_sixty_one_refused() -> None:
    for asking in (ask, ask_bytewise):
        mint = EmulatedMint(1)
        assert asking(line_of(mint), write(1, 1, "0" * 59 + "7")) == ACK
        assert mint.comms[1] == 7
        assert asking(line_of(mint), write(1, 2, "0" * 60 + "7")) == NAK
        assert asking(line_of(mint), write(1, 2, "0" * 200 + "7")) == NAK
        assert mint.comms[2] == 0


@pytest.mark.parametrize(
    ("data", "values"),
    [
        (b"1234,-45.6,11.2", (1234, -45.6, 11.2)),
        (b".5", (0.5,)),
        (b"+3", (3,)),
        (b"  7", (7,)),
        (b"1 2,3", (1, 3)),  # a space ends the conversion
        (b"5.,3", (5, 3)),
        (b"1.00005", (1.0001,)),  # half up on the fifth
        (b"-1.00005", (-1.0001,)),
        (b"1,,3", (1, None)),
        (b"1e3", (None,)),
        (b"", (None,)),
        (b"9" * 60, (float("9" * 60),)),
    ],
)
def test_numbers_are_read_as_the_document_says(data: bytes, values: tuple[float | None, ...]) -> None:
    assert numbers(data) == values


@pytest.mark.parametrize(
    ("number", "text"),
    [(12.5, b"12.5"), (0.0, b"0"), (-0.0, b"0"), (-0.00001, b"0"), (123.45675, b"123.4568"), (4096, b"4096")],
)
def test_numbers_are_written_short(number: float, text: bytes) -> None:
    assert number_text(number) == text


@pytest.mark.parametrize(("number", "text"), [(12.5, b"12.5000"), (-0.00001, b"0.0000"), (-0.0, b"0.0000")])
def test_numbers_with_fixed_decimals_have_four_and_no_zero_has_a_sign(number: float, text: bytes) -> None:
    assert number_text(number, fixed_decimals=True) == text


@given(st.floats(-1e9, 1e9))
@settings(max_examples=200)
def test_a_number_written_and_read_again_is_the_same_to_four_decimals(number: float) -> None:
    """Half of the fifth decimal, and what floats of that size cannot tell apart."""
    assert list(numbers(number_text(number))) == pytest.approx([number], abs=0.0000502)
    assert numbers(number_text(number, fixed_decimals=True)) == numbers(number_text(number))


def test_a_value_too_long_for_a_reply_is_refused() -> None:
    mint = EmulatedMint(1)
    mint.comms[1] = 1e30
    assert ask(line_of(mint), read(1, 1)) == NAK


def test_single_precision_keeps_24_bits() -> None:
    mint = EmulatedMint(1, single_precision=True)
    ask(line_of(mint), write(1, 1, "16777217"))
    assert value(ask(line_of(mint), read(1, 1))) == "16777216"
    for number in ("9" * 60, "-" + "9" * 59):
        assert ask(line_of(mint), write(1, 1, number)) == ACK
        assert abs(mint.comms[1]) == pytest.approx(3.4028235e38)


@given(st.binary(max_size=40), st.sampled_from([HCP, HCP2]), st.booleans())
@settings(max_examples=150)
def test_it_survives_any_bytes_and_then_answers(data: bytes, framing: object, bytewise: bool) -> None:
    mint = EmulatedMint(1, HCP if framing is HCP else HCP2)
    line = line_of(mint)
    (ask_bytewise if bytewise else ask)(line, data.hex())
    assert (ask(line, "04 31 31 02 30 31 05", 10) or ask(line, read(1, 1), 20)).startswith("02 30 31")


# The extended array


def test_an_axis_tells_position_velocity_encoder_and_idle() -> None:
    mint = EmulatedMint(1)
    line = line_of(mint)
    mint.axes[2].jog(10.0, 0.0)
    assert float(value(ask(line, read(1, 130), 10.0))) == pytest.approx(100, abs=0.5)
    assert value(ask(line, read(1, 131), 11.0)) == "10"
    assert value(ask(line, read(1, 132), 11.5)) == str(int(Motion.JOG))
    assert int(value(ask(line, read(1, 135), 12.0))) == pytest.approx(120_000, rel=0.01)
    assert value(ask(line, read(1, 134), 12.3)) == "10", "% of full speed"
    assert value(ask(line, read(1, 137), 12.6)) == "0.02", "the lag"
    assert value(ask(line, read(1, 136), 13.0)) == "0"
    assert value(ask(line, read(1, 106), 14.0)) == "1"  # axis 0 stands


def test_inputs_outputs_and_analog_channels_can_be_read() -> None:
    mint = EmulatedMint(1)
    line = line_of(mint)
    mint.inputs, mint.adc[3] = 5, 12.25
    assert ask(line, write(1, 222, "8.6")) == ACK
    assert [value(ask(line, read(1, element), element)) for element in (220, 222, 227, 239)] == [
        "5",
        "9",
        "12.25",
        "5628",
    ]


def test_each_of_the_eight_analog_channels_has_its_own_element() -> None:
    mint = EmulatedMint(1)
    line = line_of(mint)
    volts = (1.5, 2.5, -3.5, 4.5, 5.5, 6.5, 7.5, -8.5)
    mint.preset("224", *volts)
    assert [float(value(ask(line, read(1, element), element))) for element in range(223, 233)] == [0, *volts, 0]
    assert {ask(line, write(1, element, "1"), element + 100) for element in (224, 231)} == {NAK}
    with pytest.raises(InvalidCommand, match="element 232 cannot be given"):
        mint.preset("231", 1, 2)


def test_an_axis_of_several_that_has_an_error_is_named() -> None:
    mint = EmulatedMint(1)
    line = line_of(mint)
    assert value(ask(line, read(1, 234))) == "0"
    mint.axes[2].error, mint.axes[1].error = 5, 9
    assert value(ask(line, read(1, 234), 1.0)) == "1", "the first of them"


def test_reserved_elements_read_zero_or_are_refused_if_so_set() -> None:
    assert value(ask(line_of(EmulatedMint(1)), read(1, 221))) == "0"
    assert ask(line_of(EmulatedMint(1, refuse_reserved=True)), read(1, 221)) == NAK
    assert ask(line_of(EmulatedMint(1, axes=1, refuse_reserved=True)), read(1, 115)) == NAK
    assert ask(line_of(EmulatedMint(1)), write(1, 221, "1")) == NAK


# Programs and events


def test_a_write_to_the_first_five_elements_raises_its_event_even_if_nothing_changed() -> None:
    heard: list[tuple[int, float]] = []
    others: list[int] = []
    mint = EmulatedMint(
        1,
        events=[
            lambda mint, element, now: heard.append((element, mint.comms[element])),
            lambda mint, element, now: others.append(element),
        ],
    )
    line = line_of(mint)
    for element in (1, 1, 5, 6):
        ask(line, write(1, element, "3"))
    assert heard == [(1, 3), (1, 3), (5, 3)]
    assert others == [1, 1, 5]


def test_event_comms1_jogs_the_axis() -> None:
    mint = EmulatedMint(1, events=[jog_on_comms1])
    line = line_of(mint)
    ask(line, write(1, 1, "-25"))
    assert float(value(ask(line, read(1, 101), 2.0))) == -25


def test_the_winding_program_traverses_between_its_two_ends() -> None:
    mint = EmulatedMint(1, program=winding)
    line = line_of(mint)
    assert value(ask(line, read(1, 3))) == "0"
    ask(line, write(1, 1, "10,20,4.3"), 1.0)
    positions = [float(value(ask(line, read(1, 4), 2.0 + step))) for step in range(60)]
    assert 9.5 < min(positions[5:]) < 11
    assert 19 < max(positions[5:]) < 20.5
    assert value(ask(line, read(1, 235), 70.0)) == "1"


def test_the_command_handshake_clears_comms1_when_the_move_is_over() -> None:
    mint = EmulatedMint(1, program=command_handshake)
    line = line_of(mint)
    ask(line, read(1, 1))
    ask(line, write(1, 2, "10,5"), 0.1)  # speed 10, target 5
    mint.run(0.2)
    while mint.line_number != 10:  # just cleared: the next statement reads Comms(1)
        mint.run(mint.now + mint.statement)
    ask(line, write(1, 1, "1"), mint.now - 9 * TAU - TAU / 2)
    assert value(ask(line, read(1, 1), 0.4)) == "1"
    assert value(ask(line, read(1, 1), 1.0)) == "0"
    assert value(ask(line, read(1, 115), 1.1)) == "5"


def test_the_command_handshake_loses_a_command_that_comes_between_its_read_and_its_clear() -> None:
    mint = EmulatedMint(1, program=command_handshake)
    mint.run(0.0)
    mint.run(1.0)
    while mint.line_number != 4:  # Comms(1) has been read as 0
        mint.run(mint.now + mint.statement)
    assert mint.read_element(237, mint.now) == 4
    assert mint.write_element(1, 1.0, mint.now)
    mint.comms[2:4] = [10.0, 5.0]
    mint.run(mint.now + 2.0)
    assert mint.comms[1] == 0
    assert mint.axes[1].position(mint.now) == 0


def test_the_command_handshake_moves_relative_and_home() -> None:
    mint = EmulatedMint(1, program=command_handshake)
    mint.run(0.0)
    mint.comms[2:4] = [100.0, 5.0]
    for command, position in ((2, 5), (2, 10), (3, 0)):
        while mint.line_number != 10:
            mint.run(mint.now + mint.statement)
        assert mint.write_element(1, command, mint.now)
        mint.run(mint.now + 2.0)
        assert mint.comms[1] == 0
        assert mint.axes[1].position(mint.now) == position


def test_a_program_that_ends_is_no_longer_running() -> None:
    def short(mint: EmulatedMint) -> Generator[int, None, None]:
        mint.comms[7] = 1
        yield 1

    mint = EmulatedMint(1, program=short)
    assert [mint.read_element(235, now) for now in (0.0, 1.0)] == [True, False]
    assert mint.comms[7] == 1
    mint.start_program()
    assert mint.read_element(235, 2.0) is True


def test_a_restart_loses_what_was_in_ram() -> None:
    mint = EmulatedMint(1)
    line = line_of(mint)
    ask(line, write(1, 1, "3"))
    line.restart(mint, 1.0)
    assert value(ask(line, read(1, 1), 2.0)) == "0"


def test_a_restart_stops_the_axes_clears_the_outputs_and_starts_the_program_again() -> None:
    mint = EmulatedMint(1, program=command_handshake)
    line = line_of(mint)
    mint.axes[1].jog(10.0, 0.0)
    mint.axes[2].error = 5
    assert ask(line, write(1, 222, "9")) == ACK
    ask(line, read(1, 1), 1.0)
    line.restart(mint, 2.0)
    assert [value(ask(line, read(1, element), 3.0)) for element in (115, 116, 133, 222)] == ["0", "0", "0", "0"]
    ask(line, write(1, 1, "7"), 3.0)
    ask(line, read(1, 1), 4.0)
    assert value(ask(line, read(1, 1), 5.0)) == "0", "the first statement of the program clears Comms(1)"


def test_half_a_request_is_lost_in_a_restart() -> None:
    mint = EmulatedMint(1)
    line = line_of(mint)
    ask(line, write(1, 1, "3")[:-3])
    line.restart(mint, 1.0)
    assert value(ask_bytewise(line, read(1, 1), 2.0)) == "0"


@pytest.mark.parametrize(("now", "cleared"), [(5.0, False), (5.002, True)])
def test_the_time_of_a_program_begins_with_the_first_request(now: float, cleared: bool) -> None:
    mint = EmulatedMint(1, program=command_handshake)
    mint.comms[1] = 7
    assert mint.read_element(1, 5.0) == 7
    assert (mint.read_element(1, now) == 0) is cleared


# Initial values


@pytest.mark.parametrize(
    ("item", "given", "element", "read_back"),
    [
        ("1", (1.5, -2.0), 2, "-2"),
        ("100", (12.5,), 105, "12500"),
        ("103", (4,), 234, "0"),
        ("118", (4,), 234, "1"),
        ("224", (1.0, -99.5), 225, "-99.5"),
        ("220", (255,), 220, "255"),
        ("222", (7,), 222, "7"),
        ("239", (6000,), 239, "6000"),
    ],
)
def test_initial_values_are_those_of_the_element_and_of_those_after_it(
    item: str, given: tuple[float, ...], element: int, read_back: str
) -> None:
    mint = EmulatedMint(1)
    mint.preset(item, *given)
    assert value(ask(line_of(mint), read(1, element))) == read_back


@pytest.mark.parametrize(
    ("item", "given"),
    [
        ("x", (1,)),
        ("0", (1,)),
        ("-1", (1,)),
        ("99", (1, 2, 3)),
        ("101", (1,)),
        ("115", (1,)),  # there is one axis
        ("221", (1,)),
        ("255", (1, 1)),
        ("1", (1.1e9,)),
        ("1", (-1.1e9,)),
        ("103", (0.5,)),
        ("220", (-1,)),
    ],
)
def test_an_initial_value_that_a_controller_cannot_hold_is_refused(item: str, given: tuple[float, ...]) -> None:
    with pytest.raises(InvalidCommand):
        EmulatedMint(1, axes=1).preset(item, *given)


def test_an_hcp_controller_has_initial_values_up_to_element_99() -> None:
    mint = EmulatedMint(1, HCP)
    mint.preset("99", 5)
    assert mint.comms[99] == 5
    with pytest.raises(InvalidCommand, match="an emulated controller's element 100 cannot be given"):
        mint.preset("100", 5)


def test_an_initial_value_has_single_precision_where_the_controller_has() -> None:
    mint = EmulatedMint(1, single_precision=True)
    mint.preset("1", 16777217)
    assert value(ask(line_of(mint), read(1, 1))) == "16777216"


def test_positions_are_not_reported_over_a_given_element_also_after_a_restart() -> None:
    mint = make_mint(HCP2, 1, lively=True)
    mint.preset("12", 33)
    line = line_of(mint)
    assert [value(ask(line, read(1, 12), now)) for now in (0.0, 10.0)] == ["33", "33"]
    line.restart(mint, 20.0)
    assert ask(line, write(1, 12, "44"), 21.0) == ACK
    assert [value(ask(line, read(1, 12), now)) for now in (22.0, 30.0)] == ["44", "44"]


def test_positions_go_on_being_reported_if_another_element_is_given() -> None:
    mint = make_mint(HCP2, 1, lively=True)
    mint.preset("19", 33)
    line = line_of(mint)
    assert len({value(ask(line, read(1, 12), now)) for now in (0.0, 10.0, 20.0)}) > 1


# What a line file can ask for


def test_a_lively_controller_with_a_program_runs_that_program() -> None:
    mint = make_mint(HCP2, 1, lively=True, program="winding", statement=0.01)
    assert (mint.program, mint.statement) == (winding, 0.01)
    assert mint.axes[0].motion is Motion.IDLE
    assert make_mint(HCP2, 1, lively=True).statement == 0.05
    assert make_mint(HCP2, 1, lively=False).statement == 0.001


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"axes": 0}, "1 to 8 axes"),
        ({"axes": 9}, "1 to 8 axes"),
        ({"axes": 1, "program": "command_handshake"}, "2 to 8 axes for its program, not 1"),
        ({"statement": 0.00009}, "a statement takes 0.0001 s at least, not 9e-05 s"),
    ],
)
def test_a_controller_that_cannot_be_is_refused(options: dict[str, Any], reason: str) -> None:
    with pytest.raises(InvalidCommand, match=reason):
        make_mint(HCP2, 1, lively=False, **options)
    make_mint(HCP2, 1, lively=False, axes=2, program="command_handshake", statement=0.0001)


def test_a_controller_of_a_file_has_all_of_its_options() -> None:
    options: dict[str, Any] = {
        "axes": 3,
        "firmware": 6000,
        "jogs_on_comms1": True,
        "fixed_decimals": True,
        "all_or_nothing": True,
    }
    mint = make_mint(HCP2, 1, lively=False, refuse_reserved=True, single_precision=True, **options)
    line = line_of(mint)
    assert value(ask(line, read(1, 239), 0.0)) == "6000.0000"
    assert ask(line, read(1, 145), 1.0) == NAK, "there are three axes"
    assert ask(line, write(1, 99, "7,8"), 2.0) == NAK
    assert value(ask(line, read(1, 99), 3.0)) == "0.0000"
    assert ask(line, write(1, 6, "16777217"), 4.0) == ACK
    assert value(ask(line, read(1, 6), 5.0)) == "16777216.0000"
    ask(line, write(1, 1, "-25"), 6.0)
    assert value(ask(line, read(1, 101), 8.0)) == "-25.0000"
    plain = line_of(make_mint(HCP2, 1, lively=False))
    ask(plain, write(1, 1, "-25"))
    assert value(ask(plain, read(1, 101), 2.0)) == "0"


# The traceable


def test_with_an_oracle_every_element_tells_node_element_and_writes() -> None:
    mint = EmulatedMint(7, traceable=TraceableMemory(7))
    line = line_of(mint)
    assert value(ask(line, read(7, 5))) == str(traceable_value(7, 5, 0))
    assert ask(line, write(7, 5, str(traceable_value(7, 5, 0)))) == ACK
    assert value(ask(line, read(7, 5))) == str(traceable_value(7, 5, 1))
    assert mint.traceable is not None
    assert mint.traceable.foreign_writes == 0
    ask(line, write(7, 5, str(traceable_value(6, 5, 1))))
    assert mint.traceable.foreign_writes == 1


def test_with_an_oracle_too_a_write_past_the_last_element_is_refused() -> None:
    mint = EmulatedMint(1, HCP, traceable=TraceableMemory(1))
    assert ask(line_of(mint), "04 31 31 02 39 39 31 2C 32 03 2C") == NAK
    assert mint.traceable is not None
    assert set(mint.traceable.writes) == {99}
