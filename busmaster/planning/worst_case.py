"""How long can anybody wait for the line, in the worst case?

The worst case is that of R9: every exchange lasts as long as an exchange can, and whatever may go first goes first. It
holds while each request causes at most one reply (R3), be it one that trickles in byte by byte; on a line that is
never silent nobody waits longer either, but fails with LineNoisy.
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


class Sharing(NamedTuple):
    """Who shares a line: so many other programs, and the longest time, in seconds, for which a sequence holds it."""

    clients: int = 0
    held: float = 0.0


ALONE = Sharing()


def shape(exchange: Exchange[Any]) -> tuple[object, ...]:
    """Return what, beside its timings, tells how long an exchange can take: two of one shape take equally long."""
    later = tuple((step.sent, step.sizes.longest) for step in exchange.later)
    return len(exchange.request), exchange.sizes.longest, later


def longest_hold(exchange: Exchange[Any], byte_time: float, receive_latency: float = 0.0) -> float:
    """Return for how many seconds one attempt can keep the line from others, if nothing is repeated in it.

    Its resynchronise is included. It is the H of R9: each step's request, its maximum reply delay and its longest
    reply; then the silence after the last byte, which a reply that trickles in puts off.
    """
    before = worst = 0.0
    steps = [(len(exchange.request), exchange.timing, exchange.sizes)]
    steps += ((step.sent, step.timing, step.sizes) for step in exchange.later)
    for sent, timing, sizes in steps:
        said = before + sent * byte_time + receive_latency
        begins = timing.max_reply_delay + byte_time
        whole = (
            begins + sizes.longest * byte_time + timing.inter_byte_timeout
        )  # then the step is over, whatever still trickles in
        quiet = max(QUIET, timing.inter_byte_timeout) + receive_latency + byte_time
        # Each byte puts the silence off; but a line that is not silent for longer is NOISY: nobody waits longer, but
        # fails with LineNoisy.
        trickles = min(begins + sizes.longest * quiet, whole + NOISY_AFTER + quiet)
        worst = max(worst, said + trickles + quiet)
        before = said + whole
    return worst + exchange.closing * byte_time + exchange.timing.driver_release_time


def unanswered(exchange: Exchange[Any], byte_time: float) -> float:
    """Return for how many seconds one attempt keeps the line from others if no byte of a reply comes."""
    return len(exchange.request) * byte_time + max(exchange.timing.max_reply_delay, exchange.timing.driver_release_time)


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
    clients: int = 0
    """How many other programs share the line, and take turns with this one."""
    held: float = 0.0
    """The longest time, in seconds, for which the line may be held for one sequence of requests."""

    def wait(self, priority: Priority, *, ahead: int = 0, patience: float | None = None) -> float:
        """Return how long, in seconds, a request of this class waits at most until it is sent.

        `ahead` says how many of URGENT or COMMAND wait already, of this program. Of URGENT, it is the wait of a write.
        Before each request, MOST_BEFORE others may go while an answer could be taken for its own (R15); an urgent write
        is never held back so, an urgent read waits for so many more. Each other program may go before it twice, and
        each exchange may be a sequence for which the line is held; a lower class has a slot behind each of those.
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
    """Return the bounds for a line on which nothing else is asked than these, and every node's probe."""
    return at_once(bound_steps(reads, byte_time, receive_latency, polls, background, sharing))


def bound_steps(
    reads: Iterable[Read], byte_time: float, receive_latency: float, polls: int, background: int, sharing: Sharing
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
    return Bounds(hold, urgent_hold, polls, background, clients=sharing.clients, held=sharing.held)
