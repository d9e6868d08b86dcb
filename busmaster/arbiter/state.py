"""The states of the one line."""

from __future__ import annotations

import enum


class LineState(enum.IntEnum):
    """The table on top of arbiter.py says what leads where."""

    OFFLINE = 0
    READY = 1
    HOLDOFF = 2
    EXCHANGE = 3
    SETTLING = 4


OFFLINE, READY, HOLDOFF, EXCHANGE, SETTLING = LineState
"""For the arbiter: to look a member up in its class takes 60 ns, and a transaction does it a dozen times."""
