"""Cost of lost frames for a schedule, with documented and with learned reply times."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Any

from busmaster.arbiter.learned import LEAST_SILENCE, window_of
from busmaster.arbiter.schedule import line_time
from busmaster.contract.exchange import Exchange
from busmaster.planning.worst_case import PlannedNode, unanswered

LOST = 0.01
"""Assumed share of lost frames in each direction."""
FAILED = (1 - LOST) ** -2 - 1
"""Resulting failed attempts per successful one."""


@dataclass(frozen=True, slots=True)
class Losses:
    """Line load of a schedule if a `share` of all frames is lost in each direction, and each is repeated.

    `documented`, `learned`: shares of the line with the reply times of the nodes, and with learned ones. `windows`:
    shortest and longest first window that would be learned, in seconds, if no reply takes longer than known; both are 0
    if nothing is read.
    """

    share: float
    documented: float
    learned: float
    windows: tuple[float, float]


class LostAttempts:
    """Cost of lost attempts for one group, in seconds of line time: `documented` or `learned`, for one of each
    exchange."""

    def __init__(self) -> None:
        self.documented = self.learned = 0.0
        self.windows = (inf, 0.0)

    def add(self, node: PlannedNode, exchange: Exchange[Any], byte_time: float) -> None:
        """Include one more exchange."""
        timing = exchange.timing
        usual = timing.late_after / 2 if node.reply_time is None else node.reply_time
        window = min(window_of(usual, usual), timing.window)
        # The line continues after the window and a short silence. A sync read proves that nothing more will arrive
        # (R15).
        silence = min(timing.inter_byte_timeout, LEAST_SILENCE * byte_time)
        check = line_time(node.open(node.profile.probe), byte_time, node.reply_time)
        documented = unanswered(exchange, byte_time)
        self.documented += documented
        self.learned += min(documented, len(exchange.request) * byte_time + window + silence + check)
        self.windows = (min(self.windows[0], window), max(self.windows[1], window))


def losses(utilisation: float, groups: list[tuple[float, LostAttempts]]) -> Losses:
    """Calculate the line load of a schedule that needs `utilisation` without losses.

    `groups`: the period of each in seconds, and its cost of lost attempts.
    """
    shortest = min((lost.windows[0] for _, lost in groups), default=inf)
    longest = max((lost.windows[1] for _, lost in groups), default=0.0)
    return Losses(
        share=LOST,
        documented=utilisation + FAILED * sum(lost.documented / period for period, lost in groups),
        learned=utilisation + FAILED * sum(lost.learned / period for period, lost in groups),
        windows=(shortest if shortest < inf else 0.0, longest),
    )
