"""A log-linear histogram of times: bounded memory, a tenth of a microsecond to record."""

from __future__ import annotations

import struct
import sys
from array import array
from collections import Counter
from functools import cache

BATCH = 256
"""Times that are kept as they came until they are sorted into buckets, all at once."""
_UPPER = slice(3, None, 4) if sys.byteorder == "little" else slice(0, None, 4)


class Histogram:
    """Times in seconds, each within 1/16 of its value. Negative times count as 0.

    A bucket is what the upper sixteen bits of a time say, as the machine keeps it: the exponent and the first four
    bits of the fraction. So no bucket has to be computed, and a batch is counted without a step of Python for each.
    """

    __slots__ = ("_counts", "_highest", "_new", "_total")

    def __init__(self) -> None:
        self._new: list[float] = []
        self._counts: dict[int, int] = {}
        self._total = 0.0
        self._highest = 0.0

    def record(self, seconds: float) -> None:
        """Record one time, in seconds; a negative one counts as 0."""
        new = self._new
        new.append(seconds)
        if len(new) >= BATCH:
            self._sort_in()

    @property
    def count(self) -> int:
        """How many times were recorded."""
        return sum(self._sorted().values())

    @property
    def total(self) -> float:
        """The sum of all times, in seconds."""
        self._sorted()
        return self._total

    @property
    def highest(self) -> float:
        """The longest time, in seconds; 0 when nothing was recorded."""
        self._sorted()
        return self._highest

    @property
    def mean(self) -> float:
        """The mean time, in seconds; 0 when nothing was recorded."""
        count = self.count
        return self._total / count if count else 0.0

    def quantile(self, q: float) -> float:
        """Return the upper edge, in seconds, of the bucket of the q-quantile, q from 0 to 1; 0 if none was recorded."""
        wanted = q * self.count
        seen = 0
        for edge, count in self.buckets():
            seen += count
            if seen >= wanted:
                return min(edge, self._highest)
        return self._highest

    def buckets(self) -> list[tuple[float, int]]:
        """Return (upper edge in seconds, count) of every bucket in use, ascending."""
        return [(_upper_edge(bucket), count) for bucket, count in sorted(self._sorted().items())]

    def _sorted(self) -> dict[int, int]:
        if self._new:
            self._sort_in()
        return self._counts

    def _sort_in(self) -> None:
        new = self._new
        counts = self._counts
        if min(new) < 0.0:
            new[:] = [max(seconds, 0.0) for seconds in new]
        for bucket, count in Counter(array("H", array("d", new).tobytes())[_UPPER]).items():
            counts[bucket] = counts.get(bucket, 0) + count
        self._total += sum(new)
        self._highest = max(self._highest, *new)
        new.clear()


@cache
def _upper_edge(bucket: int) -> float:
    edge: float = struct.unpack(">d", (bucket + 1).to_bytes(2, "big") + bytes(6))[0]
    return edge
