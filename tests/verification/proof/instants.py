"""Instants that stand for all the times at which something may happen, and note whatever is asked of them.

The shipping code runs on them as on floats. One run follows one sample; each comparison that it makes is noted as a
bound between two instants, so that the same run holds for every time in the zone of these bounds, and the explorer
takes the other side of each in runs of their own.

The code may add and subtract seconds, subtract instants, compare, and take the least and greatest. Anything else is a
TypeError: then the proof says so, and does not guess.
"""

from __future__ import annotations

from math import inf
from typing import Any, Final, TypeAlias

from tests.verification.proof.zones import at_most, less_than

TICKS_A_BYTE: Final = 50
Bound: TypeAlias = tuple[int, int, int]
"""x_i - x_j is bounded by the third: see zones.py."""

noted: list[Bound] = []
"""What the run has asked, in order."""
_interned: dict[tuple[int, int], Instant] = {}
_sample: list[float] = [0]
_ticks: dict[float, int] = {}
_rate: list[float] = [1.0]


class NotWhole(Exception):
    """A time is no whole number of ticks: the unit is too coarse for this code."""


def set_unit(byte_time: float) -> None:
    """Let a tick be a fiftieth of this many seconds."""
    _rate[0] = TICKS_A_BYTE / byte_time
    _ticks.clear()


def ticks(seconds: float) -> int:
    """Return whole ticks; raise NotWhole for what lies between two."""
    known = _ticks.get(seconds)
    if known is None:
        exact = seconds * _rate[0]
        known = round(exact)
        if abs(exact - known) > 1e-4:
            raise NotWhole(f"{seconds} s is {exact} ticks")
        _ticks[seconds] = known
    return known


def seconds(count: float) -> float:
    return count / _rate[0]


def begin_run(values: list[float]) -> None:
    """Take these values for the instants x_0, x_1 ..., and forget what the last run noted."""
    noted.clear()
    _interned.clear()
    _sample[:] = values


def instant(base: int, offset: int) -> Instant:
    """Return the one object of this run that is x_base + offset: equal instants are the same."""
    known = _interned.get((base, offset))
    if known is None:
        known = _interned[base, offset] = Instant(base, offset, _sample[base] + offset)
    return known


class Instant:
    """x_base + offset, in ticks; `value` is what it is in the sample of this run."""

    __slots__ = ("base", "offset", "value")

    def __init__(self, base: int, offset: int, value: float) -> None:
        self.base = base
        self.offset = offset
        self.value = value

    def __repr__(self) -> str:
        return f"x{self.base}{self.offset:+d}"

    def __lt__(self, other: Any) -> bool:
        if type(other) is Instant:
            if self.base == other.base:
                return self.offset < other.offset
            apart = other.offset - self.offset
            if self.value < other.value:
                noted.append((self.base, other.base, less_than(apart)))
                return True
            noted.append((other.base, self.base, at_most(-apart)))
            return False
        if other == inf:
            return True
        if other == -inf or type(other) is Past:
            return False
        raise TypeError(f"an instant is compared with {other!r}")

    def __gt__(self, other: Any) -> bool:
        if type(other) is Instant:
            return other < self
        if other == inf:
            return False
        if other == -inf or type(other) is Past:
            return True
        raise TypeError(f"an instant is compared with {other!r}")

    def __le__(self, other: Any) -> bool:
        return not self > other

    def __ge__(self, other: Any) -> bool:
        return not self < other

    def __eq__(self, other: object) -> bool:
        if type(other) is Instant and other.base != self.base:
            return not (self < other or self > other)
        return self is other

    __hash__ = None  # type: ignore[assignment]  # how Python marks what has no hash

    def __add__(self, other: Any) -> Any:
        if type(other) is Span:
            if other.minus == self.base:
                return instant(other.base, self.offset + other.offset)
            raise TypeError(f"{self!r} and {other!r} have no sum that a zone can tell")
        if other == inf or other == -inf:
            return other
        if not isinstance(other, (int, float)):
            return NotImplemented
        return instant(self.base, self.offset + ticks(other))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        if type(other) is Instant:
            if other.base == self.base:
                return seconds(self.offset - other.offset)
            return Span(self.base, other.base, self.offset - other.offset, self.value - other.value)
        if type(other) is Past:
            return inf
        if other == inf or other == -inf:
            return -other
        return instant(self.base, self.offset - ticks(other))

    def __rsub__(self, other: Any) -> Any:
        if other == inf or other == -inf:
            return other
        raise TypeError(f"{other!r} minus an instant")


class Span:
    """A length of time: x_base - x_minus + offset, in ticks."""

    __slots__ = ("base", "minus", "offset", "value")

    def __init__(self, base: int, minus: int, offset: int, value: float) -> None:
        self.base = base
        self.minus = minus
        self.offset = offset
        self.value = value

    def __repr__(self) -> str:
        return f"x{self.base}-x{self.minus}{self.offset:+d}"

    def __lt__(self, other: float) -> bool:
        if other in (inf, -inf):
            return other == inf
        limit = ticks(other) - self.offset
        if self.value < limit + self.offset:
            noted.append((self.base, self.minus, less_than(limit)))
            return True
        noted.append((self.minus, self.base, at_most(-limit)))
        return False

    def __gt__(self, other: float) -> bool:
        if not isinstance(other, (int, float)):
            return NotImplemented
        if other in (inf, -inf):
            return other == -inf
        limit = ticks(other) - self.offset
        if self.value > limit + self.offset:
            noted.append((self.minus, self.base, less_than(-limit)))
            return True
        noted.append((self.base, self.minus, at_most(limit)))
        return False

    def __le__(self, other: float) -> bool:
        return not self > other

    def __ge__(self, other: float) -> bool:
        return not self < other

    def __add__(self, other: Any) -> Any:
        if other in (inf, -inf):
            return other
        moved = ticks(other)
        return Span(self.base, self.minus, self.offset + moved, self.value + moved)

    __radd__ = __add__

    def __sub__(self, other: float) -> Any:
        return self + -other


class Past:
    """An instant before all that are kept, and longer ago than anything asks for. Only the order among its like
    matters, and its distance from what was kept and has become past with it."""

    __slots__ = ("offset", "rank")

    def __init__(self, rank: int, offset: int) -> None:
        self.rank = rank
        self.offset = offset

    def __reduce__(self) -> tuple[Any, ...]:
        return past, (self.rank, self.offset)

    def __lt__(self, other: Any) -> bool:
        return self.rank < other.rank if type(other) is Past else bool(other != -inf)

    def __gt__(self, other: Any) -> bool:
        return self.rank > other.rank if type(other) is Past else bool(other == -inf)

    def __le__(self, other: Any) -> bool:
        return not self > other

    def __ge__(self, other: Any) -> bool:
        return not self < other

    def __sub__(self, other: Any) -> Any:
        return seconds(self.offset - other.offset) if type(other) is Past else -inf


_pasts: dict[tuple[int, int], Past] = {}


def past(rank: int, offset: int) -> Past:
    known = _pasts.get((rank, offset))
    if known is None:
        known = _pasts[rank, offset] = Past(rank, offset)
    return known
