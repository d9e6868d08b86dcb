"""For those who test with busmaster, or add to it: shipped, documented, and used by its own tests."""

from __future__ import annotations

from busmaster.testing.cases import Case, Foreign, NotConformant, RoundTrip, Tally, Unseen
from busmaster.testing.protocol import check_protocol

__all__ = [
    "Case",
    "Foreign",
    "NotConformant",
    "RoundTrip",
    "Tally",
    "Unseen",
    "check_protocol",
]
