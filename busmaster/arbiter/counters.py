"""What is counted on a line, and the immutable snapshots of it that users get.

The states of the line and the marks of the UART are defined here, because most counters are of them. Times are kept in
log-linear histograms: bounded memory, a tenth of a microsecond to record one.
"""

from __future__ import annotations

import enum
import struct
import sys
from array import array
from collections import Counter, deque
from dataclasses import dataclass
from functools import cache

from busmaster.arbiter.learned import LearnedTimes


class LineState(enum.IntEnum):
    """The table on top of arbiter.py says what leads where."""

    OFFLINE = 0
    READY = 1
    HOLDOFF = 2
    EXCHANGE = 3
    RESYNCHRONISING = 4


OFFLINE, READY, HOLDOFF, EXCHANGE, RESYNCHRONISING = LineState
"""For the arbiter: to look a member up in its class takes 60 ns, and a transaction does it a dozen times."""


class Mark(enum.Enum):
    """What the UART says of a byte that it received."""

    DAMAGED = "parity or framing error"
    BREAK = "break"


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
        """Return the quantiles of what a histogram holds now."""
        return cls(
            histogram.count, histogram.mean, histogram.quantile(0.5), histogram.quantile(0.99), histogram.highest
        )


@dataclass(frozen=True, slots=True)
class NodeStatistics:
    """Counts of one node since the last reset. `attempts` are those that have ended: ok + no_reply + garbled + refused
    + those cut off by the loss of the line; `failed` counts transactions that ended with an error, retries and all."""

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
    """From the start of the request to the end of its reply, of attempts that succeeded."""
    learned: tuple[LearnedTimes, ...] = ()
    """Of each kind of command that it was asked, where its reply times are learned."""
    overdue: int = 0
    """Of those that were `late`, the replies that began after the reply window even: their values count all the same,
    and say that the window is too short for this node."""

    @property
    def fruitless(self) -> int:
        """Attempts that brought no value."""
        return self.no_reply + self.garbled + self.refused


@dataclass(frozen=True, slots=True)
class DriverErrors:
    """What a serial driver has counted of its UART's errors, since the port was opened or the counts were reset.

    `overruns` are bytes lost in the UART, `buffer_overruns` bytes lost behind it because nobody read them in time.
    """

    framing: int
    parity: int
    breaks: int
    overruns: int
    buffer_overruns: int

    def since(self, before: DriverErrors) -> DriverErrors:
        """Return what was counted after `before`."""
        return DriverErrors(
            self.framing - before.framing,
            self.parity - before.parity,
            self.breaks - before.breaks,
            self.overruns - before.overruns,
            self.buffer_overruns - before.buffer_overruns,
        )


@dataclass(frozen=True, slots=True)
class LineStatistics:
    """Counts of the line since the last reset; times in seconds."""

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
    """From being queued to being started, for URGENT, COMMAND, POLL and BACKGROUND."""
    sync_reads: int = 0
    """Reads that were asked to prove that the line is in sync (R15)."""
    ambiguous: int = 0
    """Answers that were not believed, since they could have been another request's (R15)."""
    damaged: int = 0
    """Bytes that the UART marked: a parity or framing error."""
    breaks: int = 0
    """Breaks that the UART saw."""
    driver: DriverErrors | None = None
    """What the serial driver has counted; None where it counts nothing, and while the port is lost."""

    @property
    def utilisation(self) -> float:
        """The share of the time in which the line was in use, resynchronising included."""
        return min(1.0, (self.busy + self.quiet_time) / self.elapsed) if self.elapsed > 0 else 0.0


class RecentUtilisation:
    """The share of the last `window` seconds in which a line was in use, resynchronising included.

    It knows the line only by the statistics that it is given: the window begins with the youngest of them that is at
    least `window` seconds old, or with the oldest that it has.
    """

    def __init__(self, window: float) -> None:
        self._window = window
        self._used: deque[tuple[float, float]] = deque()
        """When statistics were given, and the seconds for which the line had been in use by then."""

    def note(self, now: float, line: LineStatistics) -> float:
        """Take the statistics of this moment, and return the share up to it. Until there are two: since the reset."""
        used, seen = line.busy + line.quiet_time, self._used
        if seen and used < seen[-1][1]:  # the statistics were reset
            seen.clear()
        seen.append((now, used))
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
        """Begin all counts anew."""
        self.late = self.overdue = self.no_reply = self.garbled = self.refused = self.cut_off = 0
        self.retries = self.unheard = self.failed = self.probes = 0
        self.latency = Histogram()

    @property
    def ok(self) -> int:
        """How many attempts succeeded: each has recorded its latency, and nothing else is counted for each value."""
        return self.latency.count

    @property
    def attempts(self) -> int:
        """How many attempts have ended, whatever came of them."""
        return self.ok + self.no_reply + self.garbled + self.refused + self.cut_off

    def snapshot(self, max_reply_delay: float) -> NodeStatistics:
        """Return an immutable snapshot of the counts; `max_reply_delay` is the node's, in seconds."""
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
        """Ever: what a request waited for is counted across a reset."""
        self.entered = since
        """When the line entered its state, or `spent` was brought up to date."""
        self.spent = [0.0] * len(LineState)
        """Seconds in each state, ever, up to the last change."""
        self.reset(OFFLINE, since)

    def reset(self, state: LineState, since: float) -> None:
        """Begin all counts anew at the time `since`, in seconds, when the line is in this state."""
        self.since = since
        self.completed = self.cancelled = self.unexpected_bytes = self.noise_bytes = 0
        self.tainted = self.collisions = self.resyncs = self.noisy = self.losses = 0
        self.sync_reads = self.ambiguous = self.damaged = self.breaks = 0
        self._before = (self.exchanges, self._times(state, since))
        self.waits = (Histogram(), Histogram(), Histogram(), Histogram())

    def mark(self, mark: Mark) -> None:
        """Count a byte that the UART marked."""
        if mark is Mark.BREAK:
            self.breaks += 1
        else:
            self.damaged += 1

    def _times(self, state: LineState, now: float) -> list[float]:
        """Return the seconds ever spent in each state, up to now."""
        times = self.spent.copy()
        times[state] += now - self.entered
        return times

    def snapshot(self, state: LineState, now: float, backlog: int) -> LineStatistics:
        """Return an immutable snapshot of the counts since the last reset.

        Nothing changes: whoever looks does not cut the pauses, from which probes are paid, into pieces.
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
