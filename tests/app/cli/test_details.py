"""The details of one point as text: each fact from its own field, in its own unit."""

from __future__ import annotations

from typing import Any

import pytest

from busmaster.app.cli.live import details_text
from busmaster.app.service.picture import Frame, Group, Node, Row

LIMIT: dict[str, Any] = {"name": "force", "minimum": None, "maximum": None, "max_step": None, "writable": True}
TIMELINE: dict[str, Any] = {
    "queued": 1.0,
    "started": 1.004,
    "first_byte": 1.009,
    "last_byte": 1.012,
    "attempts": 1,
    "exchanges_ahead": 0,
    "quiet_time_ahead": 0.0,
}
DETAILS: dict[str, Any] = {"command": "read element 10", "hint": "", "low": None, "high": None, "limits": []}


def point(past: list[float | None] | None = None, **known: Any) -> Row:
    """A point that was read every 2 s since second 100, and its fields."""
    row = Row("fast", "5/force", "node 5", "hcp2", 5, "force", **known)
    row.past.extend((100.0 + 2.0 * number, value) for number, value in enumerate(past or []))
    return row


def frame_of(state: str = "ready") -> Frame:
    return Frame("Slitter", "/dev/ttyS0", "9600 8N1", False, 200.0, 60.0, state, 0.5, 0, 0, 1, 1, 1, 0, ())


def facts(
    row: Row,
    node: Node | None = None,
    group: Group | None = None,
    *,
    frame: Frame | None = None,
    width: int = 80,
    **details: Any,
) -> dict[str, str]:
    """The text behind each name. Lines without a name have their first word for it."""
    text = details_text(row, node, group, details and DETAILS | details, frame, width).plain
    return {line[:9].strip(): line[9:] for line in text.splitlines()}


def shown(row: Row, width: int = 80) -> list[str]:
    """The lines below the facts: trend, last values, and the span of all."""
    return details_text(row, None, None, {}, None, width).plain.splitlines()[2:]


def test_past_shows_the_newest_values_and_the_span_of_all() -> None:
    trend, recent, span = shown(point([9.0, None, 8.5, 1.25, 2.0, 3.0, 4.0, 5.0, 6.0], precision=1))
    assert len(trend) == 9
    assert recent == "of late 6.0  5.0  4.0  3.0  2.0  1.2"
    assert span == "9 values in 16.0 s, 1.2 to 9.0"


def test_a_trend_that_is_wider_than_the_terminal_shows_its_newest_part() -> None:
    trend, recent, span = shown(point([100.0, 0.0, 1.0, 2.0]), width=3)
    assert trend == "▁▅█"
    assert recent == "of late 2  1  0"
    assert span == "4 values in 6.0 s, 0 to 100"


def test_a_point_that_never_had_a_number_has_no_past() -> None:
    assert shown(point([None, None])) == []


@pytest.mark.parametrize(
    ("known", "value"),
    [
        ({"value": 1.256, "precision": 2, "unit": "N"}, "1.26 N"),
        ({"value": 3, "quality": "late"}, "3, came late"),
        ({"value": 3, "quality": "stale"}, "3, older than a write to it"),
        ({"value": 3, "quality": "good", "asked": 197.5}, "3, requested 2.5s ago"),
    ],
)
def test_value_has_precision_unit_quality_and_age(known: dict[str, Any], value: str) -> None:
    assert facts(point(**known), frame=frame_of())["value"] == value


@pytest.mark.parametrize(
    ("alarm", "text"),
    [
        ("high", "value beyond its high limit"),
        ("low", "value beyond its low limit"),
        ("set", "the bit is set"),
        ("clear", "the bit is clear"),
    ],
)
def test_alarm_names_its_limit_or_its_bit(alarm: str, text: str) -> None:
    assert facts(point(alarm=alarm))["alarm"] == text
    assert "alarm" not in facts(point())


def test_error_has_the_advice_of_the_owner() -> None:
    row = point(error="no reply within 100 ms")
    assert facts(row)["error"] == "no reply within 100 ms"
    assert facts(row, hint="check the wires")["error"] == "no reply within 100 ms; check the wires"


def test_node_and_group_have_their_counts_and_times_in_milliseconds() -> None:
    node = Node("node 5", "hcp2", 5, "up", requests=30, failed=2, late=7, p50=0.0031, p99=0.0124, kind="microflex")
    group = Group("fast", 0.25)
    found = facts(point(), node, group, frame=frame_of())
    assert found["node"] == "microflex 5, up: 30 requests, 2 failed, 7 late, p50 3.1, p99 12.4 ms"
    assert found["group"] == "fast, every 250 ms"
    paused = Group("fast", 0.25, paused=True)
    found = facts(point(), Node("node 5", "hcp2", 5, "up"), paused, frame=frame_of("offline"))
    assert found["node"].startswith("hcp2 5, offline: ")
    assert found["group"] == "fast, every 250 ms, paused"


def test_a_point_that_is_gone_shows_why_instead_of_its_limits() -> None:
    found = facts(point(), gone="no such point")
    assert found[""] == "no such point"
    assert "limits" not in found


@pytest.mark.parametrize(
    ("details", "text"),
    [
        ({}, "written any value"),
        ({"limits": [LIMIT | {"minimum": 0, "maximum": 7}]}, "written from 0 to 7"),
        ({"limits": [LIMIT | {"max_step": 2.5}]}, "written in steps of at most 2.5"),
        ({"limits": [LIMIT | {"minimum": -1}, LIMIT | {"maximum": 9}]}, "written from -1; to 9"),
        ({"limits": [LIMIT | {"writable": False, "maximum": 7}]}, "may not be written"),
        ({"limits": [LIMIT, LIMIT | {"writable": False}], "high": 5}, "may not be written; alarm high 5"),
        ({"low": 0, "high": 5.5}, "written any value; alarm low 0, high 5.5"),
        ({"low": -2.5}, "written any value; alarm low -2.5"),
    ],
)
def test_limits_are_those_of_all_its_items_with_the_alarms(details: dict[str, Any], text: str) -> None:
    found = facts(point(writable=True), **(details or {"hint": ""}))
    assert found["limits"] == text
    assert found["asks"] == "read element 10"


def test_a_point_without_writes_is_read_only() -> None:
    assert facts(point(), high=5)["limits"] == "it is read-only; alarm high 5"


@pytest.mark.parametrize(
    ("times", "text"),
    [
        ({}, "waited 4.0 ms, reply after 5.0 ms, whole after 8.0 ms"),
        (
            {"exchanges_ahead": 3, "quiet_time_ahead": 0.0025, "first_byte": None, "last_byte": None},
            "waited 4.0 ms behind 3, 2.5 ms of it while the line resynchronised, no reply",
        ),
        ({"last_byte": None}, "waited 4.0 ms, reply after 5.0 ms, no reply"),
        ({"first_byte": None, "last_byte": None, "attempts": 3}, "waited 4.0 ms, no reply, 3 attempts"),
        ({"started": None, "attempts": 0}, "not sent"),
        ({"started": None, "attempts": 3}, "3 attempts, no reply"),
    ],
)
def test_exchange_shows_why_it_took_as_long_as_it_did(times: dict[str, Any], text: str) -> None:
    assert facts(point(), timeline=TIMELINE | times)["exchange"] == text


def test_without_a_picture_of_a_new_owner_neither_age_nor_state_of_the_line_is_shown() -> None:
    found = facts(point(value=3, asked=197.5), Node("node 5", "hcp2", 5, "up"))
    assert found["value"] == "3"
    assert found["node"].startswith("hcp2 5, up: ")


@pytest.mark.parametrize("name", ["command", "hint", "gone"])
def test_no_text_of_the_owner_reaches_the_terminal_as_a_command(name: str) -> None:
    text = details_text(point(error="no reply"), None, None, DETAILS | {name: "\x1b[2J\x9b31m"}, None, 80).plain
    assert text.replace("\n", "").isprintable()
    assert r"\u001b[2J" in text
