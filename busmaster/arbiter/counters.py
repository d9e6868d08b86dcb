"""What is counted, and the immutable snapshots of it that users get."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from busmaster.arbiter.histogram import Histogram
from busmaster.arbiter.learned import LearnedTimes
from busmaster.arbiter.mark import Mark
from busmaster.arbiter.state import EXCHANGE, HOLDOFF, OFFLINE, SETTLING, LineState


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
    lateness: float
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


@dataclass(frozen=True, slots=True)
class LineStatistics:
    """Counts of the line since the last reset; times in seconds."""

    elapsed: float
    exchanges: int
    completed: int
    cancelled: int
    unasked_bytes: int
    noise_bytes: int
    tainted: int
    collisions: int
    settles: int
    settling: float
    busy: float
    noisy: int
    losses: int
    backlog: int
    waits: tuple[Quantiles, Quantiles, Quantiles, Quantiles]
    """From being queued to being started, for URGENT, COMMAND, POLL and BACKGROUND."""
    checks: int = 0
    """Reads that were asked to prove that the line is in step (R15)."""
    doubted: int = 0
    """Answers that were not believed, since they could have been another request's (R15)."""
    damaged: int = 0
    """Bytes that the UART marked: a parity or framing error."""
    breaks: int = 0
    """Breaks that the UART saw."""
    driver: DriverErrors | None = None
    """What the serial driver has counted; None where it counts nothing, and while the port is lost."""

    @property
    def utilisation(self) -> float:
        """The share of the time in which the line was in use, settling included."""
        return min(1.0, (self.busy + self.settling) / self.elapsed) if self.elapsed > 0 else 0.0


class RecentUtilisation:
    """The share of the last `window` seconds in which a line was in use, settling included.

    It knows the line only by the statistics that it is given: the window begins with the youngest of them that is at
    least `window` seconds old, or with the oldest that it has.
    """

    def __init__(self, window: float) -> None:
        self._window = window
        self._used: deque[tuple[float, float]] = deque()
        """When statistics were given, and the seconds for which the line had been in use by then."""

    def note(self, now: float, line: LineStatistics) -> float:
        """Take the statistics of this moment, and return the share up to it. Until there are two: since the reset."""
        used, seen = line.busy + line.settling, self._used
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

    def snapshot(self, lateness: float) -> NodeStatistics:
        """Return an immutable snapshot of the counts; `lateness` is the node's, in seconds."""
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
            lateness,
            Quantiles.of(self.latency),
            overdue=self.overdue,
        )


class LineCounters:
    __slots__ = (
        "_before",
        "breaks",
        "cancelled",
        "checks",
        "collisions",
        "completed",
        "damaged",
        "doubted",
        "entered",
        "exchanges",
        "losses",
        "noise_bytes",
        "noisy",
        "settles",
        "since",
        "spent",
        "tainted",
        "unasked_bytes",
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
        self.completed = self.cancelled = self.unasked_bytes = self.noise_bytes = 0
        self.tainted = self.collisions = self.settles = self.noisy = self.losses = 0
        self.checks = self.doubted = self.damaged = self.breaks = 0
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
            self.unasked_bytes,
            self.noise_bytes,
            self.tainted,
            self.collisions,
            self.settles,
            spent[SETTLING],
            spent[EXCHANGE] + spent[HOLDOFF],
            self.noisy,
            self.losses,
            backlog,
            (Quantiles.of(first), Quantiles.of(second), Quantiles.of(third), Quantiles.of(fourth)),
            self.checks,
            self.doubted,
            self.damaged,
            self.breaks,
        )
