"""Replies that come after the window: whose value does the caller get?

Four callers read registers of two units; one reply in ten begins after the reply window has run out, but within the
lateness that the units are said to have. A reply of Modbus RTU names unit, function and size, but no register.
"""

from __future__ import annotations

from benchmarks.harness import Options, Outcome
from benchmarks.modbus_masters import LATENESS, WINDOW
from benchmarks.trials import compare

MARGIN = 0.005
LATE = {"low": 0.002, "stragglers": 0.1, "straggle": (WINDOW + MARGIN, LATENESS - MARGIN)}
TITLE = "One reply in ten comes 105 to 145 ms after its request; the window is 100 ms"


def run(options: Options) -> Outcome:
    return compare(TITLE, "late replies", LATE, None, options)
