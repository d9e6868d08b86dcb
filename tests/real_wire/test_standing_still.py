"""Short trials with real processes on real ports; `python -m tests.real_wire` has them all, and longer."""

from __future__ import annotations

import pytest

from tests.real_wire.kinds import KINDS
from tests.real_wire.trial import PORTS, Verdict, trial

STANDSTILLS = 3
LONGEST = 0.8
"""Seconds. Beyond a second, a node may be taken for dead, and is probed when the line can afford it (R11)."""
WITHIN = 1.0
"""Seconds until all nodes give good values again; besides, the node that does not exist takes a maximum reply delay
(MSC: 1 s)."""


def check(protocol: str, verdict: Verdict) -> None:
    assert not verdict.wrong
    assert not verdict.falsely_confirmed
    returns = [*verdict.back, *verdict.back_later]  # on a busy machine one may last longer than it was to
    assert len(returns) == STANDSTILLS
    # The quickest: what a busy machine adds is not the bus's. `python -m tests.real_wire` shows the longest.
    assert min(returns) <= WITHIN + KINDS[protocol].profile.timings.read.max_reply_delay


@pytest.mark.slow
@pytest.mark.parametrize(("port", "what"), [(port, what) for port, whats in PORTS.items() for what in whats])
def test_no_value_is_wrong_and_no_write_falsely_confirmed_whatever_stands_still(port: str, what: str) -> None:
    check("hcp2", trial("hcp2", port, what, STANDSTILLS, LONGEST))


@pytest.mark.slow
@pytest.mark.parametrize("protocol", [name for name in KINDS if name != "hcp2"])
def test_nor_with_any_other_protocol_behind_a_network_that_stands_still(protocol: str) -> None:
    check(protocol, trial(protocol, "tcp", "both", STANDSTILLS, LONGEST))
