"""Numbers on the wire: AN00110 and AN00129, "Data Field"."""

from __future__ import annotations

from decimal import ROUND_HALF_UP, Decimal
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster.contract.exchange import FrameError
from busmaster.errors import InvalidCommand
from busmaster.wire.numbers import LONGEST_NUMBER, format_list, format_number, parse_number


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (123.456, "123.456"),
        (-45.6, "-45.6"),
        (5.0, "5"),
        (10, "10"),
        (100.0, "100"),
        (0.5, ".5"),
        (-0.0001, "-.0001"),
        (16777217, "16777217"),
        (1e16, "10000000000000000"),
        (10**20 - 1, "99999999999999999999"),
        (Decimal("1.5"), "1.5"),
    ],
)
def test_a_value_takes_its_shortest_text(value: float, text: str) -> None:
    assert format_number(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.00005, ".0001"), (1.00005, "1.0001"), (-1.00005, "-1.0001"), (0.00004999, "0"), (99999.99995, "100000")],
)
def test_the_fifth_decimal_rounds_half_away_from_zero_on_the_decimal_text(value: float, text: str) -> None:
    assert format_number(value) == text


@pytest.mark.parametrize("value", [0, 0.0, -0.0, -0.00004, -1e-300])
def test_zero_has_no_sign(value: float) -> None:
    assert format_number(value) == "0"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf"), 1e20, -1e19, 10**20, "1", None])
def test_what_cannot_be_written_in_20_characters_is_refused_before_anything_is_sent(value: Any) -> None:
    with pytest.raises(InvalidCommand):
        format_number(value)


def test_even_an_integer_that_python_will_not_print_is_refused() -> None:
    with pytest.raises(InvalidCommand):
        format_number(10**5000)


@given(st.floats(-1e15, 1e15))
def test_a_value_comes_back_as_it_was_to_4_decimals(value: float) -> None:
    text = format_number(value)
    assert set(text) <= set("-.0123456789")
    assert len(text) <= LONGEST_NUMBER
    expected = Decimal(repr(value)).quantize(Decimal("0.0001"), ROUND_HALF_UP)
    assert Decimal(text) == expected
    assert parse_number(text.encode()) == float(expected)


def test_a_list_is_separated_by_commas() -> None:
    assert format_list([1234, -45.6, 11.2]) == "1234,-45.6,11.2"  # AN00110's own example


def test_a_list_of_60_characters_fits_and_one_of_61_does_not() -> None:
    assert len(format_list([12345] * 9 + [123456])) == 60
    with pytest.raises(InvalidCommand, match="fewer values"):
        format_list([12345] * 8 + [123456] * 2)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        (b"123.456", 123.456),
        (b" 123", 123.0),
        (b"123.4560 ", 123.456),
        (b"+.5", 0.5),
        (b"-0.0001", -0.0001),
        (b"1.5E+03", 1500.0),
        (b"0", 0.0),
    ],
)
def test_a_reply_may_be_written_in_any_decimal_form(field: bytes, value: float) -> None:
    assert parse_number(field) == value


@pytest.mark.parametrize("field", [b"", b" ", b"-", b"1 2", b"1,2", b"nan", b"inf", b"1_0", b"0x10", b"1e999", b"\xb2"])
def test_anything_else_is_no_number(field: bytes) -> None:
    with pytest.raises(FrameError, match="not a number"):
        parse_number(field)


@given(st.binary(max_size=8))
def test_no_field_raises_anything_but_a_frame_error(field: bytes) -> None:
    try:
        value = parse_number(field)
    except FrameError:
        return
    assert value - value == 0


def test_a_truth_is_not_a_number_and_the_error_says_what_to_write() -> None:
    for value, number in ((True, 1), (False, 0)):
        with pytest.raises(InvalidCommand, match=f"{value} is not a number: write {number} if that is meant"):
            format_number(value)
