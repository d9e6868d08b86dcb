"""Polls on a fixed grid (R10), and the line time of an exchange.

Each call does a bounded amount of work, however many polls there are and however much they read, so that the event loop
is never blocked. Remaining work is due immediately, after the loop has served the line.

The phase at which a new poll overlaps least with the others is searched in slices.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from itertools import count, islice
from math import ceil, floor, inf
from typing import Any, Protocol

from busmaster.arbiter.transaction import BACKGROUND, POLL, Poll, Priority, Transaction
from busmaster.contract.exchange import Exchange
from busmaster.errors import InvalidCommand

KINKS = 2000
"""Limit for the work of choosing one phase. About 2000 kinks take a millisecond."""
STRIDE = 64
"""Kinks, or other polls, examined between two points at which the search can be interrupted."""
MEETINGS = 8
"""Two polls whose cycles take longer than this many common divisors of their periods overlap at any phase."""
ROUNDING = 1e-7


class Recurring(Protocol):
    """Occupies the line for `cost` seconds from base + k x period on. All times are in seconds."""

    @property
    def base(self) -> float: ...
    @property
    def cost(self) -> float: ...
    @property
    def period(self) -> float: ...


Pair = tuple[float, float, float, float]
"""Another poll: its begin and its length on a circle, the length of the circle, and the poll's frequency on it."""


def quietest_offset(
    poll: Recurring, others: Iterable[Recurring], now: float, stretch: float = 1.0
) -> Generator[int, None, float]:
    """Find the offset from `now`, in seconds below the period, at which this poll's cycles overlap least with the
    others.

    A generator that returns the offset. In between it yields how much it has examined since, never much more than
    STRIDE. All costs are multiplied by `stretch`. The time in which two polls need the line at once is a piecewise
    linear function of their offset modulo the common divisor of their periods. The minimum of the sum lies at one of
    the kinks. The earliest minimum is used. The search ends early if there are too many kinks.
    """
    # Stretched over the available time: cycles that just fit one behind the other would overlap as soon as one of them
    # takes longer than calculated.
    # A cycle longer than its period occupies all of it. More would count the same time twice.
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
        # Otherwise the overlap is nearly the same at each phase: the pair would only cost time here.
        if own + length < MEETINGS * step:
            pairs.append(((other.base - now) % step, length, step, step / other.period))
            before += (own + length) / step + 1
            frequency += 1 / step
            nearest = min(nearest, step)
        if number % STRIDE == 0:
            yield STRIDE
    if not pairs:
        return 0.0
    # Four kinks per meeting. At least up to the nearest divisor, within which every overlap with one poll occurs once.
    reach = min(poll.period, max((KINKS / 4 - before) / frequency, nearest))
    return (yield from _least(pairs, own, reach, 1 + int(4 * reach * frequency / STRIDE)))


def _least(pairs: Iterable[Pair], own: float, reach: float, pieces: int) -> Generator[int, None, float]:
    """Add up the slope changes of the overlap, sorted into `pieces` parts of the way, then walk to the minimum."""
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
            # The sums of thousands of floats are not exact: a residue of 1e-12 s is not an overlap.
            if least <= ROUNDING:
                return best  # no overlap here, and the earliest minimum is used
            overlap += slope * (x - at)
            slope += piece[x]
            at = x
            if overlap < least - ROUNDING:
                best, least = x, overlap
        yield len(piece)
    return best


def _kinks(pair: Pair, own: float, reach: float) -> Iterator[tuple[float, float]]:
    """Yield where the overlap with another poll changes its slope, from before 0 up to `reach`, and by how much."""
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
    """Return the largest time of which both periods are multiples, within a ten-thousandth of the shorter one."""
    first, second = max(first, second), min(first, second)
    least = 1e-4 * second
    while second > least:
        first, second = second, abs(first - second * round(first / second))
    return first


FILL = 0.9
"""Cycles are spread over this share of the time when phases are chosen. The rest is reserve for variation."""
SLICE = 128
"""Units of work, of about a microsecond each, done in one call for polls that cannot start yet."""
AT_ONCE = 32
"""Cycles, and exchanges of cycles, started in one call."""


def line_time(exchange: Exchange[Any], byte_time: float, reply_time: float | None = None) -> float:
    """Return the line time, in seconds, of one undisturbed attempt.

    It contains the bytes in both directions and the wait before each reply step. `reply_time`: the node's measured time
    to its first byte. If it is None, half of `late_after` is assumed. Merging, phases and planning all use this
    function.
    """
    sent = len(exchange.request) + exchange.closing
    timing = exchange.timing
    if not exchange.answered:
        return sent * byte_time + timing.driver_release_time
    wait = timing.late_after / 2 if reply_time is None else reply_time
    # The typical size, not the longest: with the longest, a line of short values would look twice as busy.
    total = (sent + exchange.sizes.typical) * byte_time + wait + timing.driver_release_time
    for step in exchange.later:
        wait = step.timing.late_after / 2 if reply_time is None else reply_time
        total += (step.sent + step.sizes.typical) * byte_time + wait
    return total


class Schedule:
    """All polls of a line and their due times."""

    def __init__(self) -> None:
        self.polls: dict[Poll, None] = {}
        self._heap: list[tuple[float, int, Poll]] = []
        self._order = count()
        self._epoch = inf
        # what cannot start yet
        self._work_at = inf
        self._preparing: deque[Poll] = deque()
        self._unplaced: list[tuple[float, int, Poll]] = []
        self._placing: tuple[Poll, float, Generator[int, None, float]] | None = None
        # what starts
        self._demanded: deque[Poll] = deque()
        self._cycles: deque[tuple[Poll, Iterator[Transaction]]] = deque()
        self._left_over_at = inf

    def add(self, poll: Poll, now: float) -> None:
        """Add a poll. Without a given phase it gets one when it is first due: polls added together are placed jointly.

        Raises InvalidCommand for a poll that is or was on the schedule.
        """
        if poll.active or poll.cycles:
            raise InvalidCommand(f"poll group {poll.name!r} is or was running: make a new one")
        # The first poll sets the origin of all phases, so that a phase in LINE.toml means the same after a restart.
        self._epoch = min(self._epoch, now)
        poll.active = True
        self.polls[poll] = None
        self.prepare(poll, now)

    def prepare(self, poll: Poll, now: float) -> None:
        """Start the poll's preparation. One slice of work is done immediately, unless other work is pending."""
        if not poll.active:
            return
        if poll.preparation is None:
            self._prepared(poll, now)
            return
        # A single group starts in the same call; many that are added together share the slices of later calls.
        left = 0 if self.unplaced() else SLICE
        if poll not in self._preparing:
            self._preparing.append(poll)
        while self._preparing and left > 0:
            left -= self._prepare(now)
        self._work_at = now if self.unplaced() else inf

    def remove(self, poll: Poll) -> None:
        """Remove a poll. Its planned cycles are skipped."""
        if poll.active:
            poll.active = False
            poll.preparation = None
            del self.polls[poll]
            # Its heap entry stays until it is due, and is removed in bulk if removed polls outnumber the others: a
            # removal must not walk over all polls.
            if len(self._heap) > 2 * len(self.polls) + AT_ONCE:
                self._heap = [entry for entry in self._heap if entry[2].active]
                heapq.heapify(self._heap)
            if not self.unplaced():
                self._work_at = inf

    def demand(self, poll: Poll) -> None:
        """Run one cycle outside the grid, with the next call of `begin`. A poll in preparation runs it afterwards."""
        if poll.preparation is not None:
            poll.wanted = True
        else:
            self._demanded.append(poll)

    def next_due(self) -> float:
        """Return when the next cycle, preparation or remaining work is due; inf if nothing is."""
        heap = self._heap
        # Removed polls are skipped here: removing them from the middle of the heap would cost a search.
        while heap and not heap[0][2].active:
            heapq.heappop(heap)
        return min(heap[0][0] if heap else inf, self._work_at, self._left_over_at)

    def begin(self, now: float) -> list[Transaction]:
        """Return the transactions of the cycles that start now, ready to be queued: at most AT_ONCE."""
        due = self.release(now)
        while self._demanded:
            poll = self._demanded.popleft()
            # Cycles that are due now have not started yet, and at most one cycle of a poll is running (R10).
            # A demand while a cycle runs uses that cycle: a second one beside it would make both late.
            if poll.active and not poll.running and poll not in due:
                poll.due = now
                due.append(poll)
        self._cycles.extend((poll, begin_cycle(poll, now)) for poll in due)
        begun: list[Transaction] = []
        while self._cycles and len(begun) < AT_ONCE:
            poll, cycle = self._cycles[0]
            # A group of a thousand points is queued in pieces of 32, between which the line continues.
            fresh = list(islice(cycle, AT_ONCE - len(begun))) if poll.active else []
            begun += fresh
            if not fresh:
                self._cycles.popleft()
        self._left_over_at = now if self._cycles else inf
        return begun

    def release(self, now: float) -> list[Poll]:
        """Return the polls whose cycle starts now, with `due` set. Cycles that could not start are counted as
        missed."""
        if self._work_at <= now:
            self.work(now)
        starting: list[Poll] = []
        # Bounded: a thousand cycles due at the same moment would block the loop for all other lines.
        heap = self._heap
        for _ in range(AT_ONCE):
            if not heap or heap[0][0] > now:
                break
            poll = heap[0][2]
            if not poll.active:
                heapq.heappop(heap)
            elif self._starts(poll, now):
                starting.append(poll)
        return starting

    def _starts(self, poll: Poll, now: float) -> bool:
        """Reinsert the first poll of the heap at its next due time. Returns True if its cycle starts."""
        # From the number of the period and never by adding periods up: sums of floats drift, and a grid must not (R10).
        behind = floor((now - poll.base) / poll.period) - poll.number
        if poll.base + (poll.number + max(behind, 0) + 1) * poll.period <= now:
            behind = max(behind, 0) + 1  # The quotient was rounded down although the next cycle is due exactly now.
        if behind > 0:
            poll.number += behind
            # After a stopped process, hundreds of periods can have passed: they are counted, not caught up.
            poll.missed += 0 if poll.paused else behind
        due = poll.next_due()
        poll.number += 1
        heapq.heapreplace(self._heap, (poll.next_due(), next(self._order), poll))
        if poll.paused:
            return False
        # R10: a cycle that cannot start is missed and counted; it is never queued behind the running one.
        if poll.remaining:  # The last cycle is still running: a second one beside it would make both late.
            poll.missed += 1
            return False
        poll.due = due
        return True

    # what cannot start yet

    def work(self, now: float) -> None:
        """Do one slice. Short periods are placed first: their free time repeats, and longer periods fit into it."""
        left = SLICE
        while left > 0 and self.unplaced():
            left -= self._prepare(now) if self._preparing else self._place(now)
        if not self.unplaced():
            self._work_at = inf

    def unplaced(self) -> bool:
        """Return True if a poll cannot start yet. Further calls of `work` or `release` prepare or place it."""
        while self._preparing and not self._preparing[0].active:
            self._preparing.popleft()
        while self._unplaced and not self._unplaced[0][2].active:
            heapq.heappop(self._unplaced)
        if self._placing is not None and not self._placing[0].active:
            self._placing = None
        return bool(self._preparing or self._unplaced) or self._placing is not None

    def _prepare(self, now: float) -> int:
        """Do one step of a poll's preparation. Returns the units used."""
        poll = self._preparing[0]
        units = None if poll.preparation is None else next(poll.preparation, None)
        if units is not None:
            return units
        self._preparing.popleft()
        poll.preparation = None
        self._prepared(poll, now)
        return 1

    def _prepared(self, poll: Poll, now: float) -> None:
        # A phase given by the user counts from the first poll of the line, so that phases of groups are comparable.
        if poll.phase is not None and not poll.placed:
            self._start(poll, self._epoch + poll.phase, now)
        elif not poll.placed:
            heapq.heappush(self._unplaced, (poll.period, next(self._order), poll))
            self._work_at = now
        if poll.wanted:
            poll.wanted = False
            self._demanded.append(poll)

    def _place(self, now: float) -> int:
        """Do one step of placing a poll. Returns the units used."""
        if self._placing is None:
            poll = heapq.heappop(self._unplaced)[2]
            self._placing = poll, now, self._search(poll, now)
        poll, since, search = self._placing
        try:
            return next(search)
        except StopIteration as found:
            base = since + found.value  # The search may take several slices; its offset counts from its start.
            poll.phase = (base - self._epoch) % poll.period
            self._start(poll, base, now)
            self._placing = None
            return 1

    def _search(self, poll: Poll, now: float) -> Generator[int, None, float]:
        """Find the phase with the least overlap with the placed polls, spread over the time that the load needs."""
        # Spread over the time that the load needs: on a nearly idle line there would be long gaps otherwise.
        load = 0.0
        others = []
        # a copy: polls can be added and removed between two slices
        for number, other in enumerate(tuple(self.polls), 1):
            load += other.cost / other.period
            if other.placed:
                others.append(other)
            if number % STRIDE == 0:
                yield STRIDE
        return (yield from quietest_offset(poll, others, now, FILL / load if load else 1.0))

    def _start(self, poll: Poll, base: float, now: float) -> None:
        """Start the poll's grid with its first due time from now on."""
        poll.placed = True
        # Never in the past: the poll would start with missed cycles.
        poll.base = base + ceil((now - base) / poll.period) * poll.period
        poll.number = 0
        heapq.heappush(self._heap, (poll.base, next(self._order), poll))


def begin_cycle(poll: Poll, now: float) -> Iterator[Transaction]:
    """Start a cycle of the poll. Yields its transactions, each reset when it is taken, ready to be queued.

    A node that has never replied is read in BACKGROUND, so that absent nodes delay no other node at start-up.
    """
    # Members change between two cycles only, so that one cycle never mixes the old and the new ones.
    if poll.fresh is not None:
        poll.results, poll.fresh = poll.fresh, None
    poll.remaining = len(poll.results)
    poll.started = -inf
    poll.cycles += 1
    return _made_fresh(poll, now)


def _made_fresh(poll: Poll, now: float) -> Iterator[Transaction]:
    deadline = poll.due + poll.patience
    for transaction in poll.results:
        transaction.reset()
        transaction.queued = now
        transaction.deadline = deadline
        # Absent nodes would otherwise delay the first values of all others at start-up.
        transaction.priority = poll.priority if transaction.node.last_reply > -inf else BACKGROUND
        yield transaction


def set_members(poll: Poll, members: Iterable[Transaction], priority: Priority = POLL) -> None:
    """Set the transactions of a poll, from its next cycle on."""
    fresh = tuple(members)
    for transaction in fresh:
        transaction.poll = poll
    poll.fresh = fresh
    poll.priority = priority


__all__ = ["Poll", "Priority", "Schedule", "begin_cycle", "line_time", "set_members"]
