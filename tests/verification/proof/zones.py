"""Difference-bound zones: sets of instants, told by bounds on the differences of any two of them.

A zone is a square matrix. Its entry [i][j] bounds x_i - x_j, in ticks: 2c + 1 says "at most c", 2c says "less than c".
Every matrix here is closed: no bound follows from others that is not there already. Nothing is ever rounded.
"""

from __future__ import annotations

from math import inf
from typing import TypeAlias

Zone: TypeAlias = list[list[int]]
FREE = 1 << 60
"""No bound."""
SAME = 1
"""x - x is at most 0."""


def origin() -> Zone:
    """Return the zone of one instant."""
    return [[SAME]]


def at_most(ticks: int) -> int:
    return 2 * ticks + 1


def less_than(ticks: int) -> int:
    return 2 * ticks


def opposite(bound: int) -> int:
    """Return the bound on y - x that holds exactly where this one on x - y does not."""
    return 1 - bound


def joined(first: int, second: int) -> int:
    """Return the bound on x - z that follows from bounds on x - y and on y - z."""
    if first >= FREE or second >= FREE:
        return FREE
    return first + second - ((first & 1) | (second & 1))


def tighten(zone: Zone, i: int, j: int, bound: int) -> bool:
    """Add x_i - x_j < or <= what `bound` says, in place. False if nothing is left: then the zone is spoilt."""
    if zone[i][j] <= bound:
        return True
    if joined(zone[j][i], bound) < SAME:
        return False
    row = zone[j]
    several = range(len(zone))
    for other in zone:
        to_i = other[i]
        if to_i >= FREE:
            continue
        by_way = to_i + bound - ((to_i & 1) | (bound & 1))
        if by_way >= other[j]:
            continue
        for q in several:
            onward = row[q]
            if onward < FREE:
                whole = by_way + onward - ((by_way & 1) | (onward & 1))
                if whole < other[q]:
                    other[q] = whole
    return True


def extended(zone: Zone) -> Zone:
    """Return a copy with one more instant, of which nothing is known."""
    more = [[*row, FREE] for row in zone]
    more.append([FREE] * len(zone) + [SAME])
    return more


def copied(zone: Zone) -> Zone:
    return [row[:] for row in zone]


def within(inner: Zone, outer: Zone) -> bool:
    """Whether every instant of the one is in the other."""
    for mine, theirs in zip(inner, outer, strict=True):
        for a, b in zip(mine, theirs, strict=True):
            if a > b:
                return False
    return True


def united(first: Zone, second: Zone) -> Zone | None:
    """Return the zone of all instants that are in the one or in the other; None if these are no zone."""
    whole = [[max(pair) for pair in zip(mine, theirs, strict=True)] for mine, theirs in zip(first, second, strict=True)]
    for i, (row, bounds) in enumerate(zip(first, whole, strict=True)):
        for j, bound in enumerate(row):
            if bound < bounds[j]:
                beyond = copied(whole)
                if tighten(beyond, j, i, opposite(bound)) and not within(beyond, second):
                    return None
    return whole


def widened(zone: Zone, longest: int) -> Zone:
    """Return a zone that holds all of this one, in which no bound is longer than so many ticks: so there are finitely
    many. What is added may be no more than what is possible: a proof stays one, a violation is looked at again."""
    highest, lowest = at_most(longest), less_than(-longest)
    if all(lowest <= bound <= highest or bound == FREE for row in zone for bound in row):
        return zone
    wide = [[FREE if bound > highest else max(bound, lowest) for bound in row] for row in zone]
    for via in range(len(wide)):
        onward = wide[via]
        for row in wide:
            if row[via] < FREE:
                for j, bound in enumerate(onward):
                    whole = joined(row[via], bound)
                    if whole < row[j]:
                        row[j] = whole
    return wide


def sample(zone: Zone, late: bool = False) -> list[float]:
    """Return one value for each instant, x_0 being 0: the earliest that is allowed, or (`late`) the last."""
    values: list[float] = [0]
    for k in range(1, len(zone)):
        lowest, beyond_lowest, highest, below_highest = -inf, False, inf, False
        for j in range(k):
            bound = zone[k][j]
            if bound < FREE:
                value, strict = values[j] + (bound >> 1), not bound & 1
                if value < highest or (value == highest and strict):
                    highest, below_highest = value, strict
            bound = zone[j][k]
            if bound < FREE:
                value, strict = values[j] - (bound >> 1), not bound & 1
                if value > lowest or (value == lowest and strict):
                    lowest, beyond_lowest = value, strict
        values.append(_between(lowest, beyond_lowest, highest, below_highest, late))
    return values


def _between(lowest: float, beyond_lowest: bool, highest: float, below_highest: bool, late: bool) -> float:
    if not beyond_lowest and lowest > -inf and not late:
        return lowest
    if not below_highest and highest < inf:
        return highest
    if lowest == -inf:
        return highest - 10 if highest < inf else 0
    if highest == inf:
        return lowest + 10
    return (lowest + highest) / 2
