"""One refusal and one standstill, of some of the lengths that `python -m tests.campaigns.sweep` tries."""

from __future__ import annotations

import pytest

from tests.campaigns.kinds import KINDS
from tests.campaigns.sweep import SLOW, TRANSACTIONS, Sweep

FALSELY_CONFIRMED = (("msc", 1.3, False, False), ("msc", 1.3, False, True), ("msc", 0.64, True, True))
"""A write was confirmed by the second ACK of a sync read that was sent again for an overdue NAK."""
SOME = tuple((protocol, seconds, False, True) for protocol in KINDS for seconds in (0.16, 1.12))


@pytest.mark.parametrize(("protocol", "seconds", "strict", "learned"), [*FALSELY_CONFIRMED, *SOME])
def test_r15_a_refusal_that_is_held_up_confirms_no_write_and_brings_no_value(
    protocol: str, seconds: float, strict: bool, learned: bool
) -> None:
    sweep = Sweep(protocol, seconds, strict=strict, learned=learned)
    enough = SLOW.get(protocol, TRANSACTIONS)
    totals = sweep.run(enough)
    assert sweep.struck
    assert (totals.confused, totals.lost, totals.problems) == (0, 0, [])
    assert totals.good > enough / 2
