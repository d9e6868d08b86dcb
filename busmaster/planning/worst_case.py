"""How long can anybody wait for the line, in the worst case?

The worst case is that of R9: every exchange lasts as long as an exchange can, and whatever may go first goes first. It
holds while each request causes at most one reply (R3), be it one that trickles in byte by byte; on a line that is
never silent nobody waits longer either, but fails with LineNoisy.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import dataclass
from math import ceil
from typing import Any, TypeAlias

from busmaster.arbiter.backlog import SHARE
from busmaster.arbiter.choice import MOST_BEFORE
from busmaster.arbiter.schedule import Priority, line_time
from busmaster.arbiter.unasked import NOISY_AFTER, QUIET
from busmaster.contract.exchange import Command, Exchange
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.planning.merging import WEIGHING, at_once


@dataclass(frozen=True, slots=True)
class PlannedNode:
    """A node as the planner sees it. `reply_time`: seconds from a request to its reply, if known or measured."""

    profile: Profile
    address: int
    timings: Timings | None = None
    reply_time: float | None = None

    def open(self, command: Command[Any]) -> Exchange[Any]:
        """Open the exchange of a command to this node, by its own timings or else its profile's."""
        return command.open(self.address, self.timings or self.profile.timings)

    def line_time(self, command: Command[Any], byte_time: float) -> float:
        """Return the seconds of the line that one undisturbed attempt takes."""
        return line_time(self.open(command), byte_time, self.reply_time)


Read: TypeAlias = tuple[PlannedNode, Command[Any]]


def shape(exchange: Exchange[Any]) -> tuple[object, ...]:
    """Return what, beside its timings, tells how long an exchange can take: two of one shape take equally long."""
    later = tuple((leg.sent, leg.sizes.longest) for leg in exchange.later)
    return len(exchange.request), exchange.sizes.longest, later


def longest_hold(exchange: Exchange[Any], byte_time: float, receive_latency: float = 0.0) -> float:
    """Return for how many seconds one attempt can keep the line from others, if nothing is repeated in it.

    Its settle is included. It is the H of R9: each leg's request, its window (or lateness) and its longest reply; then
    the silence after the last byte, which a reply that trickles in puts off.
    """
    before = worst = 0.0
    legs = [(len(exchange.request), exchange.timing, exchange.sizes)]
    legs += ((leg.sent, leg.timing, leg.sizes) for leg in exchange.later)
    for sent, timing, sizes in legs:
        said = before + sent * byte_time + receive_latency
        whole = timing.window + timing.byte_gap + sizes.longest * byte_time
        quiet = max(QUIET, timing.byte_gap) + receive_latency + byte_time
        trickle = min(sizes.longest * quiet, NOISY_AFTER + quiet)
        worst = max(worst, said + max(whole, timing.lateness + byte_time) + trickle + quiet)
        before = said + whole
    return worst + exchange.closing * byte_time + exchange.timing.turnaround


def unanswered(exchange: Exchange[Any], byte_time: float) -> float:
    """Return for how many seconds one attempt keeps the line from others if no byte of a reply comes."""
    return len(exchange.request) * byte_time + max(exchange.timing.lateness, exchange.timing.turnaround)


@dataclass(frozen=True, slots=True)
class Bounds:
    """How long a request of each class can wait until it is sent (R9), with so many exchanges polled on the line.

    `hold` is the longest hold of one exchange, `urgent_hold` the longest while an urgent request waits: then nothing
    is repeated within an exchange. Those of COMMAND and below hold as long as URGENT is rare.
    """

    hold: float
    urgent_hold: float
    polls: int = 0
    background: int = 0
    patience: float = 1.0
    """The longest time, in seconds, for which a poll lets later ones with a shorter period pass."""

    def wait(self, priority: Priority, *, ahead: int = 0, patience: float | None = None) -> float:
        """Return how long, in seconds, a request of this class waits at most until it is sent.

        `ahead` says how many of URGENT or COMMAND wait already. Of URGENT, it is the wait of a write. Before each
        request, MOST_BEFORE others may go while an answer could be taken for its own (R15); an urgent write is never
        held back so, an urgent read waits for so many more.
        """
        each = 1 + MOST_BEFORE
        if priority is Priority.URGENT:
            return self.urgent_hold * (1 + each * ahead)
        if priority is Priority.COMMAND:
            return self.hold * (1 + each * (ahead + ceil((ahead + 1) / SHARE)) + MOST_BEFORE)
        turns = SHARE + 1
        if priority is Priority.BACKGROUND or self.background:
            turns *= 2
        rivals = self.background if priority is Priority.BACKGROUND else self.polls
        return (self.patience if patience is None else patience) + each * turns * max(1, rivals) * self.hold


def bounds(
    reads: Iterable[Read], byte_time: float, receive_latency: float = 0.0, *, polls: int = 0, background: int = 0
) -> Bounds:
    """Return the bounds for a line on which nothing else is asked than these, and every node's probe."""
    return at_once(bound_steps(reads, byte_time, receive_latency, polls, background))


def bound_steps(
    reads: Iterable[Read], byte_time: float, receive_latency: float, polls: int, background: int
) -> Generator[int, None, Bounds]:
    """Do what `bounds` does in steps: each yields how many units of work it took, of about a microsecond."""
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
    return Bounds(hold, urgent_hold, polls, background)
