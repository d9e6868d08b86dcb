"""Counters of a line, and the immutable snapshots of them for users.

The states of the line and the UART marks are defined here, because most counters refer to them. Times are kept in
log-linear histograms: bounded memory, and 0.1 us to record one.
"""

from __future__ import annotations

import enum
import struct
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from functools import cache

from busmaster.arbiter.learned import LearnedTimes


class LineState(enum.IntEnum):
    """State of a line. The table in arbiter.py shows the transitions."""

    OFFLINE = 0
    READY = 1
    HOLDOFF = 2
    EXCHANGE = 3
    RESYNCHRONISING = 4


OFFLINE, READY, HOLDOFF, EXCHANGE, RESYNCHRONISING = LineState
"""Module constants for the arbiter: a lookup in the class takes 60 ns, and a transaction does a dozen."""


class Mark(enum.Enum):
    """UART report about a received byte."""

    DAMAGED = "parity or framing error"
    BREAK = "break"


BATCH = 256
"""Number of times that are collected before they are sorted into buckets together."""


class Histogram:
    """Times in seconds, each within 1/16 of its value. Negative times count as 0.

    A bucket is given by the upper sixteen bits of a time as a double: the exponent and the first four bits of the
    fraction. No bucket needs to be calculated, and a batch is counted without a Python step per time.
    """

    __slots__ = ("_counts", "_highest", "_total", "new")

    def __init__(self) -> None:
        self.new: list[float] = []
        """Times that are not in buckets yet. When there are BATCH of them, `sort_in` must be called."""
        self._counts: dict[int, int] = {}
        self._total = 0.0
        self._highest = 0.0

    def record(self, seconds: float) -> None:
        """Record one time, in seconds."""
        new = self.new
        new.append(seconds)
        if len(new) >= BATCH:
            self.sort_in()

    @property
    def count(self) -> int:
        """Number of recorded times."""
        return sum(self._sorted().values())

    @property
    def total(self) -> float:
        """Sum of all times, in seconds."""
        self._sorted()
        return self._total

    @property
    def highest(self) -> float:
        """Longest time, in seconds; 0 if none was recorded."""
        self._sorted()
        return self._highest

    @property
    def mean(self) -> float:
        """Mean time, in seconds; 0 if none was recorded."""
        count = self.count
        return self._total / count if count else 0.0

    def quantile(self, q: float) -> float:
        """Return the upper edge, in seconds, of the bucket of the q-quantile, q from 0 to 1; 0 if none was recorded."""
        wanted = q * self.count
        seen = 0
        for edge, count in self.buckets():
            seen += count
            if seen >= wanted:
                # The first bucket holds times of 0. Its edge, 1e-309, would be read as an error.
                return 0.0 if edge == _upper_edge(0) else min(edge, self._highest)
        return self._highest

    def buckets(self) -> list[tuple[float, int]]:
        """Return (upper edge in seconds, count) of every bucket in use, ascending."""
        return [(_upper_edge(bucket), count) for bucket, count in sorted(self._sorted().items())]

    def _sorted(self) -> dict[int, int]:
        if self.new:
            self.sort_in()
        return self._counts

    def sort_in(self) -> None:
        """Count the times of `new` in their buckets."""
        # Sorted first: then the times of a bucket are found together, which takes a quarter of the time of counting
        # each (benchmark `turnaround`).
        new = sorted(self.new)
        # A clock that was read twice may be slightly older the second time.
        if new[0] <= 0.0:
            new = [seconds if seconds > 0.0 else 0.0 for seconds in new]
        counts, first = self._counts, 0
        while first < len(new):
            bucket = int.from_bytes(_DOUBLE.pack(new[first])[:2], "big")
            end = bisect_left(new, _upper_edge(bucket), first + 1)
            counts[bucket] = counts.get(bucket, 0) + end - first
            first = end
        self._total += sum(new)
        self._highest = max(self._highest, new[-1])
        self.new.clear()


_DOUBLE = struct.Struct(">d")


@cache
def _upper_edge(bucket: int) -> float:
    edge: float = _DOUBLE.unpack((bucket + 1).to_bytes(2, "big") + bytes(6))[0]
    return edge


@dataclass(frozen=True, slots=True)
class Quantiles:
    """A distribution of times, in seconds."""

    count: int
    mean: float
    p50: float
    p99: float
    highest: float

    @classmethod
    def of(cls, histogram: Histogram) -> Quantiles:
        """Return the quantiles of a histogram's current contents."""
        return cls(
            histogram.count, histogram.mean, histogram.quantile(0.5), histogram.quantile(0.99), histogram.highest
        )


@dataclass(frozen=True, slots=True)
class NodeStatistics:
    """Counters of one node since the last reset.

    `attempts` counts finished attempts: ok + no_reply + garbled + refused + those cut off by the loss of the line.
    `failed` counts transactions that ended with an error after all retries.
    """

    attempts: int
    ok: int
    late: int
    no_reply: int
    garbled: int
    refused: int
    retries: int
    unheard: int
    failed: int
    probes: int
    max_reply_delay: float
    latency: Quantiles
    """From the start of the request to the end of its reply, for successful attempts."""
    learned: tuple[LearnedTimes, ...] = ()
    """Learned times for each kind of command, if reply times are learned."""
    overdue: int = 0
    """Replies, counted in `late` too, that began after the reply window. Their values were delivered. If there are
    many, the window is too short for this node."""

    @property
    def fruitless(self) -> int:
        """Attempts that returned no value."""
        return self.no_reply + self.garbled + self.refused


@dataclass(frozen=True, slots=True)
class DriverErrors:
    """UART errors counted by the serial driver since the port was opened or the counters were reset.

    `overruns`: bytes lost in the UART. `buffer_overruns`: bytes lost in the driver because they were not read in time.
    """

    framing: int
    parity: int
    breaks: int
    overruns: int
    buffer_overruns: int

    def since(self, before: DriverErrors) -> DriverErrors:
        """Return the errors counted after `before`."""
        return DriverErrors(
            self.framing - before.framing,
            self.parity - before.parity,
            self.breaks - before.breaks,
            self.overruns - before.overruns,
            self.buffer_overruns - before.buffer_overruns,
        )


@dataclass(frozen=True, slots=True)
class LineStatistics:
    """Counters of the line since the last reset. Times in seconds."""

    elapsed: float
    exchanges: int
    completed: int
    cancelled: int
    unexpected_bytes: int
    noise_bytes: int
    tainted: int
    collisions: int
    resyncs: int
    quiet_time: float
    busy: float
    noisy: int
    losses: int
    backlog: int
    waits: tuple[Quantiles, Quantiles, Quantiles, Quantiles]
    """Time from queueing to sending, for URGENT, COMMAND, POLL and BACKGROUND."""
    sync_reads: int = 0
    """Reads sent to prove that the line is in sync (R15)."""
    ambiguous: int = 0
    """Replies that were not delivered because they could belong to another request (R15)."""
    damaged: int = 0
    """Bytes that the UART marked with a parity or framing error."""
    breaks: int = 0
    """Breaks reported by the UART."""
    driver: DriverErrors | None = None
    """Errors counted by the serial driver; None if it counts none, and while the port is lost."""

    @property
    def utilisation(self) -> float:
        """Share of the time in which the line was in use, including resynchronisation."""
        return min(1.0, (self.busy + self.quiet_time) / self.elapsed) if self.elapsed > 0 else 0.0


class RecentUtilisation:
    """Share of the last `window` seconds in which a line was in use, including resynchronisation.

    Calculated from the snapshots passed to `note`. The period begins with the newest snapshot that is at least `window`
    seconds old, or with the oldest one.
    """

    def __init__(self, window: float) -> None:
        self._window = window
        self._used: deque[tuple[float, float]] = deque()
        """Time of each snapshot, and the seconds for which the line had been in use."""

    def note(self, now: float, line: LineStatistics) -> float:
        """Add the current snapshot and return the share. The first one returns the share since the reset."""
        used, seen = line.busy + line.quiet_time, self._used
        if seen and used < seen[-1][1]:  # the statistics were reset
            seen.clear()
        seen.append((now, used))
        # One snapshot from before the window is kept, from which the share is calculated.
        while len(seen) > 2 and seen[1][0] <= now - self._window:
            seen.popleft()
        since, used_then = seen[0]
        return min(1.0, (used - used_then) / (now - since)) if now > since else line.utilisation


class NodeCounters:
    __slots__ = (
        "cut_off",
        "failed",
        "garbled",
        "late",
        "latency",
        "no_reply",
        "overdue",
        "probes",
        "refused",
        "retries",
        "unheard",
    )

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Reset all counters."""
        self.late = self.overdue = self.no_reply = self.garbled = self.refused = self.cut_off = 0
        self.retries = self.unheard = self.failed = self.probes = 0
        self.latency = Histogram()

    @property
    def ok(self) -> int:
        """Number of successful attempts: each records a latency, so no other counter is needed per value."""
        return self.latency.count

    @property
    def attempts(self) -> int:
        """Number of finished attempts, successful or not."""
        return self.ok + self.no_reply + self.garbled + self.refused + self.cut_off

    def snapshot(self, max_reply_delay: float) -> NodeStatistics:
        """Return an immutable snapshot of the counters. `max_reply_delay`: the node's, in seconds."""
        return NodeStatistics(
            self.attempts,
            self.ok,
            self.late,
            self.no_reply,
            self.garbled,
            self.refused,
            self.retries,
            self.unheard,
            self.failed,
            self.probes,
            max_reply_delay,
            Quantiles.of(self.latency),
            overdue=self.overdue,
        )


class LineCounters:
    __slots__ = (
        "_before",
        "ambiguous",
        "breaks",
        "cancelled",
        "collisions",
        "completed",
        "damaged",
        "entered",
        "exchanges",
        "losses",
        "noise_bytes",
        "noisy",
        "resyncs",
        "since",
        "spent",
        "sync_reads",
        "tainted",
        "unexpected_bytes",
        "waits",
    )

    def __init__(self, since: float) -> None:
        self.exchanges = 0
        """Never reset: a request's `exchanges_ahead` may span a reset of the statistics."""
        self.entered = since
        """When the line entered its state, or `spent` was last updated."""
        self.spent = [0.0] * len(LineState)
        """Seconds in each state until the last change. Never reset."""
        self.reset(OFFLINE, since)

    def reset(self, state: LineState, since: float) -> None:
        """Reset all counters at the time `since`, in seconds, with the line in this state."""
        self.since = since
        self.completed = self.cancelled = self.unexpected_bytes = self.noise_bytes = 0
        self.tainted = self.collisions = self.resyncs = self.noisy = self.losses = 0
        self.sync_reads = self.ambiguous = self.damaged = self.breaks = 0
        # The counters run on, because differences of them are stored in queued requests. A snapshot subtracts these.
        self._before = (self.exchanges, self._times(state, since))
        self.waits = (Histogram(), Histogram(), Histogram(), Histogram())

    def mark(self, mark: Mark) -> None:
        """Count a byte that the UART marked."""
        if mark is Mark.BREAK:
            self.breaks += 1
        else:
            self.damaged += 1

    def _times(self, state: LineState, now: float) -> list[float]:
        """Return the total seconds in each state, up to now."""
        times = self.spent.copy()
        times[state] += now - self.entered
        return times

    def snapshot(self, state: LineState, now: float, backlog: int) -> LineStatistics:
        """Return an immutable snapshot of the counters since the last reset.

        Changes nothing: reading the statistics must not split the idle times from which probes are paid.
        """
        first, second, third, fourth = self.waits
        exchanges, times = self._before
        spent = [time - before for time, before in zip(self._times(state, now), times, strict=True)]
        return LineStatistics(
            now - self.since,
            self.exchanges - exchanges,
            self.completed,
            self.cancelled,
            self.unexpected_bytes,
            self.noise_bytes,
            self.tainted,
            self.collisions,
            self.resyncs,
            spent[RESYNCHRONISING],
            spent[EXCHANGE] + spent[HOLDOFF],
            self.noisy,
            self.losses,
            backlog,
            (Quantiles.of(first), Quantiles.of(second), Quantiles.of(third), Quantiles.of(fourth)),
            self.sync_reads,
            self.ambiguous,
            self.damaged,
            self.breaks,
        )
