"""For those who test with busmaster, or add to it: shipped, documented, and used by its own tests."""

from __future__ import annotations

from busmaster.testing.cases import Case, Foreign, NotConformant, RoundTrip, Tally, Unseen, answers_of
from busmaster.testing.protocol import check_protocol

__all__ = [
    "Case",
    "Foreign",
    "NotConformant",
    "RoundTrip",
    "Tally",
    "Unseen",
    "answers_of",
    "check_protocol",
]
