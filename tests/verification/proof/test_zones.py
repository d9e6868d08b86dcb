"""What is done to zones keeps to the instants that are in them: held against every point of a small grid."""

from __future__ import annotations

from itertools import product
from random import Random

from tests.verification.proof.zones import FREE, Zone, at_most, extended, less_than, origin, tighten, united

SIDE = 3
POINTS = [(0.0, x, y) for x, y in product([half / 2 for half in range(-2 * SIDE - 2, 2 * SIDE + 3)], repeat=2)]
"""Of two instants beside x_0, at whole and half ticks, a little beyond all bounds."""
PAIRS = 500


def random_zone(random: Random) -> Zone:
    while True:
        zone = extended(extended(origin()))
        possible = True
        for i, j in product(range(3), repeat=2):
            if i != j:
                ticks = random.randint(-SIDE, SIDE)
                possible = possible and tighten(zone, i, j, random.choice((at_most(ticks), less_than(ticks))))
        if possible:
            return zone


def points_of(zone: Zone) -> set[tuple[float, ...]]:
    return {point for point in POINTS if all(_holds(zone, point, i, j) for i in range(3) for j in range(3))}


def _holds(zone: Zone, point: tuple[float, ...], i: int, j: int) -> bool:
    bound, apart = zone[i][j], point[i] - point[j]
    return bound >= FREE or apart < bound >> 1 or (bool(bound & 1) and apart == bound >> 1)


def test_zones_are_united_only_where_that_adds_nothing() -> None:
    random = Random(5)
    several = 0
    for _ in range(PAIRS):
        first, second = random_zone(random), random_zone(random)
        whole = united(first, second)
        if whole is not None:
            several += 1
            assert points_of(whole) == points_of(first) | points_of(second)
    assert several > PAIRS / 20


def test_what_a_comparison_has_cut_apart_is_united_again() -> None:
    random = Random(6)
    for _ in range(PAIRS):
        zone = random_zone(random)
        i, j = random.sample(range(3), 2)
        ticks = random.randint(-SIDE, SIDE)
        below, above = [row[:] for row in zone], [row[:] for row in zone]
        if tighten(below, i, j, less_than(ticks)) and tighten(above, j, i, at_most(-ticks)):
            assert united(below, above) == united(above, below) == zone
