"""Replies that come after the window: whose value does the caller get?

Four callers read registers of two units; one reply in ten begins after the reply window has run out, but within the
maximum reply delay that the units are said to have. A reply of Modbus RTU names unit, function and size, but no
register.
"""

from __future__ import annotations

from benchmarks.harness import Options, Outcome
from benchmarks.modbus_masters import MAX_REPLY_DELAY, WINDOW
from benchmarks.trials import compare

MARGIN = 0.005
LATE = {"low": 0.002, "late_replies": 0.1, "late_reply_delay": (WINDOW + MARGIN, MAX_REPLY_DELAY - MARGIN)}
TITLE = "One reply in ten comes 105 to 145 ms after its request; the window is 100 ms"


def run(options: Options) -> Outcome:
    return compare(TITLE, "late replies", LATE, None, options)
