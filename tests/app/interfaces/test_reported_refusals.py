"""What an interface refuses, as it reports it to the owner of the line."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from typing import Any, cast

import pytest

from busmaster.app.interfaces import reported_refusals
from busmaster.app.interfaces.following import Following
from busmaster.app.interfaces.reported_refusals import ReportedRefusals
from busmaster.errors import LineDown


class Owner:
    """A line whose owner is away at first."""

    def __init__(self) -> None:
        self.is_connected = False
        self.reported: list[tuple[str, str, dict[str, int]]] = []
        self.changed: Callable[[], None] = lambda: None
        self.remote = self
        self.got = asyncio.Event()

    def on_state(self, changed: Callable[[], None]) -> None:
        self.changed = changed

    def report_refusals(self, interface: str, kind: str, peers: Mapping[str, int]) -> None:
        if not self.is_connected:
            raise LineDown("away")
        self.reported.append((interface, kind, dict(peers)))
        self.got.set()


@pytest.mark.asyncio
async def test_each_refusal_is_reported_once_and_kept_while_the_owner_is_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reported_refusals, "REPORT_EVERY", 0.0)
    owner = Owner()
    refusals = ReportedRefusals("modbus-tcp", cast("Following", cast("Any", owner)), "connections", "requests")
    refusals.note("requests", "10.0.0.1")
    refusals.note("requests", "10.0.0.1")
    await asyncio.sleep(0)
    assert owner.reported == []
    owner.is_connected = True
    owner.changed()
    assert owner.reported == [("modbus-tcp", "connections", {}), ("modbus-tcp", "requests", {"10.0.0.1": 2})]
    owner.reported.clear()
    owner.got.clear()
    refusals.note("connections", "10.0.0.2")
    await owner.got.wait()
    assert owner.reported == [("modbus-tcp", "connections", {"10.0.0.2": 1})]
