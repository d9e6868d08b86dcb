"""What lost frames cost a schedule: with the documents' reply times, and with learned ones."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Any

from busmaster.arbiter.learned import LEAST_SILENCE, window_of
from busmaster.arbiter.schedule import line_time
from busmaster.contract.exchange import Exchange
from busmaster.planning.worst_case import PlannedNode, unanswered

LOST = 0.01
"""The share of all frames, either way, that is calculated to be lost."""
FAILED = (1 - LOST) ** -2 - 1
"""Attempts that fail then, for each that succeeds."""


@dataclass(frozen=True, slots=True)
class Losses:
    """What a schedule asks of its line where `share` of all frames are lost, either way, and each is repeated.

    `documented` and `learned` are shares of the line: with the reply times that nodes have, and with learned ones.
    `windows` are the shortest and the longest first window that would be learned, in seconds, if no reply takes
    longer than is known; both are 0 where nothing is read.
    """

    share: float
    documented: float
    learned: float
    windows: tuple[float, float]


class LostAttempts:
    """What lost attempts cost one group, in seconds of the line: `documented` or `learned` for one of each exchange."""

    def __init__(self) -> None:
        self.documented = self.learned = 0.0
        self.windows = (inf, 0.0)

    def add(self, node: PlannedNode, exchange: Exchange[Any], byte_time: float) -> None:
        """Calculate with one more exchange."""
        timing = exchange.timing
        usual = timing.late_after / 2 if node.reply_time is None else node.reply_time
        window = min(window_of(usual, usual), timing.window)
        # The line goes on after the window and a short silence; a check shows that nothing is to come any more (R15).
        silence = min(timing.inter_byte_timeout, LEAST_SILENCE * byte_time)
        check = line_time(node.open(node.profile.probe), byte_time, node.reply_time)
        documented = unanswered(exchange, byte_time)
        self.documented += documented
        self.learned += min(documented, len(exchange.request) * byte_time + window + silence + check)
        self.windows = (min(self.windows[0], window), max(self.windows[1], window))


def losses(utilisation: float, groups: list[tuple[float, LostAttempts]]) -> Losses:
    """Calculate what a schedule asks of its line, that asks for `utilisation` of it while nothing is lost.

    `groups` has the period of each in seconds, and what lost attempts cost it.
    """
    shortest = min((lost.windows[0] for _, lost in groups), default=inf)
    longest = max((lost.windows[1] for _, lost in groups), default=0.0)
    return Losses(
        share=LOST,
        documented=utilisation + FAILED * sum(lost.documented / period for period, lost in groups),
        learned=utilisation + FAILED * sum(lost.learned / period for period, lost in groups),
        windows=(shortest if shortest < inf else 0.0, longest),
    )
