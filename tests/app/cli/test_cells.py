"""The cells of the screen: widths, trends, ages, and numbers that never lose their magnitude."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rich.text import Text

from busmaster.app.cli.cells import (
    age_text,
    clock_text,
    column_widths,
    fit,
    fit_value,
    gauge_line,
    group_line,
    header_line,
    row_line,
    sparkline,
    title_line,
)
from busmaster.app.service.picture import Frame, Group, Node, Row


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
    assert [fit_value("12345,60", width) for width in (8, 7, 6)] == ["12345,60", "12345,…", "1e4,…"]


@pytest.mark.parametrize("width", range(60, 140))
def test_the_columns_fill_a_terminal_as_far_as_they_may_grow(width: int) -> None:
    widths = column_widths(width)
    total = sum(widths.values()) + len(widths) - 1
    assert total <= width
    assert ("TREND" in widths) == (width >= 75)
    assert total == min(width, 122)


@pytest.mark.parametrize(
    ("width", "wanted"),
    [
        (60, {"NODE": 9, "ITEM": 14, "VALUE": 11}),
        (70, {"NODE": 9, "ITEM": 24, "VALUE": 11}),
        (74, {"NODE": 11, "ITEM": 26, "VALUE": 11}),
        (75, {"NODE": 9, "ITEM": 14, "VALUE": 11, "TREND": 8}),
        (98, {"NODE": 16, "ITEM": 26, "VALUE": 15, "TREND": 8}),
        (200, {"NODE": 16, "ITEM": 26, "VALUE": 19, "TREND": 28}),
    ],
)
def test_items_grow_first_then_nodes_values_and_trends(width: int, wanted: dict[str, int]) -> None:
    found = column_widths(width)
    fixed = {"": 1, "UNIT": 5, "AGE": 5, "HEALTH": 9} | ({"P50ms": 5} if "TREND" in wanted else {})
    assert found == wanted | fixed
    assert list(found)[:5] == ["NODE", "ITEM", "", "VALUE", "UNIT"]


def test_a_trend_spans_its_own_lowest_and_highest_and_shows_gaps() -> None:
    assert sparkline([0.0, None, 1.0]) == "▁ █"
    assert sparkline([5.0, 5.0]) == "▁▁"
    assert sparkline([None, None]) == ""
    assert sparkline([1.0, math.nan, 2.0]) == "▁ █"
    assert sparkline([0.0, 0.0]) == "▁▁"


def test_a_ripple_of_negative_numbers_is_no_trend_either() -> None:
    assert sparkline([-100.0, -99.9]) == sparkline([100.0, 100.1]) == "▁▁"


def test_ages_and_clocks_fit_their_columns() -> None:
    ages = (None, 0.04, 9.94, 9.96, 12.3, 599, 6000, 360_000)
    assert [age_text(age) for age in ages] == ["-", "0.0s", "9.9s", "10s", "12s", "599s", "100m", "100h"]
    bounds = (9.949, 9.95, 599.4, 600, 35_999, 36_000)
    assert [age_text(age) for age in bounds] == ["9.9s", "10s", "599s", "10m", "600m", "10h"]
    assert clock_text(3661.9) == "1:01:01"
    assert age_text(-0.2) == "0.0s", "a clock that was read before the request"


def test_a_text_as_wide_as_its_column_is_not_cut() -> None:
    assert [fit("abcd", width) for width in (5, 4, 3)] == ["abcd", "abcd", "ab…"]


# the lines of the head

FRAME = Frame("Slitter", "/dev/ttyS0", "9600 8N1", False, 200.0, 61.0, "ready", 0.5, 2, 0, 1, 1, 1, 0, ())
GROUP = Group("fast", 0.25, cycles=61, missed=1, achieved=0.2512, jitter=0.0123)


def test_the_title_has_port_and_settings_and_why_there_is_no_news_in_place_of_the_clock() -> None:
    assert title_line(FRAME, 50).plain == f" {'Slitter  /dev/ttyS0  9600 8N1':<40} 0:01:01 "
    assert title_line(replace(FRAME, settings=""), 40).plain.startswith(" Slitter  /dev/ttyS0   ")
    silent = title_line(FRAME, 50, "no data for 3 s").plain
    assert silent.endswith(" no data for 3 s ")
    assert "0:01:01" not in silent
    assert len(silent) == 50


@pytest.mark.parametrize(
    ("width", "utilisation", "gauge"),
    [
        (79, 0.5, "━━━━━─────  50% busy"),
        (80, 0.5, "━━━━━━━━━━──────────  50% busy"),
        (80, 1.7, "━━━━━━━━━━━━━━━━━━━━ 170% busy"),
        (60, 0.0, "──────────   0% busy"),
    ],
)
def test_the_gauge_fills_with_the_load_and_never_beyond_its_width(width: int, utilisation: float, gauge: str) -> None:
    assert gauge_line(replace(FRAME, utilisation=utilisation), width).plain == f" line {gauge}  ready  2 queued"


def test_the_gauge_line_counts_disconnects_and_names_a_line_that_takes_no_writes() -> None:
    assert gauge_line(replace(FRAME, losses=1), 120).plain.endswith("2 queued  1 disconnect")
    both = gauge_line(replace(FRAME, losses=2, read_only=True), 120)
    assert both.plain.endswith("2 queued  2 disconnects  read-only")


def styles(line: Text) -> dict[str, str]:
    """The style of each part of a line that has one."""
    return {line.plain[span.start : span.end].strip(): str(span.style) for span in line.spans}


def test_a_load_that_leaves_no_room_and_a_lost_line_stand_out() -> None:
    assert "50% busy" not in styles(gauge_line(FRAME, 80))
    assert styles(gauge_line(replace(FRAME, utilisation=0.91), 80))["91% busy"] == "bold magenta"
    assert "90% busy" not in styles(gauge_line(replace(FRAME, utilisation=0.9), 80))
    assert styles(gauge_line(replace(FRAME, state="offline"), 80))["offline"] == "bold reverse"


def test_the_line_of_a_group_has_its_times_in_milliseconds() -> None:
    assert group_line(GROUP, 120).plain == " fast every 250 ms  missed 1  cycle 61, achieved 251.2, late p99 12.3"
    assert group_line(replace(GROUP, achieved=0.0), 120).plain == " fast every 250 ms  missed 1  cycle 61"
    assert group_line(replace(GROUP, paused=True), 120).plain.startswith(" fast  paused  every 250 ms")
    assert len(group_line(GROUP, 30)) == 30


def test_missed_cycles_a_paused_group_and_silence_stand_out() -> None:
    assert styles(group_line(GROUP, 120))["missed 1"] == "bold"
    assert "missed 0" not in styles(group_line(replace(GROUP, missed=0), 120))
    assert styles(group_line(replace(GROUP, paused=True), 120))["paused"] == "bold reverse"
    assert styles(title_line(FRAME, 80, "no data for 3 s"))["no data for 3 s"] == "bold reverse"
    assert "0:01:01" not in styles(title_line(FRAME, 80))


# the lines of the table


def point(**known: object) -> Row:
    row = Row("fast", "5/force", "node 5", "hcp2", 5, "force", value=1.5, asked=199.0)
    for name, value in known.items():
        setattr(row, name, value)
    return row


NODE = Node("winder", "hcp2", 5, "up", p50=0.0031, p99=0.0124)


def cells(row: Row, node: Node | None = NODE, group: Group | None = GROUP, frame: Frame = FRAME) -> dict[str, str]:
    """What stands in the columns of a wide terminal."""
    widths = column_widths(120)
    line = row_line(row, node, group, frame, widths).plain
    found, place = {}, 0
    for name, width in widths.items():
        found[name] = line[place : place + width].strip()
        place += width + 1
    return found


def test_each_cell_has_its_own_fact() -> None:
    row = point(unit="% of rated current", value=1.256, precision=2)
    row.past.extend((float(number), float(number % 2)) for number in range(40))
    row.past.extend((float(number), 5.0) for number in range(40, 80))
    assert cells(row) == {
        "NODE": "winder",
        "ITEM": "force",
        "": "",
        "VALUE": "1.26",
        "UNIT": "%",
        "TREND": "▁" * column_widths(120)["TREND"],  # of the newest values
        "AGE": "1.0s",
        "P50ms": "3.1",
        "HEALTH": "up",
    }


def test_a_node_that_is_not_known_yet_is_named_as_its_point_does() -> None:
    found = cells(point(asked=None), None, None)
    assert (found["NODE"], found["HEALTH"], found["P50ms"], found["AGE"]) == ("node 5", "", "-", "-")
    assert cells(point(), replace(NODE, p50=0.0))["P50ms"] == "-"


def test_no_node_of_a_lost_line_is_up_and_the_age_of_a_paused_group_rests() -> None:
    for node in (NODE, None):
        assert cells(point(), node, frame=replace(FRAME, state="offline"))["HEALTH"] == "offline"
    assert cells(point(), group=replace(GROUP, paused=True))["AGE"] == "rests"


@pytest.mark.parametrize(
    ("known", "mark"),
    [
        ({"error": "no reply", "alarm": "high", "quality": "bad"}, "!"),
        ({"alarm": "low", "quality": "late"}, "↓"),
        ({"alarm": "high", "quality": "good"}, "↑"),
        ({"alarm": "set", "quality": "good"}, "↑"),
        ({"alarm": "clear", "quality": "good"}, "↓"),
        ({"quality": "late"}, "~"),
        ({"quality": "stale"}, "?"),
        ({"quality": "good"}, ""),
    ],
)
def test_of_an_error_an_alarm_and_a_quality_the_first_has_the_mark(known: dict[str, object], mark: str) -> None:
    assert cells(point(**known))[""] == mark


@pytest.mark.parametrize(("age", "style"), [(1.44, None), (1.56, "bold magenta")])
def test_a_value_older_than_three_periods_of_its_group_stands_out(age: float, style: str | None) -> None:
    line = row_line(point(asked=200.0 - age), NODE, replace(GROUP, period=0.5), FRAME, column_widths(120))
    assert styles(line).get(f"{age:.1f}s") == style


def test_the_value_of_a_paused_group_is_never_too_old() -> None:
    line = row_line(point(asked=1.0), NODE, replace(GROUP, paused=True), FRAME, column_widths(120))
    assert "rests" in line.plain
    assert "rests" not in styles(line)


def test_states_of_health_and_the_selected_row_stand_out() -> None:
    widths = column_widths(120)
    for health, style in (("down", "bold reverse"), ("suspended", "magenta"), ("suspect", "bold magenta")):
        assert styles(row_line(point(), replace(NODE, health=health), GROUP, FRAME, widths))[health] == style
    assert "reverse" in {str(span.style) for span in row_line(point(), NODE, GROUP, FRAME, widths, True).spans}
    assert "reverse" not in {str(span.style) for span in row_line(point(), NODE, GROUP, FRAME, widths).spans}


def test_names_of_columns_stand_where_their_cells_do() -> None:
    widths = column_widths(120)
    header = header_line(widths).plain
    row = row_line(point(), NODE, GROUP, FRAME, widths).plain
    for name, cell in (("VALUE", "1.5"), ("AGE", "1.0s"), ("P50ms", "3.1")):
        assert header.index(name) + len(name) == row.index(cell) + len(cell)
    for name, cell in (("NODE", "winder"), ("ITEM", "force"), ("HEALTH", "up")):
        assert header.index(name) == row.index(cell)
