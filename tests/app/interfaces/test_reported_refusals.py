"""What an interface refuses, as it reports it to the owner of the line."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from typing import Any, cast

import pytest

from busmaster.app.interfaces import reported_refusals
from busmaster.app.interfaces.following import Following
from busmaster.app.interfaces.reported_refusals import FailedLogins, ReportedRefusals
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


def refusals_of(owner: Owner, *kinds: str) -> ReportedRefusals:
    return ReportedRefusals("modbus-tcp", cast("Following", cast("Any", owner)), *kinds)


async def until_reported(owner: Owner) -> list[tuple[str, str, dict[str, int]]]:
    """The next reports."""
    await owner.got.wait()
    owner.got.clear()
    reported, owner.reported = owner.reported, []
    return reported


@pytest.mark.asyncio
async def test_refusals_while_the_owner_is_away_are_tried_again_without_a_change_of_state(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reported_refusals, "REPORT_EVERY", 0.0)
    owner = Owner()
    refusals = refusals_of(owner, "connections", "requests")
    refusals.note("requests", "10.0.0.1")
    refusals.note("connections", "10.0.0.2")
    for _ in range(3):
        await asyncio.sleep(0)
    owner.is_connected = True
    assert await until_reported(owner) == [
        ("modbus-tcp", "connections", {"10.0.0.2": 1}),
        ("modbus-tcp", "requests", {"10.0.0.1": 1}),
    ]
    for _ in range(3):
        await asyncio.sleep(0)
    assert owner.reported == []


@pytest.mark.asyncio
async def test_of_too_many_peers_the_others_are_counted_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reported_refusals, "MOST_REPORTED", 2)
    monkeypatch.setattr(reported_refusals, "REPORT_EVERY", 0.0)
    owner = Owner()
    owner.is_connected = True
    refusals = refusals_of(owner, "requests")
    for peer in ("a", "b", "c", "d", "a"):
        refusals.note("requests", peer)
    assert await until_reported(owner) == [("modbus-tcp", "requests", {"a": 2, "b": 1, "others": 2})]


@pytest.mark.asyncio
async def test_a_failed_login_is_reported_here_and_to_the_owner(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reported_refusals, "REPORT_EVERY", 0.0)
    owner = Owner()
    owner.is_connected = True
    reports: list[str] = []
    FailedLogins("opcua", cast("Following", cast("Any", owner)), reports.append).note("10.0.0.1")
    assert reports == ["1 failed login at opcua: 1 from 10.0.0.1"]
    assert await until_reported(owner) == [("opcua", "logins", {"10.0.0.1": 1})]
