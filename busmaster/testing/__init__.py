"""Tools for testing programs that use busmaster, and protocols for it. busmaster's own tests use them too.

`check_protocol` and `check_dialect` are the conformance kit of a protocol. `run_in_virtual_time` runs an application on
a loop whose time jumps. `busmaster.testing.bench` measures latency against a budget. `busmaster.testing.fixtures` has
pytest fixtures.
"""

from __future__ import annotations

from busmaster.testing.cases import Case, Foreign, NotConformant, RoundTrip, Tally, Unseen, answers_of
from busmaster.testing.dialect import check_dialect
from busmaster.testing.protocol import check_protocol
from busmaster.testing.virtual_time import DeadlockError, VirtualTimeLoop, run_in_virtual_time

__all__ = [
    "Case",
    "DeadlockError",
    "Foreign",
    "NotConformant",
    "RoundTrip",
    "Tally",
    "Unseen",
    "VirtualTimeLoop",
    "answers_of",
    "check_dialect",
    "check_protocol",
    "run_in_virtual_time",
]
