"""The bounds of the library. Input beyond a bound is rejected with its name. Times are in seconds.

The application has more of them, for its files and clients: `busmaster/app/bounds.py`.
"""

from __future__ import annotations

# Library

LONGEST_FILE = 4 << 20
"""Bytes of a file that is read whole. Such files are: LINE.toml, template, list of symbols, table of points, tokens,
learned reply times, certificate. A LINE.toml with 20 000 named points has about half of it."""
MOST_MEMBERS = 20_000
"""Points of all poll groups of a line, each as often as it is named; and those of any other list of points."""
SHORTEST_PERIOD = 0.001
"""Seconds from one cycle of a poll group to the next, at least."""
LONGEST_PERIOD = 86_400.0
"""Seconds from one cycle of a poll group to the next, at most: a day."""
MOST_RETRIES = 100
"""Times that a request is sent again after a failure."""
LONGEST_HOLD = 5.0
"""Seconds for which a line may be held for one sequence: no other request is sent meanwhile."""
LONGEST_SUSPENSION = 86_400.0
"""Seconds for which a node can be suspended: a day. A suspension does not end with the program that requested it."""

__all__ = [name for name in sorted(globals()) if name.isupper()]
