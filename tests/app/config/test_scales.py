"""What a number on the line means, and ranges of names."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster.app.config.names import expanded
from busmaster.app.config.points import Scale
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.errors import InvalidCommand
from busmaster.protocols.msc.status import ProgramStatus

factors = st.sampled_from([1, 0.1, 0.001, 0.25, -2, 1.75, 1e-6, 3])
offsets = st.sampled_from([0, -40, 0.5, 273.15])


def test_a_scaled_value_is_the_decimal_that_a_person_would_write() -> None:
    assert Scale.of(0.1).reader()(3) == 0.3
    assert Scale.of(0.001).reader()(12345) == 12.345
    assert Scale.of(decimals=1).reader()(-476) == -47.6
    assert Scale.of(0.1, -40).reader()(655) == 25.5
    assert Scale.of(0.001).reader()(14.2953) == 0.0142953
    assert Scale.of(0.06).reader()(70.2514) == 4.215084
    assert Scale.of(0.01, -273.15).reader()(27315) == 0.0
    assert Scale.of(0.1, 0.2).reader()(1) == 0.3
    assert Scale.of(1, -273.15).write(0.0) == 273.15


@given(st.integers(-(2**31), 2**31 - 1), factors, offsets, st.integers(0, 4))
def test_what_was_read_is_written_back_as_the_same_number(
    number: int, factor: float, offset: float, decimals: int
) -> None:
    scale = Scale.of(factor, offset, decimals, whole=True)
    assert scale.write(scale.reader()(number)) == number


def test_a_written_value_is_rounded_half_away_from_zero_where_the_line_carries_whole_numbers() -> None:
    scale = Scale.of(0.1, whole=True)
    assert [scale.write(value) for value in (4.75, -4.75, 4.74, 5)] == [48, -48, 47, 50]
    assert Scale.of(0.1).write(4.75) == 47.5


def test_of_a_run_every_value_is_scaled_and_words_and_flags_are_left_alone() -> None:
    read = Scale.of(0.1).reader()
    assert read((1, 2, 3)) == (0.1, 0.2, 0.3)
    assert read(True) is True
    assert read(ProgramStatus(65)) is ProgramStatus(65)
    assert read(frozenset({1})) == frozenset({1})
    assert Scale.of(0.1, whole=True).write([0.1, 0.2]) == (1, 2)


def test_true_is_no_number_that_is_scaled_and_where_nothing_is_scaled_it_stays_what_it_is() -> None:
    for value in (True, False, [True]):
        with pytest.raises(InvalidCommand, match="is not a number"):
            Scale.of(0.1).write(value)
    assert Scale.of().write(True) is True


def test_what_cannot_be_written_is_told_as_it_was_said_and_not_only_as_it_is_on_the_line() -> None:
    text = """
        port = "/dev/ttyUSB0"
        [nodes.winder]
        protocol = "modbus"
        address = 17
        points.force = { item = "holding:10", factor = 0.1, unit = "N" }
    """
    point = ConfiguredLine(read(Source("line.toml", text)), outputs=False).point("winder/force")
    assert point.encode is not None
    for value in ([1, 2], 10_000):
        with pytest.raises(InvalidCommand, match=rf"^{re.escape(repr(value))} cannot be sent; on the line, "):
            point.encode(value)


def test_a_factor_of_zero_is_refused_and_what_is_not_finite_is_left_for_the_protocol_to_refuse() -> None:
    with pytest.raises(InvalidCommand):
        Scale.of(0)
    assert Scale.of(0.1).write(float("inf")) == float("inf")


def test_a_value_that_has_no_number_on_the_line_is_too_large() -> None:
    with pytest.raises(InvalidCommand, match=r"^1e\+300 is too large$"):
        Scale.of(1e-300).write(1e300)
    assert Scale.of(1e-300, whole=True).write(1) == 10**300


@pytest.mark.parametrize(
    ("name", "names"),
    [
        ("winder", ["winder"]),
        ("drive4-6", ["drive4", "drive5", "drive6"]),
        ("1-3", ["1", "2", "3"]),
        ("08-11", ["08", "09", "10", "11"]),
        ("axis0-1.position", ["axis0.position", "axis1.position"]),
        ("axis0-1.x2-3", ["axis0.x2", "axis0.x3", "axis1.x2", "axis1.x3"]),
        ("1.17-19", ["1.17", "1.18", "1.19"]),
        ("flag:0-1", ["flag:0", "flag:1"]),
        ("haul-off", ["haul-off"]),
    ],
)
def test_a_range_in_a_name_stands_for_several(name: str, names: list[str]) -> None:
    assert list(expanded(name)) == names


def test_a_name_that_is_known_as_it_stands_is_no_range() -> None:
    assert list(expanded("a1-3", {"a1-3"})) == ["a1-3"]


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("3-1", "the range 3-1 is descending; write 1-3"),
        ("0-5000", "has more than 1000 names"),
        ("0-1000", "the range 0-1000 has more than 1000 names; use a shorter one"),
        (f"{60 * 'x'}1-99y1-99", f"^'{40 * 'x'}' expands to more than 1000 names; use shorter ranges"),
    ],
)
def test_a_range_that_cannot_be_is_refused(name: str, complaint: str) -> None:
    with pytest.raises(InvalidCommand, match=complaint):
        list(expanded(name))
