"""Polls on a fixed grid (R10), and the line time that an exchange takes."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Sequence
from itertools import count
from math import floor, inf
from typing import Any

from busmaster.arbiter.histogram import Histogram
from busmaster.arbiter.transaction import Priority, Transaction
from busmaster.errors import InvalidCommand
from busmaster.exchange import Exchange

HORIZON = 8
"""Periods of the slowest poll over which phases are chosen."""


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
    hold the outcome of the last cycle until the next one starts.
    """

    __slots__ = (
        "active",
        "base",
        "cost",
        "cycles",
        "demanded",
        "due",
        "finished",
        "fresh",
        "jitter",
        "late_cycles",
        "missed",
        "name",
        "number",
        "paused",
        "period",
        "phase",
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
        self.phase = phase
        self.cost = cost
        self.results: Sequence[Transaction] = ()
        self.fresh: Sequence[Transaction] | None = None
        self.waiter: Any = None
        self.base = 0.0
        self.number = 0
        self.due = inf
        self.active = False
        self.paused = False
        self.remaining = 0
        self.demanded = False
        self.started = self.finished = -inf
        self.cycles = 0
        self.missed = 0
        self.late_cycles = 0
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
        self._epoch: float | None = None
        self.polls: list[Poll] = []

    def add(self, poll: Poll, now: float) -> None:
        """Raises InvalidCommand for a poll that is already on it."""
        if poll.active:
            raise InvalidCommand(f"poll group {poll.name!r} is already running")
        if self._epoch is None:
            self._epoch = now
        if poll.phase is None:
            poll.base = now + quietest_offset(poll, self.polls, now)
            poll.phase = (poll.base - self._epoch) % poll.period
        else:
            past = floor((now - self._epoch - poll.phase) / poll.period)
            poll.base = self._epoch + poll.phase + (past + 1) * poll.period
        poll.number = 0
        poll.active = True
        self.polls.append(poll)
        heapq.heappush(self._heap, (poll.base, next(self._order), poll))

    def remove(self, poll: Poll) -> None:
        if poll.active:
            poll.active = False
            self.polls.remove(poll)
            self._heap = [entry for entry in self._heap if entry[2] is not poll]
            heapq.heapify(self._heap)

    def next_due(self) -> float:
        return self._heap[0][0] if self._heap else inf

    def release(self, now: float) -> list[Poll]:
        """The polls whose cycle starts now, each with `due` set. Cycles that could not start are counted missed."""
        starting: list[Poll] = []
        heap = self._heap
        while heap and heap[0][0] <= now:
            poll = heap[0][2]
            behind = floor((now - poll.base) / poll.period) - poll.number
            if behind > 0 and not poll.paused:
                poll.missed += behind
            poll.number += max(behind, 0)
            due = poll.next_due()
            poll.number += 1
            heapq.heapreplace(heap, (poll.next_due(), next(self._order), poll))
            if poll.paused:
                continue
            if poll.remaining:
                poll.missed += 1
                continue
            poll.due = due
            poll.demanded = False
            starting.append(poll)
        return starting


def begin_cycle(poll: Poll, now: float) -> list[Transaction]:
    """Make the poll's transactions fresh; returns them, ready to be queued."""
    if poll.fresh is not None:
        poll.results, poll.fresh = poll.fresh, None
    poll.remaining = len(poll.results)
    poll.started = -inf
    poll.cycles += 1
    deadline = poll.due + poll.period
    for transaction in poll.results:
        transaction.reset()
        transaction.queued = now
        transaction.deadline = deadline
    return list(poll.results)


def set_members(poll: Poll, members: Iterable[Transaction], priority: Priority = Priority.POLL) -> None:
    """Give a poll its transactions, from its next cycle on."""
    fresh = tuple(members)
    for transaction in fresh:
        transaction.poll = poll
        transaction.priority = priority
    poll.fresh = fresh


def quietest_offset(poll: Poll, others: Sequence[Poll], now: float) -> float:
    """Seconds from `now`, below the period, at which this poll's cycles meet the others' least.

    Tried are now itself and every moment at which another poll's cycle ends: an optimal packing exists among those.
    Among equals the earliest wins.
    """
    busy = [other for other in others if other.cost > 0]
    if not busy:
        return 0.0
    candidates = {0.0}
    for other in busy:
        steps = max(1, round(poll.period / other.period))
        for k in range(steps + 1):
            candidates.add((other.base + other.cost - now + k * other.period) % poll.period)
    horizon = now + HORIZON * max(p.period for p in (*busy, poll))
    return min(sorted(candidates), key=lambda offset: round(_overlap(poll, now + offset, busy, horizon), 6))


def _overlap(poll: Poll, start: float, others: Sequence[Poll], horizon: float) -> float:
    """Seconds in which this poll's cycles and the others' want the line at once, up to the horizon."""
    total = 0.0
    cycles = max(1, min(512, int((horizon - start) / poll.period)))
    cost = max(poll.cost, 1e-6)
    for k in range(cycles):
        begin = start + k * poll.period
        end = begin + cost
        for other in others:
            n = floor((begin - other.base - other.cost) / other.period) + 1
            while True:
                at = other.base + n * other.period
                if at >= end:
                    break
                total += max(0.0, min(end, at + other.cost) - max(begin, at))
                n += 1
    return total
