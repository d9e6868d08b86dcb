"""What a view knows of a line: put together of what its owner says, in whatever order that comes."""

from __future__ import annotations

from itertools import permutations
from typing import Any

import pytest

from busmaster.app.service.picture import KEPT_VALUES, Picture, matching
from tests.app.service.pictures import FRAME, GROUP, node, row, tell


@pytest.mark.parametrize("order", list(permutations(("rows", "values", "frame"))))
def test_a_new_set_of_points_may_come_in_any_order(order: tuple[str, ...]) -> None:
    picture = tell(Picture(), row(1, value=5), row(2, value=6))
    point, held = row(3, value=7)
    said = {
        "rows": {"set": 2, "first": 0, "rows": [point]},
        "values": {"set": 2, "first": 0, "values": [held]},
        "frame": {**FRAME, "set": 2, "groups": 1, "nodes": 1, "points": 1},
    }
    for method in order:
        picture.receive(method, said[method])
    assert [(one.name, one.value) for one in picture.rows] == [("node 3 outputs", 7)]


def test_what_is_said_of_an_earlier_set_is_not_taken_for_this_one() -> None:
    picture = tell(Picture(), row(1, value=5), set=2)
    point, held = row(2, value=6)
    picture.receive("rows", {"set": 1, "first": 0, "rows": [point]})
    picture.receive("values", {"set": 1, "first": 0, "values": [held]})
    assert [(one.name, one.value) for one in picture.rows] == [("node 1 outputs", 5)]


def test_a_point_that_fails_keeps_its_last_good_value_and_a_gap_in_its_past() -> None:
    picture = tell(Picture(), row(value=5, asked=1.0))
    tell(picture, row(value=None, asked=2.0, error="no reply", quality="bad"))
    [known] = picture.rows
    assert (known.value, known.asked, known.error) == (5, 1.0, "no reply")
    assert list(known.past) == [(1.0, 5), (2.0, None)]


def test_a_cycle_that_is_told_twice_is_one_value() -> None:
    picture = tell(tell(Picture(), row(value=5, asked=1.0)), row(value=5, asked=1.0))
    assert len(picture.rows[0].past) == 1


def test_a_point_that_stays_in_a_new_set_goes_on_unless_its_unit_is_another() -> None:
    picture = tell(Picture(), row(1, value=5, asked=1.0, unit="N"), row(2, value=6, asked=1.0, unit="N"))
    tell(picture, row(2, value=7, asked=2.0, unit="kN"), row(1, value=8, asked=2.0, unit="N"), set=2)
    assert [(one.name, len(one.past)) for one in picture.rows] == [("node 2 outputs", 1), ("node 1 outputs", 2)]


def test_two_points_of_one_name_in_a_group_are_two_rows() -> None:
    picture = tell(Picture(), row(value=5), row(value=6))
    assert len({one.identity for one in picture.rows}) == 2


def test_groups_and_nodes_that_are_gone_are_not_shown() -> None:
    picture = tell(Picture(), row(1), row(2), groups=(GROUP, {**GROUP, "name": "slow"}))
    picture.receive("frame", {**FRAME, "groups": 1, "nodes": 1, "points": 2})
    assert [group.name for group in picture.groups] == ["axes"]
    assert list(picture.nodes) == [("hcp2", 1)]


def test_what_a_later_owner_says_besides_is_passed_over() -> None:
    picture = tell(Picture(), row(1, colour="red"), nodes=(node(1, mood="calm"),), weather="fine")
    picture.receive("forecast", {"set": 9})
    picture.receive("values", {"set": 1, "first": 0, "values": [[7, "good", 1061.0, "", "", "mood"]]})
    assert [(one.name, one.value) for one in picture.rows] == [("node 1 outputs", 7)]


def test_a_point_that_stays_keeps_what_is_known_of_it_until_its_new_value_arrives() -> None:
    picture = tell(Picture(), row(1, value=5, asked=1.0), row(2, value=6, asked=1.0, alarm="high"))
    held = [
        row(1, value=None, asked=2.0, error="no reply", quality="bad")[1],
        row(2, value=6, asked=2.0, alarm="high")[1],
    ]
    picture.receive("values", {"set": 1, "first": 0, "values": held})
    [first, second] = [row(1)[0], row(2)[0]]
    picture.receive("rows", {"set": 2, "first": 0, "rows": [second, first]})
    picture.receive("values", {"set": 2, "first": 0, "values": [None, None]})
    known = [(one.name, one.value, one.quality, one.asked, one.error, one.alarm) for one in picture.rows]
    assert known == [
        ("node 2 outputs", 6, "good", 2.0, "", "high"),
        ("node 1 outputs", 5, "bad", 1.0, "no reply", ""),
    ]


@pytest.mark.parametrize("other", [{"address": 3}, {"protocol": "msc"}])
def test_a_point_of_the_same_name_at_another_node_begins_anew(other: dict[str, Any]) -> None:
    picture = tell(Picture(), row(1, value=5, asked=1.0))
    point, _ = row(1, **other)
    picture.receive("rows", {"set": 2, "first": 0, "rows": [point]})
    assert [(one.value, len(one.past)) for one in picture.rows] == [(None, 0)]


def test_a_cycle_with_the_same_value_is_one_more_in_the_past_and_texts_and_errors_are_gaps() -> None:
    picture = tell(Picture(), row(value=5, asked=1.0))
    for asked, value, error in ((2.0, 5, ""), (3.0, "on", ""), (4.0, 7, "no reply"), (5.0, 6.5, "")):
        _, held = row(value=value, asked=asked, error=error)
        picture.receive("values", {"set": 1, "first": 0, "values": [held]})
    assert list(picture.rows[0].past) == [(1.0, 5), (2.0, 5), (3.0, None), (4.0, None), (5.0, 6.5)]


def test_an_alarm_and_an_error_that_are_over_are_not_shown_any_more() -> None:
    picture = tell(Picture(), row(asked=1.0, alarm="high"))
    assert picture.rows[0].alarm == "high"
    picture.receive("values", {"set": 1, "first": 0, "values": [row(asked=2.0, error="no reply", quality="bad")[1]]})
    assert (picture.rows[0].alarm, picture.rows[0].error, picture.rows[0].quality) == ("", "no reply", "bad")
    picture.receive("values", {"set": 1, "first": 0, "values": [row(asked=3.0)[1]]})
    assert (picture.rows[0].error, picture.rows[0].quality) == ("", "good")


def test_the_past_of_a_point_is_bounded_and_has_its_latest_values() -> None:
    picture = tell(Picture(), row(value=0, asked=0.0))
    for number in range(1, KEPT_VALUES + 5):
        picture.receive("values", {"set": 1, "first": 0, "values": [row(value=number, asked=float(number))[1]]})
    assert list(picture.rows[0].past) == [(float(number), number) for number in range(5, KEPT_VALUES + 5)]


def test_no_point_is_shown_when_the_last_group_is_gone() -> None:
    """Of a set without points, the owner sends a frame and nothing else."""
    picture = tell(Picture(), row(1), row(2))
    picture.receive("frame", {**FRAME, "set": 2, "groups": 0, "nodes": 2, "points": 0})
    assert (picture.rows, picture.groups) == ([], [])
    tell(picture, row(2, value=7), set=3)
    assert [(one.name, one.value) for one in picture.rows] == [("node 2 outputs", 7)]


def test_parts_that_arrive_in_another_order_are_shown_in_the_order_of_the_line() -> None:
    picture = Picture()
    for first in (2, 0):
        points = [row(first + number)[0] for number in (1, 2)]
        picture.receive("rows", {"set": 1, "first": first, "rows": points})
        picture.receive("groups", {"first": first, "groups": [{**GROUP, "name": f"group {first + n}"} for n in (1, 2)]})
        picture.receive("nodes", {"first": first, "nodes": [node(first + number) for number in (1, 2)]})
    assert (picture.groups, picture.nodes) == ([], {}), "without a frame their number is not known"
    picture.receive("frame", {**FRAME, "groups": 4, "nodes": 4, "points": 4})
    assert [one.address for one in picture.rows] == [1, 2, 3, 4]
    assert [group.name for group in picture.groups] == ["group 1", "group 2", "group 3", "group 4"]
    assert [address for _, address in picture.nodes] == [1, 2, 3, 4]


def test_points_of_one_name_are_told_apart_though_they_are_in_different_parts() -> None:
    picture = Picture()
    for number, asked in ((1, 1.0), (2, 2.0)):
        for first, value in ((0, 5), (1, 6)):
            point, held = row(value=value, asked=asked)
            picture.receive("rows", {"set": number, "first": first, "rows": [point]})
            picture.receive("values", {"set": number, "first": first, "values": [held]})
    assert [[value for _, value in one.past] for one in picture.rows] == [[5, 5], [6, 6]]


def test_a_write_makes_all_values_of_its_place_stale_that_were_requested_before_it() -> None:
    picture = tell(
        Picture(),
        row(1, asked=1.0),
        row(1, "axis0.position", asked=1.0, quality="late"),
        row(1, "other", asked=3.0),
        row(1, "gone", asked=1.0, quality="bad", error="no reply"),
        row(2, asked=1.0),
    )
    picture.receive("touched", {"protocol": "hcp2", "address": 1, "when": 2.0, "items": None, "all": False})
    expected = ["stale", "stale", "good", "bad", "good"]
    assert [one.quality for one in picture.rows] == expected
    tell(picture, row(1, asked=1.5), row(1, "axis0.position", asked=2.5))
    assert [one.quality for one in picture.rows] == ["stale", "good"], "the first was read before the write"


def test_when_the_owner_is_gone_no_value_is_good_and_no_node_is_up() -> None:
    picture = tell(Picture(), row(1, value=5), row(2, value=6), since=1000.0)
    picture.receive("nodes", {"first": 2, "nodes": [node(3)]})
    picture.receive("frame", {**FRAME, "groups": 1, "nodes": 3, "points": 2, "since": 1000.0})
    picture.lose("the owner has ended")
    assert [(one.value, one.quality, one.error) for one in picture.rows] == [
        (5, "bad", "the owner has ended"),
        (6, "bad", "the owner has ended"),
    ]
    assert [one.health for one in picture.nodes.values()] == ["offline"] * 3
    assert picture.frame is not None
    assert (picture.frame.state, picture.frame.why, picture.frame.since) == ("offline", "the owner has ended", None)


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("", [1, 2, 9]),
        ("NODE position", [1, 2, 9]),
        ("Winder", [2]),
        ("2/axis0", [2]),
        ("slow", [9]),
        ("kn", [1]),
        ("suspect", [2]),
        ("no REPLY", [9]),
        ("up position", [1]),
        ("winder slow", []),
    ],
)
def test_rows_are_found_by_words_of_all_that_is_shown_of_them(words: str, found: list[int]) -> None:
    winder, held = row(2, "axis0.position")
    rows = (
        row(1, "axis0.Position", unit="kN"),
        (winder | {"node": "node Winder"}, held),
        row(9, "axis0.position", group="slow", error="No reply", quality="bad"),
    )
    picture = tell(Picture(), *rows, nodes=(node(1), node(2, "suspect"), node(9, "down")))
    assert [one.address for one in matching(picture.rows, picture.nodes, words)] == found
