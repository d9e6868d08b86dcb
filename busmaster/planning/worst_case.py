"""The longest wait for the line in the worst case.

The worst case is that of R9: each exchange takes as long as an exchange can, and everything that may go first goes
first. It is valid while each request causes at most one reply (R3), even one that arrives byte by byte. On a line that
is never silent requests do not wait longer, but fail with LineNoisy.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import dataclass
from math import ceil
from typing import Any, NamedTuple, TypeAlias

from busmaster.arbiter.backlog import SHARE
from busmaster.arbiter.choice import MOST_BEFORE
from busmaster.arbiter.schedule import Priority, line_time
from busmaster.arbiter.shared_backlog import PASSED_BY_EACH
from busmaster.arbiter.unexpected import NOISY_AFTER, QUIET
from busmaster.contract.exchange import Command, Exchange
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.planning.merging import WEIGHING, at_once


@dataclass(frozen=True, slots=True)
class PlannedNode:
    """A node in the planner. `reply_time`: seconds from a request to its reply, if known or measured."""

    profile: Profile
    address: int
    timings: Timings | None = None
    reply_time: float | None = None

    def open(self, command: Command[Any]) -> Exchange[Any]:
        """Open the exchange of a command to this node, with its own timings or else its profile's."""
        return command.open(self.address, self.timings or self.profile.timings)

    def line_time(self, command: Command[Any], byte_time: float) -> float:
        """Return the line time, in seconds, of one undisturbed attempt."""
        return line_time(self.open(command), byte_time, self.reply_time)


Read: TypeAlias = tuple[PlannedNode, Command[Any]]


class Sharing(NamedTuple):
    """The number of other programs on the line, and the longest time, in seconds, for which a sequence can hold it."""

    clients: int = 0
    held: float = 0.0


ALONE = Sharing()


def shape(exchange: Exchange[Any]) -> tuple[object, ...]:
    """Return the properties, besides its timings, that determine how long an exchange can take."""
    later = tuple((step.sent, step.sizes.longest) for step in exchange.later)
    return len(exchange.request), exchange.sizes.longest, later


def longest_hold(exchange: Exchange[Any], byte_time: float, receive_latency: float = 0.0) -> float:
    """Return the longest time, in seconds, for which one attempt can occupy the line, without repetitions in it.

    This is the H of R9, resynchronisation included. Each step takes the request, its maximum reply delay and its
    longest reply; then follows the silence after the last byte, which a slow reply delays.
    """
    before = worst = 0.0
    steps = [(len(exchange.request), exchange.timing, exchange.sizes)]
    steps += ((step.sent, step.timing, step.sizes) for step in exchange.later)
    for sent, timing, sizes in steps:
        request_end = before + sent * byte_time + receive_latency
        begins = timing.max_reply_delay + byte_time
        whole = (
            begins + sizes.longest * byte_time + timing.inter_byte_timeout
        )  # then the step ends, even if bytes still arrive
        quiet = max(QUIET, timing.inter_byte_timeout) + receive_latency + byte_time
        # Each byte delays the silence. But a line without silence becomes NOISY: requests do not wait longer, but fail
        # with LineNoisy.
        trickles = min(begins + sizes.longest * quiet, whole + NOISY_AFTER + quiet)
        worst = max(worst, request_end + trickles + quiet)
        before = request_end + whole
    return worst + exchange.closing * byte_time + exchange.timing.driver_release_time


def unanswered(exchange: Exchange[Any], byte_time: float) -> float:
    """Return the time, in seconds, for which one attempt occupies the line if no byte of a reply arrives."""
    return len(exchange.request) * byte_time + max(exchange.timing.max_reply_delay, exchange.timing.driver_release_time)


@dataclass(frozen=True, slots=True)
class Bounds:
    """The longest time until a request of each class is sent (R9), with this many polled exchanges on the line.

    `hold`: longest hold of one exchange. `urgent_hold`: the same while an urgent request waits, when nothing is
    repeated within an exchange. The bounds of COMMAND and below are valid while URGENT requests are rare.
    """

    hold: float
    urgent_hold: float
    polls: int = 0
    background: int = 0
    patience: float = 1.0
    """Longest time, in seconds, for which later polls with a shorter period can go before a poll."""
    clients: int = 0
    """Number of other programs that share the line and take turns with this one."""
    held: float = 0.0
    """Longest time, in seconds, for which the line can be held for one sequence of requests."""

    def wait(self, priority: Priority, *, ahead: int = 0, patience: float | None = None) -> float:
        """Return the longest time, in seconds, until a request of this class is sent.

        `ahead`: number of queued URGENT or COMMAND requests of this program. For URGENT, this is the wait of a write.
        Before each request, MOST_BEFORE others may go if its reply could be ambiguous (R15). An urgent write is never
        held back for this; an urgent read waits for that many more. Each other program may go before it twice. Each
        exchange may be a sequence for which the line is held; a lower class has a slot behind each of those.
        """
        each = 1 + MOST_BEFORE
        turn = 1 + PASSED_BY_EACH * self.clients
        ahead = (ahead + 1) * turn - 1
        if priority is Priority.URGENT:
            return self.urgent_hold * (1 + each * ahead)
        hold = self.hold + self.held
        if priority is Priority.COMMAND:
            lower = ahead + 1 if self.held else ceil((ahead + 1) / SHARE)
            return hold * (1 + each * (ahead + lower) + MOST_BEFORE)
        turns = SHARE + 1
        if priority is Priority.BACKGROUND or self.background:
            turns *= 2
        rivals = turn * max(1, self.background if priority is Priority.BACKGROUND else self.polls)
        return (self.patience if patience is None else patience) + each * turns * rivals * hold


def bounds(
    reads: Iterable[Read],
    byte_time: float,
    receive_latency: float = 0.0,
    *,
    polls: int = 0,
    background: int = 0,
    sharing: Sharing = ALONE,
) -> Bounds:
    """Return the bounds for a line with only these requests and a probe of each node."""
    return at_once(bound_steps(reads, byte_time, receive_latency, polls, background, sharing))


def bound_steps(
    reads: Iterable[Read], byte_time: float, receive_latency: float, polls: int, background: int, sharing: Sharing
) -> Generator[int, None, Bounds]:
    """Calculate as `bounds` does, in steps. Each yields the units of work it took, of about a microsecond."""
    hold = urgent_hold = 0.0
    probed: set[tuple[int, int]] = set()
    for node, command in reads:
        asked = [command]
        alike = (id(node.profile), id(node.timings))
        if alike not in probed and node.address != node.profile.broadcast:
            probed.add(alike)
            asked.append(node.profile.probe)
        for each in asked:
            longest = longest_hold(node.open(each), byte_time, receive_latency)
            hold = max(hold, longest + (node.profile.exchange_limit or 0.0))
            urgent_hold = max(urgent_hold, longest)
        yield WEIGHING
    return Bounds(hold, urgent_hold, polls, background, clients=sharing.clients, held=sharing.held)
