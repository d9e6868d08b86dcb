"""Logs speak on state changes only, rate-limited (R14)."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import cast

import pytest

from busmaster.arbiter.events import (
    CameUnexpected,
    LineChange,
    LineChanged,
    MaxReplyDelayLowered,
    MaxReplyDelayRaised,
    NodeChanged,
    PortFailed,
    RepliesLate,
)
from busmaster.arbiter.health import Health, NodeRecord
from busmaster.bus.alarms import AlarmChanged, BusEvent, Side
from busmaster.bus.logbook import PAUSE, Logbook
from tests.app.outputs.cycles import point
from tests.arbiter.bench import Bench


@pytest.fixture
def lines(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.INFO, "busmaster")
    return caplog


def test_r14_a_node_that_goes_down_is_a_warning_with_its_port(lines: pytest.LogCaptureFixture) -> None:
    Logbook("/dev/line").note(NodeChanged(Bench().node(5), Health.SUSPECT, Health.DOWN, False), 0.0)
    assert [(r.levelname, r.message) for r in lines.records] == [("WARNING", "/dev/line: node 5 is down (was suspect)")]


def test_r14_what_happens_again_and_again_is_one_line_with_a_count(lines: pytest.LogCaptureFixture) -> None:
    logbook = Logbook("line")
    for second in range(25):
        logbook.note(LineChanged(LineChange.NOISY), float(second))
    assert lines.messages[1:] == ["line: the line is noisy (9 more since the last such line)"] * 2
    assert len(lines.messages) == 3


def test_r14_each_node_is_limited_by_itself(lines: pytest.LogCaptureFixture) -> None:
    logbook, bench = Logbook("line"), Bench()
    for address in (1, 2, 3):
        logbook.note(NodeChanged(bench.node(address), Health.UP, Health.DOWN, False), 0.0)
    assert len(lines.messages) == 3


def test_r14_unexpected_bytes_are_counted_and_not_logged_but_a_collision_is(lines: pytest.LogCaptureFixture) -> None:
    logbook = Logbook("line")
    logbook.note(CameUnexpected(b"\x15"), 0.0)
    logbook.note(CameUnexpected(b"\x07\x31", collision=True), 0.0)
    assert lines.messages == ["line: the echo differs from the bytes sent: a collision (07 31)"]


def test_r14_a_raised_max_reply_delay_names_node_and_times(lines: pytest.LogCaptureFixture) -> None:
    Logbook("line").note(MaxReplyDelayRaised(Bench().node(3), 0.14, 0.224), PAUSE)
    assert lines.messages == ["line: node 3 replied after 140 ms; maximum reply delay raised to 224 ms"]


def test_r14_a_max_reply_delay_that_comes_down_again_names_node_and_time(lines: pytest.LogCaptureFixture) -> None:
    Logbook("line").note(MaxReplyDelayLowered(Bench().node(3), 0.15), PAUSE)
    assert [record.levelname for record in lines.records] == ["INFO"]
    assert lines.messages == ["line: node 3 has replied in time for an hour; maximum reply delay lowered to 150 ms"]


def test_r13_a_failed_attempt_is_logged_with_what_to_try_and_a_bug_with_where(lines: pytest.LogCaptureFixture) -> None:
    logbook = Logbook("line")
    logbook.note(PortFailed("line is in use by gpsd", "end that first"), 0.0)
    logbook.note(PortFailed("line is in use by gpsd", "end that first"), 1.0)
    logbook.note(PortFailed("cannot open line: ValueError: odd", bug=ValueError("odd")), 2.0)
    assert lines.messages == [
        "line: cannot connect: line is in use by gpsd; end that first",
        "line: cannot connect: cannot open line: ValueError: odd",
    ]
    assert [record.exc_info is None for record in lines.records] == [True, False]


@pytest.mark.parametrize(
    ("event", "level", "text"),
    [
        (lambda node: NodeChanged(node, Health.DOWN, Health.UP, True), "INFO", "node 3 is up (was down)"),
        (lambda node: LineChanged(LineChange.DOWN, "unplugged"), "WARNING", "the line is down: unplugged"),
        (lambda node: LineChanged(LineChange.NOISY), "WARNING", "the line is noisy"),
        (lambda node: LineChanged(LineChange.UP), "INFO", "the line is up"),
        (
            lambda node: RepliesLate(node, 0.14, 0.1),
            "WARNING",
            "node 3 replies after 140 ms, later than its reply window of 100 ms; its values are marked late",
        ),
        (lambda node: PortFailed("no permission", ""), "WARNING", "cannot connect: no permission"),
    ],
)
def test_r14_the_level_of_a_change_shows_whether_it_is_a_fault(
    lines: pytest.LogCaptureFixture, event: Callable[[NodeRecord], BusEvent], level: str, text: str
) -> None:
    Logbook("line").note(event(Bench().node(3)), 0.0)
    assert [(record.levelname, record.message) for record in lines.records] == [(level, f"line: {text}")]


def test_r14_a_rounded_value_is_logged_once_for_each_parameter(lines: pytest.LogCaptureFixture) -> None:
    logbook, bench = Logbook("line"), Bench()
    first, other = bench.node(3), bench.node(4)
    for node, what in ((first, "1.17 = 5.5"), (first, "1.17 = 6.5"), (first, "1.18 = 5.5"), (other, "1.17 = 5.5")):
        logbook.rounded(node, what, 0.0)
    ending = "; round it, or declare the decimals of the parameter"
    assert lines.messages == [
        f"line: node 3: 1.17 = 5.5{ending}",
        f"line: node 3: 1.18 = 5.5{ending}",
        f"line: node 4: 1.17 = 5.5{ending}",
    ]


def test_r14_exchanges_that_cannot_be_chosen_are_logged_with_group_and_error(lines: pytest.LogCaptureFixture) -> None:
    Logbook("line").failed_choice("fast", ValueError("odd"))
    [record] = lines.records
    assert (record.levelname, record.message) == (
        "ERROR",
        "line: the exchanges of poll group 'fast' could not be chosen",
    )
    assert record.exc_info is not None


def test_r14_each_limit_of_a_point_and_each_end_of_its_alarm_is_logged_by_itself(
    lines: pytest.LogCaptureFixture,
) -> None:
    logbook, speed = Logbook("line"), point("1")
    for limit, bound, value, active in (
        ("high", 20.0, 25.0, True),
        ("high", 20.0, 5.0, False),
        ("low", 10.0, 5.0, True),
        ("low", 10.0, 15.0, False),
    ):
        logbook.note(AlarmChanged(speed, cast("Side", limit), bound, value, active), 0.0)
    assert [(record.levelname, record.message) for record in lines.records] == [
        ("WARNING", "line: 5/1 = 25 is above its high of 20"),
        ("INFO", "line: 5/1 is back at 5, was above its high of 20"),
        ("WARNING", "line: 5/1 = 5 is below its low of 10"),
        ("INFO", "line: 5/1 is back at 15, was below its low of 10"),
    ]


def test_r14_each_node_state_and_point_is_limited_by_itself(lines: pytest.LogCaptureFixture) -> None:
    logbook, bench = Logbook("line"), Bench()
    nodes = [bench.node(address) for address in (1, 2)]
    events: list[BusEvent] = []
    for node in nodes:
        events += [
            NodeChanged(node, Health.UP, Health.DOWN, False),
            NodeChanged(node, Health.DOWN, Health.UP, True),
            MaxReplyDelayRaised(node, 0.14, 0.224),
            MaxReplyDelayLowered(node, 0.15),
            RepliesLate(node, 0.14, 0.1),
        ]
    events += [LineChanged(change) for change in (LineChange.DOWN, LineChange.UP, LineChange.NOISY)]
    events += [AlarmChanged(point(item), "high", 20.0, 25.0, True) for item in ("1", "2")]
    for event in events:
        logbook.note(event, 0.0)
    assert len(lines.messages) == len(set(lines.messages)) == len(events)
    for event in events:
        logbook.note(event, 1.0)
    assert len(lines.messages) == len(events)
