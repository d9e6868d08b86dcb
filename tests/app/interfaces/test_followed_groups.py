"""The cycles of the poll groups of another program's line, which an interface follows: by a real socket."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import pytest

from busmaster import Hcp2Controller, Snapshot
from busmaster.app.interfaces import followed_groups, following
from busmaster.app.interfaces.followed_groups import FollowedGroups
from busmaster.app.service.remote import RemoteBus
from busmaster.app.service.remote_group import RemoteGroup
from busmaster.errors import InvalidCommand
from tests.app.interfaces.lines import followed, poll, shows
from tests.app.interfaces.test_following import connected
from tests.app.interfaces.test_modbus_tcp import Owner, read_cycle
from tests.app.service.lines import Served, served, until


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test waits between two requests."""
    monkeypatch.setattr(followed_groups, "ASK_AGAIN", 0.001)
    monkeypatch.setattr(following, "FIRST_PAUSE", 0.001)
    monkeypatch.setattr(following, "LONGEST_PAUSE", 0.001)


class Cycles:
    """What an interface takes: the number of cycles of each group."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}

    async def take(self, name: str, _snapshot: Snapshot) -> None:
        self.counts[name] = self.counts.get(name, 0) + 1

    async def come(self, *names: str) -> None:
        """Wait for another cycle of these groups."""
        before = dict(self.counts)
        await until(lambda: all(self.counts.get(name, 0) > before.get(name, 0) for name in names))


@dataclass
class Interface:
    """An interface to a served line."""

    line: Served
    remote: RemoteBus
    groups: FollowedGroups
    cycles: Cycles

    async def follow(self, *names: str) -> None:
        await self.groups.follow(self.remote, set(names))


@contextlib.asynccontextmanager
async def interface_to_a_line(folder: Path) -> AsyncIterator[Interface]:
    """The owner has the poll groups "axes" and "slow"; none is followed yet."""
    async with served(folder) as line, followed(folder) as follows:
        poll(line)
        line.bus.poll_group("slow", period=0.03, points=[Hcp2Controller(line.bus, 6).point("1")])
        await shows(follows)
        cycles = Cycles()
        interface = Interface(line, follows.remote, FollowedGroups(follows, cycles.take), cycles)
        await until(lambda: len(interface.remote.groups) == 2)
        yield interface
        await interface.groups.leave()


@pytest.fixture
def refusals(monkeypatch: pytest.MonkeyPatch) -> list[Exception]:
    """Why groups could not be requested."""
    found: list[Exception] = []
    request = RemoteBus.group

    def group(remote: RemoteBus, name: str) -> RemoteGroup:
        try:
            return request(remote, name)
        except InvalidCommand as error:
            found.append(error)
            raise

    monkeypatch.setattr(RemoteBus, "group", group)
    return found


@pytest.mark.asyncio
async def test_a_group_that_is_removed_and_added_again_is_followed_again(
    tmp_path: Path, refusals: list[Exception]
) -> None:
    async with interface_to_a_line(tmp_path) as interface:
        await interface.follow("axes")
        for _ in range(2):
            await interface.cycles.come("axes")
            interface.line.bus.group("axes").close()
            await until(lambda: refusals)
            assert {str(error) for error in refusals} == {"no poll group 'axes'; there are: slow"}
            poll(interface.line)
            await interface.cycles.come("axes")
            refusals.clear()
        assert interface.cycles.counts.keys() == {"axes"}


@pytest.mark.asyncio
async def test_a_group_that_the_owner_adds_later_is_followed_from_then_on(
    tmp_path: Path, refusals: list[Exception]
) -> None:
    async with interface_to_a_line(tmp_path) as interface:
        await interface.follow("axes", "forces")
        await until(lambda: len(refusals) > 1)
        await interface.cycles.come("axes")
        assert "forces" not in interface.cycles.counts
        bus = interface.line.bus
        bus.poll_group("forces", period=0.02, points=[Hcp2Controller(bus, 6).point("2")])
        await interface.cycles.come("axes", "forces")


@pytest.mark.asyncio
async def test_only_the_wanted_groups_are_followed_and_the_others_are_sent_no_more(tmp_path: Path) -> None:
    async with interface_to_a_line(tmp_path) as interface:
        axes = interface.remote.group("axes")
        await interface.follow("axes", "slow")
        await interface.cycles.come("axes", "slow")
        await interface.follow("slow")
        assert axes.over, "its owner sends it no more"
        assert "axes" not in interface.groups.dropped
        interface.cycles.counts.clear()
        await interface.cycles.come("slow")
        assert interface.cycles.counts.keys() == {"slow"}
        now = interface.remote.now()
        assert interface.groups.old(now) == set()
        assert interface.groups.old(now + 10.0) == {"slow"}, "a group that is not followed is not old"
        await interface.follow("axes")
        await interface.cycles.come("axes")
        await interface.groups.leave()
        interface.cycles.counts.clear()
        own = interface.remote.group("axes").subscribe()
        for _ in range(4):
            await anext(own)
        own.close()
        assert interface.cycles.counts == {}
        assert interface.groups.old(now + 10.0) == set()


@pytest.mark.asyncio
async def test_a_group_without_any_cycle_gets_old_too(tmp_path: Path) -> None:
    async with interface_to_a_line(tmp_path) as interface:
        await interface.follow("no such group")
        now = interface.remote.now()
        assert interface.groups.old(now) == set()
        assert interface.groups.old(now + 1000.0) == {"no such group"}
        await interface.groups.leave()
        assert interface.groups.old(now + 1000.0) == set()


@pytest.mark.asyncio
async def test_a_group_is_as_old_as_the_end_of_its_last_cycle() -> None:
    owner, taken = Owner(), asyncio.Event()

    async def take(_name: str, _snapshot: Snapshot) -> None:
        taken.set()

    groups = FollowedGroups(connected(owner), take)
    await groups.follow(cast("RemoteBus", owner), {"axes"})
    owner.group("axes").cycles.put_nowait(replace(read_cycle(1.0), due=100.0, started=100.0, finished=105.0))
    await taken.wait()
    assert groups.old(106.0) == set(), "a second old"
    assert groups.old(106.1) == {"axes"}
    await groups.leave()
