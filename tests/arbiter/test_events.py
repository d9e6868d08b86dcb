"""What the arbiter tells its owner: records that nobody changes behind another's back."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, fields, is_dataclass
from typing import Any

import pytest

from busmaster.arbiter import events, learned
from busmaster.arbiter.events import NodeChanged
from busmaster.arbiter.health import Health
from tests.arbiter.bench import Bench

TOLD_ONCE = {events.Overdue, events.Sampled, events.Polled}
"""Made for each request or cycle and read once: where freezing them would cost each something."""
KINDS: list[Any] = [
    kind
    for module in (events, learned)
    for kind in vars(module).values()
    if isinstance(kind, type) and is_dataclass(kind) and kind.__module__ == module.__name__ and kind not in TOLD_ONCE
]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_what_is_told_never_changes(kind: Any) -> None:
    told = kind.__new__(kind)
    for each in fields(kind):
        with pytest.raises(FrozenInstanceError):
            setattr(told, each.name, None)


def test_an_event_prints_its_node_by_name_and_health() -> None:
    bench = Bench()
    node = bench.node(5)
    assert repr(NodeChanged(node, Health.UNKNOWN, Health.UP, False)).startswith(
        "NodeChanged(node=<hcp2 node 5, unknown>, before=<Health.UNKNOWN: 'unknown'>"
    )
