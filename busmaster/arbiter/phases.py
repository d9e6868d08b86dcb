"""Where on its period a new poll meets the others least: a search that can be done a slice at a time."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from math import ceil, floor, inf
from typing import Protocol

KINKS = 2000
"""Bounds the work of choosing one phase: some 2000 of them cost a millisecond."""
STRIDE = 64
"""Kinks, or other polls, that are looked at between two places at which the search can be interrupted."""
MEETINGS = 8
"""Two polls whose cycles take longer than so many common divisors of their periods meet anyway."""
ROUNDING = 1e-7


class Recurring(Protocol):
    """What occupies the line for `cost` seconds from base + k x period on. All times are in seconds."""

    @property
    def base(self) -> float: ...
    @property
    def cost(self) -> float: ...
    @property
    def period(self) -> float: ...


Pair = tuple[float, float, float, float]
"""Of another poll: when it begins, for how long it lasts, both on a circle of a length, and how often it is there."""


def quietest_offset(
    poll: Recurring, others: Iterable[Recurring], now: float, stretch: float = 1.0
) -> Generator[int, None, float]:
    """Find the seconds from `now`, below the period, at which this poll's cycles meet the others' least.

    It is a generator that returns the offset; between, it yields how much it has looked at since, never much more than
    STRIDE. All costs are multiplied by `stretch`. The time in which two polls want the line at once is a function of
    their offset modulo the common divisor of their periods, made of straight pieces; the least sum of all of them lies
    at one of the kinks. Among equals the earliest wins. The search ends early where there would be too many kinks.
    """
    # Stretched over the time that there is: cycles that just fit one behind the other would meet as soon as one of them
    # takes longer than it was reckoned.
    own = min(poll.cost * stretch, poll.period)
    pairs: list[Pair] = []
    divisors: dict[float, float] = {}
    frequency = before = 0.0
    nearest = inf
    for number, other in enumerate(others, 1):
        step = divisors.get(other.period)
        if step is None:
            step = divisors[other.period] = common_divisor(poll.period, other.period)
        length = min(other.cost * stretch, other.period)
        if own + length < MEETINGS * step:
            pairs.append(((other.base - now) % step, length, step, step / other.period))
            before += (own + length) / step + 1
            frequency += 1 / step
            nearest = min(nearest, step)
        if number % STRIDE == 0:
            yield STRIDE
    if not pairs:
        return 0.0
    reach = min(poll.period, max((KINKS / 4 - before) / frequency, nearest))
    return (yield from _least(pairs, own, reach, 1 + int(4 * reach * frequency / STRIDE)))


def _least(pairs: Iterable[Pair], own: float, reach: float, pieces: int) -> Generator[int, None, float]:
    """Add up the bends of the sum of overlaps, sorted into so many pieces of the way, then walk it to its least."""
    overlap = slope = at = 0.0
    bends: list[dict[float, float]] = [{} for _ in range(pieces)]
    looked_at = 0
    for pair in pairs:
        for x, bend in _kinks(pair, own, reach):
            looked_at += 1
            if looked_at == STRIDE:
                yield looked_at
                looked_at = 0
            if x <= 0:
                overlap -= bend * x
                slope += bend
            elif x < reach:
                piece = bends[min(int(x / reach * pieces), pieces - 1)]
                piece[x] = piece.get(x, 0.0) + bend
    best, least = 0.0, overlap
    for piece in bends:
        for x in sorted(piece):
            if least <= ROUNDING:
                return best
            overlap += slope * (x - at)
            slope += piece[x]
            at = x
            if overlap < least - ROUNDING:
                best, least = x, overlap
        yield len(piece)
    return best


def _kinks(pair: Pair, own: float, reach: float) -> Iterator[tuple[float, float]]:
    """Yield where the overlap with one other poll changes its slope, from before 0 up to `reach`, and by how much."""
    begin, length, step, weight = pair
    shorter = min(own, length)
    first = begin - own - step * floor((begin + length) / step)
    for k in range(ceil((reach - first) / step)):
        start = first + k * step
        end = start + own + length
        yield start, weight
        yield start + shorter, -weight
        yield end - shorter, -weight
        yield end, weight


def common_divisor(first: float, second: float) -> float:
    """Return the greatest time of which both periods are multiples, within a ten-thousandth of the shorter one."""
    first, second = max(first, second), min(first, second)
    least = 1e-4 * second
    while second > least:
        first, second = second, abs(first - second * round(first / second))
    return first
