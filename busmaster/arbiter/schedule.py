"""Polls on a fixed grid (R10), and the line time that an exchange takes.

No call does more than a bounded amount of work, however many polls there are and however much they read: the loop
that owns the line is never held up. What is left over is due at once, so that the owner calls again when it has seen
to the line.

Where on its period a new poll meets the others least is found by a search that can be done a slice at a time.
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
    # takes longer than it was calculated.
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
                return best  # it meets nobody there, and among equals the earliest wins
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


FILL = 0.9
"""Cycles are spread over this share of the time when phases are chosen: the rest is left for what varies."""
SLICE = 128
"""Units of work, each of about a microsecond, that are done in one call for polls that cannot start yet."""
AT_ONCE = 32
"""Cycles, and exchanges of cycles, that are started in one call."""


def line_time(exchange: Exchange[Any], byte_time: float, reply_time: float | None = None) -> float:
    """Return the seconds of the line that one undisturbed attempt takes.

    These are bytes both ways, and the wait before each reply step. `reply_time` is the node's measured time to its
    first byte; where it is None, half of `late_after` is assumed. This is the one function by which merging, phases and
    planning weigh exchanges.
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
    """All polls of a line and when each is due next."""

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
        """Put a poll on it. One without a phase gets it when first due: those added together are placed jointly.

        Raises InvalidCommand for a poll that is, or was, on it.
        """
        if poll.active or poll.cycles:
            raise InvalidCommand(f"poll group {poll.name!r} is or was running: make a new one")
        self._epoch = min(self._epoch, now)
        poll.active = True
        self.polls[poll] = None
        self.prepare(poll, now)

    def prepare(self, poll: Poll, now: float) -> None:
        """Do the poll's preparation: as far as one slice of work goes at once, where no other work waits."""
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
        """Take a poll off the schedule: what is planned for it is left out when its turn comes."""
        if poll.active:
            poll.active = False
            poll.preparation = None
            del self.polls[poll]
            # Its entry stays until its turn comes, and is swept only where what was removed outgrows what is left: a
            # removal must not cost a walk over all polls.
            if len(self._heap) > 2 * len(self.polls) + AT_ONCE:
                self._heap = [entry for entry in self._heap if entry[2].active]
                heapq.heapify(self._heap)
            if not self.unplaced():
                self._work_at = inf

    def demand(self, poll: Poll) -> None:
        """Run one cycle off the grid, with the next call of `begin`; of a poll that is being prepared, after that."""
        if poll.preparation is not None:
            poll.wanted = True
        else:
            self._demanded.append(poll)

    def next_due(self) -> float:
        """Return when something is due next: a cycle, work, or what was left over; inf if nothing is."""
        heap = self._heap
        while heap and not heap[0][2].active:
            heapq.heappop(heap)
        return min(heap[0][0] if heap else inf, self._work_at, self._left_over_at)

    def begin(self, now: float) -> list[Transaction]:
        """Return the transactions, ready to be queued, of cycles that start now: at most AT_ONCE of them."""
        due = self.release(now)
        while self._demanded:
            poll = self._demanded.popleft()
            # What is due now does not run yet, and at most one cycle of a poll is under way (R10).
            if poll.active and not poll.running and poll not in due:
                poll.due = now
                due.append(poll)
        self._cycles.extend((poll, begin_cycle(poll, now)) for poll in due)
        begun: list[Transaction] = []
        while self._cycles and len(begun) < AT_ONCE:
            poll, cycle = self._cycles[0]
            fresh = list(islice(cycle, AT_ONCE - len(begun))) if poll.active else []
            begun += fresh
            if not fresh:
                self._cycles.popleft()
        self._left_over_at = now if self._cycles else inf
        return begun

    def release(self, now: float) -> list[Poll]:
        """Return the polls whose cycle starts now, `due` set. Cycles that could not start are counted missed."""
        if self._work_at <= now:
            self.work(now)
        starting: list[Poll] = []
        # Bounded, because a thousand cycles due at the same moment would block the loop of all other lines.
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
        """Put the first poll of the heap, which is due, back where it is due next. Returns whether its cycle starts."""
        # From the number of the period, never by adding periods up: sums of floats drift, and a grid must not (R10).
        behind = floor((now - poll.base) / poll.period) - poll.number
        if poll.base + (poll.number + max(behind, 0) + 1) * poll.period <= now:
            behind = max(behind, 0) + 1  # the quotient was rounded down across a cycle that the clock already stands on
        if behind > 0:
            poll.number += behind
            poll.missed += 0 if poll.paused else behind
        due = poll.next_due()
        poll.number += 1
        heapq.heapreplace(self._heap, (poll.next_due(), next(self._order), poll))
        if poll.paused:
            return False
        # R10: a cycle that cannot start is missed and counted; it is never queued behind the running one.
        if poll.remaining:  # its last cycle still runs: a second one beside it would only make both late
            poll.missed += 1
            return False
        poll.due = due
        return True

    # what cannot start yet

    def work(self, now: float) -> None:
        """Do one slice. Short periods are placed first: what is left free then repeats, and longer periods find it."""
        left = SLICE
        while left > 0 and self.unplaced():
            left -= self._prepare(now) if self._preparing else self._place(now)
        if not self.unplaced():
            self._work_at = inf

    def unplaced(self) -> bool:
        """Return whether some poll cannot start yet: further calls of `work` or `release` prepare it, or place it."""
        while self._preparing and not self._preparing[0].active:
            self._preparing.popleft()
        while self._unplaced and not self._unplaced[0][2].active:
            heapq.heappop(self._unplaced)
        if self._placing is not None and not self._placing[0].active:
            self._placing = None
        return bool(self._preparing or self._unplaced) or self._placing is not None

    def _prepare(self, now: float) -> int:
        """Do one step of a poll's preparation. Returns the units that it took."""
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
        """Do one step of placing a poll. Returns the units that it took."""
        if self._placing is None:
            poll = heapq.heappop(self._unplaced)[2]
            self._placing = poll, now, self._search(poll, now)
        poll, since, search = self._placing
        try:
            return next(search)
        except StopIteration as found:
            base = since + found.value  # the search may take several slices: its offset counts from when it began
            poll.phase = (base - self._epoch) % poll.period
            self._start(poll, base, now)
            self._placing = None
            return 1

    def _search(self, poll: Poll, now: float) -> Generator[int, None, float]:
        """Find where it meets least those that have their place, if all spread over the time that there is."""
        # The offsets are spread over the time that the load needs: a line that is nearly idle would leave long gaps.
        load = 0.0
        others = []
        for number, other in enumerate(tuple(self.polls), 1):  # a copy: polls come and go between two slices
            load += other.cost / other.period
            if other.placed:
                others.append(other)
            if number % STRIDE == 0:
                yield STRIDE
        return (yield from quietest_offset(poll, others, now, FILL / load if load else 1.0))

    def _start(self, poll: Poll, base: float, now: float) -> None:
        """Begin the poll's grid with its first time from now on."""
        poll.placed = True
        poll.base = base + ceil((now - base) / poll.period) * poll.period
        poll.number = 0
        heapq.heappush(self._heap, (poll.base, next(self._order), poll))


def begin_cycle(poll: Poll, now: float) -> Iterator[Transaction]:
    """Start a cycle of the poll: its transactions, each made fresh when it is taken, ready to be queued.

    A node that was never heard is read in BACKGROUND, so that absent nodes hold up nobody when a line starts.
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
    """Give a poll its transactions, from its next cycle on."""
    fresh = tuple(members)
    for transaction in fresh:
        transaction.poll = poll
    poll.fresh = fresh
    poll.priority = priority


__all__ = ["Poll", "Priority", "Schedule", "begin_cycle", "line_time", "set_members"]
