"""The extended comms array and the MicroFlex map against the tables of AN00129."""

from __future__ import annotations

from enum import IntFlag

import pytest

from busmaster.protocols._comms.elements import Element, whole
from busmaster.protocols.hcp2 import comms_array, microflex
from busmaster.protocols.hcp2.microflex import CommandWord, StatusWord


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("axis0.position", 100),
        ("axis0.encoder", 105),  # AN00129's own example
        ("axis0.following_error", 107),
        ("axis1.position", 115),
        ("axis7.following_error", 212),
        ("inputs", 220),
        ("outputs", 222),  # AN00129's own example
        ("adc0", 224),
        ("adc7", 231),
        ("error", 232),
        ("error_line", 233),
        ("error_axis", 234),
        ("running", 235),
        ("line_number", 237),
        ("firmware", 239),
    ],
)
def test_the_extended_comms_array_is_the_documents(name: str, number: int) -> None:
    assert comms_array.ELEMENTS[name].number == number


def test_only_the_outputs_of_a_controller_are_writable() -> None:
    assert [e.name for e in comms_array.ELEMENTS.values() if e.writable] == ["outputs"]


@pytest.mark.parametrize(
    ("name", "number", "unit"),
    [
        ("position", 100, "counts"),
        ("axis_error", 103, ""),
        ("following_error", 107, "counts"),
        ("command_word", 108, ""),
        ("status_word", 109, ""),
        ("drive_error", 110, ""),
        ("demand_position", 111, "counts"),
        ("torque_reference", 116, "% of rated current"),
        ("torque_demand", 117, "% of rated current"),
        ("speed_reference", 118, "% of max speed"),
        ("speed_demand", 119, "% of max speed"),
        ("speed_measured", 120, "% of max speed"),
        ("speed_error", 121, "% of max speed"),
        ("drive_overload", 124, "%"),
        ("motor_overload", 125, "%"),
        ("bus_voltage", 126, "V"),
        ("current", 127, "A"),
        ("current_u", 128, "A"),
        ("current_v", 129, "A"),
        ("hall_state", 130, ""),
        ("absolute_encoder", 131, "counts"),
        ("phase_search_status", 132, ""),
        ("inputs", 220, ""),
        ("outputs", 222, ""),
        ("analog_input", 224, "%"),
        ("firmware", 239, ""),
        ("temperature", 242, "°C"),
    ],
)
def test_the_microflex_map_is_the_documents(name: str, number: int, unit: str) -> None:
    element = microflex.ELEMENTS[name]
    assert (element.number, element.unit) == (number, unit)


def test_a_microflex_has_27_names_of_which_three_are_writable() -> None:
    assert len(microflex.ELEMENTS) == 27
    assert [e.name for e in microflex.ELEMENTS.values() if e.writable] == [
        "command_word",
        "torque_reference",
        "speed_reference",
    ]


@pytest.mark.parametrize("elements", [comms_array.ELEMENTS, microflex.ELEMENTS])
def test_names_come_in_the_order_of_their_numbers(elements: dict[str, Element[object]]) -> None:
    numbers = [element.number for element in elements.values()]
    assert numbers == sorted(set(numbers))


@pytest.mark.parametrize(
    ("name", "keyword"),
    [
        ("axis0.position", "POS(0)"),
        ("axis1.velocity", "VEL(1)"),
        ("axis2.mode", "AXISMODE(2)"),
        ("axis3.axis_error", "AXISERROR(3)"),
        ("axis4.demand", "DAC(4)"),
        ("axis5.encoder", "ENCODER(5)"),
        ("axis6.idle", "IDLE(6)"),
        ("axis7.following_error", "FOLERROR(7)"),
        ("inputs", "IN"),
        ("outputs", "OUT"),
        ("adc3", "ADC(3)"),
        ("error", "Err"),
        ("error_line", "Erl"),
        ("error_axis", "ErrAxis"),
        ("running", ""),
        ("line_number", ""),
        ("firmware", "FIRMWARERELEASE"),
    ],
)
def test_an_element_has_the_mint_keyword_that_the_document_gives(name: str, keyword: str) -> None:
    assert comms_array.ELEMENTS[name].keyword == keyword


@pytest.mark.parametrize("elements", [comms_array.ELEMENTS, microflex.ELEMENTS])
def test_every_element_is_described_once_in_the_lists(elements: dict[str, Element[object]]) -> None:
    for element in elements.values():
        item = element.item
        assert (item.item, item.number, item.unit) == (element.name, str(element.number), element.unit)
        assert item.access == ("read/write" if element.writable else "read")
        assert item.meaning


@pytest.mark.parametrize(
    ("word", "element"), [(CommandWord, microflex.COMMAND_WORD), (StatusWord, microflex.STATUS_WORD)]
)
def test_every_defined_bit_of_a_word_is_described(word: type[IntFlag], element: Element[object]) -> None:
    assert {bit.name: 1 << bit.number for bit in element.item.bits} == {flag.name: flag.value for flag in word}


def test_words_are_flags_and_keep_what_the_document_does_not_define() -> None:
    assert microflex.STATUS_WORD.decode(192.0) == StatusWord.ENABLED | StatusWord.HARDWARE_ENABLE
    assert microflex.COMMAND_WORD.decode(129.0) == CommandWord.ENABLE | 1


def test_bitmaps_are_non_negative_whole_numbers() -> None:
    assert comms_array.INPUTS.decode(5.0) == 5
    assert comms_array.INPUTS.decode(-1.0) == 0xFFFF_FFFF
    assert isinstance(comms_array.INPUTS.decode(5.0), int)


def test_counts_and_codes_are_rounded() -> None:
    assert comms_array.FIRMWARE.decode(5221.0) == 5221
    assert whole(-1.0001) == -1
