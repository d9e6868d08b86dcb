"""Polls on a fixed grid (R10), and the line time that an exchange takes."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence
from itertools import count
from math import ceil, floor, inf
from typing import Any

from busmaster.arbiter.histogram import Histogram
from busmaster.arbiter.transaction import BACKGROUND, POLL, Priority, Transaction
from busmaster.errors import InvalidCommand
from busmaster.exchange import Exchange

LONGEST_PATIENCE = 10.0
"""Seconds after which a poll's cycle goes before those that came later, however long its period is."""
FILL = 0.9
"""Cycles are spread over this share of the time when phases are chosen: the rest is left for what varies."""
KINKS = 2000
"""Bounds the work of choosing one phase: some 2000 of them cost a millisecond."""
MEETINGS = 8
"""Two polls whose cycles take longer than so many common divisors of their periods meet anyway."""
ROUNDING = 1e-7


def line_time(exchange: Exchange[Any], byte_time: float, reply_time: float | None = None) -> float:
    """Seconds of the line that one undisturbed attempt takes: bytes both ways, and the wait before each reply leg.

    `reply_time` is the node's measured time to its first byte; where it is None, half of `nominal` is assumed.
    The one function by which merging, phases and planning weigh exchanges.
    """
    sent = len(exchange.request) + exchange.closing
    timing = exchange.timing
    if not exchange.answered:
        return sent * byte_time + timing.turnaround
    wait = timing.nominal / 2 if reply_time is None else reply_time
    total = (sent + exchange.sizes.typical) * byte_time + wait + timing.turnaround
    for leg in exchange.later:
        wait = leg.timing.nominal / 2 if reply_time is None else reply_time
        total += (leg.sent + leg.sizes.typical) * byte_time + wait
    return total


class Poll:
    """Transactions that are run once a period, on the grid base + k x period.

    `cost` is the line time of one cycle in seconds, for the choice of phases. `results` are its transactions: they
    hold the outcome of the last cycle until the next one starts. A poll that was removed is not added again.
    """

    __slots__ = (
        "active",
        "base",
        "cost",
        "cycles",
        "due",
        "finished",
        "fresh",
        "jitter",
        "missed",
        "name",
        "number",
        "patience",
        "paused",
        "period",
        "phase",
        "priority",
        "remaining",
        "results",
        "started",
        "waiter",
    )

    def __init__(self, name: str, period: float, *, phase: float | None = None, cost: float = 0.0) -> None:
        if not 0.001 <= period < inf:
            raise InvalidCommand(f"poll group {name!r}: a period is at least 0.001 s, not {period!r}")
        if phase is not None and not 0 <= phase < period:
            raise InvalidCommand(f"poll group {name!r}: a phase is at least 0 s and below the period, not {phase!r}")
        self.name = name
        self.period = period
        self.patience = min(period, LONGEST_PATIENCE)
        self.phase = phase
        self.cost = cost
        self.priority = POLL
        self.results: Sequence[Transaction] = ()
        self.fresh: Sequence[Transaction] | None = None
        self.waiter: Any = None
        self.base = 0.0
        self.number = 0
        self.due = inf
        self.active = False
        self.paused = False
        self.remaining = 0
        self.started = self.finished = -inf
        self.cycles = 0
        self.missed = 0
        self.jitter = Histogram()

    @property
    def running(self) -> bool:
        return self.remaining > 0

    def next_due(self) -> float:
        return self.base + self.number * self.period


class Schedule:
    """All polls of a line and when each is due next."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, Poll]] = []
        self._order = count()
        self._epoch = inf
        self._place_at = inf
        self._unplaced: list[Poll] = []
        self.polls: list[Poll] = []

    def add(self, poll: Poll, now: float) -> None:
        """A poll without a phase gets one when it is first due: those added together are placed jointly.

        Raises InvalidCommand for a poll that is, or was, on it.
        """
        if poll.active or poll.cycles:
            raise InvalidCommand(f"poll group {poll.name!r} is or was running: make a new one")
        self._epoch = min(self._epoch, now)
        poll.active = True
        self.polls.append(poll)
        if poll.phase is None:
            self._unplaced.append(poll)
            self._place_at = now
        else:
            self._start(poll, self._epoch + poll.phase, now)

    def remove(self, poll: Poll) -> None:
        if poll.active:
            poll.active = False
            self.polls.remove(poll)
            self._unplaced = [other for other in self._unplaced if other is not poll]
            self._heap = [entry for entry in self._heap if entry[2] is not poll]
            heapq.heapify(self._heap)

    def next_due(self) -> float:
        due = self._heap[0][0] if self._heap else inf
        return min(due, self._place_at) if self._unplaced else due

    def release(self, now: float) -> list[Poll]:
        """The polls whose cycle starts now, each with `due` set. Cycles that could not start are counted missed."""
        if self._unplaced and self._place_at <= now:
            self._place(now)
        starting: list[Poll] = []
        heap = self._heap
        while heap and heap[0][0] <= now:
            poll = heap[0][2]
            behind = floor((now - poll.base) / poll.period) - poll.number
            if poll.base + (poll.number + max(behind, 0) + 1) * poll.period <= now:
                behind = max(behind, 0) + 1  # rounding
            if behind > 0:
                poll.number += behind
                poll.missed += 0 if poll.paused else behind
            due = poll.next_due()
            poll.number += 1
            heapq.heapreplace(heap, (poll.next_due(), next(self._order), poll))
            if poll.paused:
                continue
            if poll.remaining:
                poll.missed += 1
                continue
            poll.due = due
            starting.append(poll)
        return starting

    def _place(self, now: float) -> None:
        """Short periods first: what is left free then repeats, and longer periods find it."""
        placed = [poll for poll in self.polls if poll not in self._unplaced]
        load = sum(poll.cost / poll.period for poll in self.polls)
        for poll in sorted(self._unplaced, key=lambda poll: poll.period):
            base = now + quietest_offset(poll, placed, now, FILL / load if load else 1.0)
            poll.phase = (base - self._epoch) % poll.period
            placed.append(poll)
            self._start(poll, base, now)
        self._unplaced.clear()

    def _start(self, poll: Poll, base: float, now: float) -> None:
        """Its grid begins with the first time from now on."""
        poll.base = base + ceil((now - base) / poll.period) * poll.period
        poll.number = 0
        heapq.heappush(self._heap, (poll.base, next(self._order), poll))


def begin_cycle(poll: Poll, now: float) -> list[Transaction]:
    """Make the poll's transactions fresh; returns them, ready to be queued.

    A node that was never heard is read in BACKGROUND, so that absent nodes hold up nobody when a line starts.
    """
    if poll.fresh is not None:
        poll.results, poll.fresh = poll.fresh, None
    poll.remaining = len(poll.results)
    poll.started = -inf
    poll.cycles += 1
    deadline = poll.due + poll.patience
    for transaction in poll.results:
        transaction.reset()
        transaction.queued = now
        transaction.deadline = deadline
        transaction.priority = poll.priority if transaction.node.last_reply > -inf else BACKGROUND
    return list(poll.results)


def set_members(poll: Poll, members: Iterable[Transaction], priority: Priority = POLL) -> None:
    """Give a poll its transactions, from its next cycle on."""
    fresh = tuple(members)
    for transaction in fresh:
        transaction.poll = poll
    poll.fresh = fresh
    poll.priority = priority


def quietest_offset(poll: Poll, others: Sequence[Poll], now: float, stretch: float = 1.0) -> float:
    """Seconds from `now`, below the period, at which this poll's cycles meet the others' least.

    All costs are multiplied by `stretch`. The time in which two polls want the line at once is a function of their
    offset modulo the common divisor of their periods, made of straight pieces; the least sum of all of them lies at
    one of the kinks. Among equals the earliest wins. The search ends early where there would be too many kinks.
    """
    own = min(poll.cost * stretch, poll.period)
    pairs = []
    for other in others:
        step = common_divisor(poll.period, other.period)
        length = min(other.cost * stretch, other.period)
        if own + length < MEETINGS * step:
            pairs.append(((other.base - now) % step, length, step, step / other.period))
    if not pairs:
        return 0.0
    affordable = KINKS / 4 - sum((own + length) / step + 1 for _, length, step, _ in pairs)
    reach = affordable / sum(1 / step for _, _, step, _ in pairs)
    reach = min(poll.period, max(reach, min(step for _, _, step, _ in pairs)))
    best, least = 0.0, inf
    overlap = slope = at = 0.0
    for x, bend in sorted(_kinks(pairs, own, reach)):
        overlap += slope * (x - at)
        slope += bend
        at = x
        if 0 <= x < reach and overlap < least - ROUNDING:
            best, least = x, overlap
    return best


def _kinks(
    pairs: Iterable[tuple[float, float, float, float]], own: float, reach: float
) -> Iterator[tuple[float, float]]:
    """Where the sum of overlaps changes its slope, from before 0 up to `reach`, and by how much."""
    yield 0.0, 0.0
    for begin, length, step, weight in pairs:
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
    """The greatest time of which both periods are multiples, within a ten-thousandth of the shorter one."""
    first, second = max(first, second), min(first, second)
    least = 1e-4 * second
    while second > least:
        first, second = second, abs(first - second * round(first / second))
    return first


__all__ = [
    "Poll",
    "Priority",
    "Schedule",
    "begin_cycle",
    "common_divisor",
    "line_time",
    "quietest_offset",
    "set_members",
]
