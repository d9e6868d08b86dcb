"""A few of the faults, those that are quick and sure; `python -m tests.verification.plant` makes them all."""

from __future__ import annotations

import pytest

from tests.app.outputs.brokers import needs_mosquitto
from tests.tiers import one_by_default
from tests.verification.plant.faults import FAULTS
from tests.verification.plant.trial import trial

QUICK = ("kill", "port-gone", "broker-killed-spill", "csv-moved", "sqlite-moved", "disk-full", "1e308")

pytestmark = needs_mosquitto


@pytest.mark.parametrize("name", one_by_default(QUICK))
def test_nothing_is_lost_by_a_fault_that_is_not_counted_and_no_value_is_wrong(name: str) -> None:
    found = trial(FAULTS[name])
    assert not found.problems
    assert found.back


@pytest.mark.slow
def test_a_dead_node_in_the_safe_state_is_named_and_ends_with_1() -> None:
    found = trial(FAULTS["term-dead"])
    assert not found.problems
    assert any("safe state of winder/setpoint not confirmed" in line for line in found.told)
