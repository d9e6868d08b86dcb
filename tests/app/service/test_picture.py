"""What a view knows of a line: put together of what its owner says, in whatever order that comes."""

from __future__ import annotations

from itertools import permutations

import pytest

from busmaster.app.service.picture import Picture
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
    assert [one.name for one in picture.rows] == ["node 1 outputs"]
