"""Each role has of a line what the table says (busmaster/app/service/rights.py), and the documentation has that
table."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from busmaster import RemoteBus, connect
from busmaster.app.service.client_messages import DemandParams
from busmaster.app.service.permission import Access, Permission
from busmaster.app.service.reply_times import check_within
from busmaster.app.service.rights import RIGHTS, Role, line_parts, table
from busmaster.arbiter.transaction import Priority
from busmaster.bus.points import Point
from busmaster.contract.learning import Learned
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import BusError, InvalidCommand, NodeDown
from busmaster.protocols.hcp2 import codec as hcp2
from tests.app.service.lines import ABSENT, Served, served
from tests.app.service.test_fair import watched
from tests.patience import PATIENCE

DOCS = Path(__file__).parents[3] / "docs"
READ = hcp2.Read(1)
Story = Callable[[Served, RemoteBus], Awaitable[None]]


def as_role(folder: Path, role: Role, story: Story) -> None:
    async def run() -> None:
        access = Access(users={os.getuid(): Permission("user me", role)})
        async with asyncio.timeout(PATIENCE), served(folder, access=access) as line:
            line.bus.node(hcp2.PROFILE, 5)
            async with connect(line.address) as remote:
                await story(line, remote)

    asyncio.run(run())


def test_the_documentation_has_the_table() -> None:
    assert "\n".join(table()) in (DOCS / "service.md").read_text()


def test_a_role_has_a_part_of_the_line_unless_it_takes_turns_with_the_owner() -> None:
    assert line_parts() == {"read": 1 / 32, "write": 1 / 2}


@pytest.mark.parametrize("role", Role)
@pytest.mark.parametrize("options", [{}, {"priority": Priority.URGENT}, {"priority": Priority.BACKGROUND}])
def test_r9_a_read_has_the_highest_class_of_its_role_at_most(tmp_path: Path, role: Role, options: Any) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        node, asked = remote.node(hcp2.PROFILE, 5), watched(line)
        await node.request(READ, **options)
        wished = options.get("priority", Priority.COMMAND)
        assert [read.priority for read in asked if not read.probe] == [max(wished, RIGHTS[role].reads)]

    as_role(tmp_path, role, story)


def test_a_role_that_changes_holds_for_the_next_read(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        node = remote.node(hcp2.PROFILE, 5)
        await node.request(READ)
        line.authorisation.access = Access(users={os.getuid(): Permission("user me", Role.ADMIN)})
        asked = watched(line)
        await node.request(READ)
        assert asked[0].priority is Priority.COMMAND
        assert line.service.clients[0].turn.owner_time == 0

    as_role(tmp_path, Role.READ, story)


@pytest.mark.slow
@pytest.mark.parametrize("role", Role)
@pytest.mark.parametrize(
    ("step", "beyond"),
    [
        ("max_reply_delay", 3.0),
        ("driver_release_time", 3.0),
        ("inter_byte_timeout", 3.0),
        ("inter_byte_timeout", 0.03),
        ("silence", 0.16),
    ],
)
def test_reply_times_beyond_those_of_the_protocol_are_for_admins(
    tmp_path: Path, role: Role, step: str, beyond: float
) -> None:
    times = {"late_after": 0.01, "window": 0.01, "max_reply_delay": 0.01, "inter_byte_timeout": 0.002, step: beyond}

    async def story(line: Served, remote: RemoteBus) -> None:
        node = remote.node(hcp2.PROFILE, 6, timings=Timings.uniform(ReplyTiming(**times)))
        if RIGHTS[role].own_times:
            await node.request(READ)
        else:
            with pytest.raises(InvalidCommand, match=f"{step} of {beyond:g} s is longer than that of hcp2"):
                await node.request(READ)
            assert len(line.bus.nodes) == 1

    as_role(tmp_path, role, story)


@pytest.mark.parametrize("step", ["read", "write", "packet"])
@pytest.mark.parametrize("name", ["max_reply_delay", "inter_byte_timeout", "driver_release_time", "silence"])
def test_reply_times_as_long_as_those_of_the_protocol_are_for_all_and_longer_ones_are_not(step: str, name: str) -> None:
    limits = hcp2.PROFILE.timings
    documented = getattr(limits, step)
    assert documented.silence is None
    limit = documented.max_reply_delay if name == "silence" else getattr(documented, name)
    for beyond, accepted in ((0.0, True), (0.001, False)):
        times = replace(limits, **{step: replace(documented, **{name: limit + beyond})})
        for given in (times, Learned(times)):
            if accepted:
                check_within(given, hcp2.PROFILE, 6)
            else:
                with pytest.raises(InvalidCommand, match=f"node 6: {name} of .* s is longer than that of hcp2"):
                    check_within(given, hcp2.PROFILE, 6)
    check_within(None, hcp2.PROFILE, 6)
    check_within(Learned(), hcp2.PROFILE, 6)


@pytest.mark.parametrize("role", [Role.READ, Role.WRITE])
def test_a_program_names_so_many_new_nodes(tmp_path: Path, role: Role) -> None:
    most = RIGHTS[role].new_nodes

    async def story(line: Served, remote: RemoteBus) -> None:
        await remote.node(hcp2.PROFILE, 5).request(READ)
        asked = [remote.node(hcp2.PROFILE, ABSENT + number).request(READ) for number in range(most)]
        ended = await asyncio.gather(*asked, return_exceptions=True)
        assert all(isinstance(error, BusError) for error in ended)
        with pytest.raises(InvalidCommand, match="nodes at most that the line's owner does not have"):
            await remote.node(hcp2.PROFILE, ABSENT + most).request(READ)
        assert len(line.bus.nodes) == 1 + most

    as_role(tmp_path, role, story)


def test_absent_nodes_of_clients_share_one_budget(tmp_path: Path) -> None:
    """Of many absent nodes only those are asked that the budget pays for; the others fail at once."""

    async def story(line: Served, remote: RemoteBus) -> None:
        asked = [remote.node(hcp2.PROFILE, ABSENT + number).request(READ) for number in range(16)]
        ended = await asyncio.gather(*asked, return_exceptions=True)
        assert sum(isinstance(error, NodeDown) for error in ended) >= 8

    as_role(tmp_path, Role.READ, story)


def test_a_new_node_that_replies_is_read(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        assert await remote.node(hcp2.PROFILE, 6).request(READ) == 0.0
        assert not line.bus._line.arbiter.dispatcher.probes.budget._generous_until > 0

    as_role(tmp_path, Role.READ, story)


def test_r9_all_programs_of_one_user_have_one_part_of_the_line(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        async with connect(line.address):
            one, other = line.service.clients
            assert one.turn.account is other.turn.account

    as_role(tmp_path, Role.WRITE, story)


@pytest.mark.parametrize("role", Role)
def test_programs_of_a_role_demand_a_group_so_often(tmp_path: Path, role: Role) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        point: Point[Any] = Point(line.bus.node(hcp2.PROFILE, 5), "1", READ)
        group = line.bus.poll_group("slow", period=1000.0, points=[point])
        await anext(aiter(group))
        before = group.poll.cycles
        for _ in range(5):
            await remote.link.answer(remote.link.ask("demand", DemandParams("slow")))
            await remote.node(hcp2.PROFILE, 5).request(READ)
            await remote.node(hcp2.PROFILE, 5).request(READ)
        assert group.poll.cycles - before == (1 if RIGHTS[role].demand_every else 5)

    as_role(tmp_path, role, story)


@pytest.mark.parametrize("role", Role)
def test_r9_a_poll_group_of_a_program_is_its_own_line_time(tmp_path: Path, role: Role) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        point: Point[Any] = Point(remote.node(hcp2.PROFILE, 5), "1", READ)
        await remote.node(hcp2.PROFILE, 5).request(READ)
        group = remote.poll_group("mine", period=0.05, points=[point])
        await group.ready()
        await anext(aiter(group))
        [own] = line.bus.groups
        [client] = line.service.clients
        assert [(read.client, read.priority) for read in own.poll.results] == [(client.turn, RIGHTS[role].polls)]

    as_role(tmp_path, role, story)


def test_without_a_role_the_owners_user_and_root_are_admin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 1000)  # root too may run these tests
    assert Access().of_process(os.getuid(), ()).role is Role.ADMIN
    assert Access().of_process(0, ()).role is Role.ADMIN
    assert Access().of_process(os.getuid() + 4711, ()).role is Role.READ
    assert Access().of_token("").role is Role.READ
