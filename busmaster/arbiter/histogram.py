"""A log-linear histogram of times: bounded memory, a fraction of a microsecond to record."""

from __future__ import annotations

SUB_BITS = 4
SUB_BUCKETS = 1 << SUB_BITS
OCTAVES = 28
BUCKETS = (OCTAVES + 1) * SUB_BUCKETS


class Histogram:
    """Times from 1 us to over 200 s, each within 1/16 of its value. Negative times count as 0."""

    __slots__ = ("_counts", "count", "highest", "total")

    def __init__(self) -> None:
        self._counts = [0] * BUCKETS
        self.count = 0
        self.total = 0.0
        self.highest = 0.0

    def record(self, seconds: float) -> None:
        micros = int(seconds * 1e6)
        if micros < SUB_BUCKETS:
            index = micros if micros > 0 else 0
        else:
            shift = micros.bit_length() - SUB_BITS - 1
            index = (shift << SUB_BITS) + (micros >> shift)
            if index >= BUCKETS:
                index = BUCKETS - 1
        self._counts[index] += 1
        self.count += 1
        self.total += seconds
        if seconds > self.highest:
            self.highest = seconds

    @property
    def mean(self) -> float:
        return self.total / self.count if self.count else 0.0

    def quantile(self, q: float) -> float:
        """The upper edge of the bucket in which the q-quantile lies, in seconds; 0 when nothing was recorded."""
        if not self.count:
            return 0.0
        wanted = q * self.count
        seen = 0
        for index, count in enumerate(self._counts):
            seen += count
            if count and seen >= wanted:
                return min(_upper_edge(index), self.highest)
        return self.highest

    def buckets(self) -> list[tuple[float, int]]:
        """(upper edge in seconds, count) of every bucket in use, ascending."""
        return [(_upper_edge(i), n) for i, n in enumerate(self._counts) if n]

    def clear(self) -> None:
        self._counts = [0] * BUCKETS
        self.count = 0
        self.total = 0.0
        self.highest = 0.0


def _upper_edge(index: int) -> float:
    if index < 2 * SUB_BUCKETS:
        return (index + 1) / 1e6
    shift = (index >> SUB_BITS) - 1
    return float((index - (shift << SUB_BITS) + 1) << shift) / 1e6
