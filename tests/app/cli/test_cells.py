"""The cells of the screen: widths, trends, ages, and numbers that never lose their magnitude."""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from busmaster.app.cli.cells import age_text, clock_text, column_widths, fit_value, sparkline


@given(st.floats(allow_nan=False, allow_infinity=False) | st.integers(-(10**400), 10**400), st.integers(8, 24))
@example(1e12, 10)
@example(-123456.78901234, 8)
@example(999999999.99, 9)
@example(1.2345678e-7, 11)
@example(-5e-324, 8)
def test_a_number_never_loses_its_magnitude(value: float, width: int) -> None:
    text = fit_value(value, width)
    assert len(text) <= width
    if abs(value) < 1e308:
        assert math.isclose(float(text), value, rel_tol=0.5, abs_tol=0.0) or float(text) == value
        assert (float(text) < 0) == (value < 0)


def test_as_many_digits_as_there_is_room_for_and_as_the_point_has() -> None:
    assert fit_value(1_000_000_000_000, 11) == "1e12"
    assert fit_value(123.456789012345, 11) == "123.4567890"[:11].rstrip("0")
    assert fit_value(-0.0000012345678, 11) == "-1.23457e-6"
    assert fit_value(12.3456, 11, 1) == "12.3"
    assert fit_value(math.inf, 8) == "inf"
    assert fit_value(None, 8) == "-"


def test_of_several_values_whole_ones_are_shown() -> None:
    assert fit_value("1.5,100000,-7", 12) == "1.5,100000,…"
    assert fit_value("1.5,100000,-7", 11) == "1.5,…"
    assert fit_value("1.5,100000,-7", 13) == "1.5,100000,-7"
    assert fit_value("100000000000000,2", 11) == "1e14,…"
    assert fit_value("65 PROGRAM_RUNNING|AUTO_START", 11) == "65 PROGRAM…"


@pytest.mark.parametrize("width", range(60, 140))
def test_the_columns_fill_a_terminal_as_far_as_they_may_grow(width: int) -> None:
    widths = column_widths(width)
    total = sum(widths.values()) + len(widths) - 1
    assert total <= width
    assert ("TREND" in widths) == (width >= 75)
    assert total == min(width, 122)


def test_a_trend_spans_its_own_lowest_and_highest_and_shows_gaps() -> None:
    assert sparkline([0.0, None, 1.0]) == "▁ █"
    assert sparkline([5.0, 5.0]) == "▁▁"
    assert sparkline([None, None]) == ""
    assert sparkline([1.0, math.nan, 2.0]) == "▁ █"


def test_ages_and_clocks_fit_their_columns() -> None:
    ages = (None, 0.04, 9.94, 9.96, 12.3, 599, 6000, 360_000)
    assert [age_text(age) for age in ages] == ["-", "0.0s", "9.9s", "10s", "12s", "599s", "100m", "100h"]
    assert clock_text(3661.9) == "1:01:01"
