"""Values that the replies of the last poll cycle contain, for points that no group reads by itself."""

from __future__ import annotations

from typing import Any

import pytest

from busmaster.bus.answers import Answer, composed
from busmaster.bus.points import Point
from busmaster.contract.exchange import Command
from busmaster.protocols.mentor.codec import PROFILE, Read, ReadRun, Write

NODE: Any = "node 1"


def batch(first: int, *values: float, started: float = 1.0) -> Answer:
    """The reply to a run of parameters, each of which is a point of the group."""
    points: list[Point[Any]] = [Point(NODE, f"1.{first + i}", Read(1, first + i)) for i in range(len(values))]
    return Answer(
        NODE, ReadRun(1, first, len(values)), [(point, i) for i, point in enumerate(points)], list(values), started
    )


def test_each_point_of_a_batch_has_its_own_value() -> None:
    answer = batch(17, 5, 6, 7)
    assert [answer.found(Read(1, number)) for number in (17, 18, 19, 20)] == [[5], [6], [7], []]


def test_a_point_that_an_exchange_reads_alone_has_its_whole_value() -> None:
    point: Point[Any] = Point(NODE, "1.17", Read(1, 17))
    assert Answer(NODE, Read(1, 17), [(point, None)], 5, 1.0).found(Read(1, 17)) == [5]


@pytest.mark.parametrize(
    ("command", "value"),
    [(Write(1, 18, 9), [6]), (Write(1, 20, 9), [])],
)
def test_the_value_before_a_write_is_that_of_the_place_that_it_changes(command: Command[Any], value: list[Any]) -> None:
    assert composed(command, [batch(17, 5, 6, 7)], PROFILE) == value


def test_a_later_reply_replaces_the_value_of_an_earlier_one() -> None:
    assert composed(Write(1, 18, 9), [batch(17, 5, 6), batch(18, 8, 9, started=2.0)], PROFILE) == [8]
