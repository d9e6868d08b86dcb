"""Which values a write makes stale, as docs/service.md describes the message `touched`."""

from __future__ import annotations

from typing import Any

from busmaster.app.service.touches import Touches

AT = 100.0
POINTS = [("hcp2", 5, "1"), ("hcp2", 5, "2"), ("hcp2", 6, "1"), ("msc", 5, "1")]


def stale_after(**message: Any) -> list[tuple[str, int, str]]:
    """Return the points whose values, requested just before, are stale after this message."""
    touches = Touches()
    touches.note({"when": AT, **message})
    assert not any(touches.is_stale(*point, AT) for point in POINTS), "a value requested at that time or later is good"
    return [point for point in POINTS if touches.is_stale(*point, AT - 0.001)]


def test_named_points_are_stale_and_others_of_the_node_are_not() -> None:
    assert stale_after(protocol="hcp2", address=5, items=["2"], all=False) == [("hcp2", 5, "2")]
    assert stale_after(protocol="hcp2", address=5, items=[], all=False) == []
    assert stale_after(protocol="hcp2", address=5, items=["1", "2"], all=False) == [("hcp2", 5, "1"), ("hcp2", 5, "2")]


def test_without_names_all_points_of_the_node_are_stale() -> None:
    assert stale_after(protocol="hcp2", address=5, items=None, all=False) == [("hcp2", 5, "1"), ("hcp2", 5, "2")]
    assert stale_after(protocol="hcp2", address=5) == [("hcp2", 5, "1"), ("hcp2", 5, "2")]


def test_a_write_to_all_nodes_makes_every_point_stale() -> None:
    assert stale_after(protocol="hcp2", address=0, items=None, all=True) == POINTS


def test_of_several_writes_the_last_one_counts() -> None:
    touches = Touches()
    touches.note({"when": AT, "all": True})
    touches.note({"when": AT + 1, "protocol": "hcp2", "address": 5})
    touches.note({"when": AT + 2, "protocol": "hcp2", "address": 5, "items": ["1"]})
    touches.note({"when": AT + 3, "protocol": "hcp2", "address": 5, "items": ["1"]})
    since = [next(n for n in range(5) if not touches.is_stale(*point, AT + n)) for point in POINTS]
    assert since == [3, 1, 0, 0]
