"""A line of another program is followed for good: by a real socket, whoever of the two comes and goes."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from busmaster.app.interfaces import following
from busmaster.app.interfaces.following import Connected, Following, Lost
from busmaster.app.service.permission import Access
from busmaster.errors import InvalidCommand, LineDown, NotStarted
from tests.app.interfaces.lines import READS, assert_goes_on_alone, followed, poll, shows
from tests.app.service.lines import served, until
from tests.patience import PATIENCE


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test waits between two tries."""
    monkeypatch.setattr(following, "FIRST_PAUSE", 0.001)
    monkeypatch.setattr(following, "LONGEST_PAUSE", 0.001)


@pytest.mark.asyncio
async def test_a_line_is_followed_again_however_often_its_owner_comes_and_goes(tmp_path: Path) -> None:
    async with followed(tmp_path) as interface:
        for _ in range(3):
            async with served(tmp_path) as line:
                poll(line)
                await shows(interface)
                assert isinstance(interface.state, Connected)
            await until(lambda: isinstance(interface.state, Lost))
            assert [row.key for row in interface.picture.rows] == ["5/10", "5/outputs"]  # what was known last


@pytest.mark.asyncio
async def test_while_the_owner_is_away_a_write_says_so_and_is_not_sent_later(tmp_path: Path) -> None:
    async with followed(tmp_path) as interface:
        await until(lambda: "no program serves" in getattr(interface.state, "why", ""))
        with pytest.raises(NotStarted, match=r"is not there: .*no program serves"):
            await interface.write("axes", "5/10", 1)
        with pytest.raises(LineDown, match="is not there"):
            await interface.details("axes", "5/10")
        async with served(tmp_path) as line:
            poll(line)
            await shows(interface)
            assert line.records == []


@pytest.mark.asyncio
async def test_a_write_passes_the_owners_authorisation(tmp_path: Path) -> None:
    async with served(tmp_path) as line, followed(tmp_path) as interface:
        poll(line)
        await shows(interface)
        await interface.write("axes", "5/10", 7)
        assert line.audit() == [("5/10", "written")]
        await until(lambda: interface.picture.rows[0].value == 7)


@pytest.mark.asyncio
async def test_groups_and_nodes_rest_as_an_interface_wishes_while_the_owner_is_there(tmp_path: Path) -> None:
    async with followed(tmp_path) as interface:
        async with served(tmp_path) as line:
            poll(line)
            [group] = line.bus.groups
            await shows(interface)
            await interface.pause("axes", True)
            assert group.paused
            await interface.pause("axes", False)
            await interface.demand("axes")
            await interface.suspend("hcp2", 5, 60.0)
            assert [node.label for node in line.bus.nodes if node.suspended] == ["node 5"]
        await until(lambda: isinstance(interface.state, Lost))
        for wish in (interface.pause("axes", True), interface.demand("axes"), interface.suspend("hcp2", 5, 0.0)):
            with pytest.raises(LineDown, match="is not there"):
                await wish


@pytest.mark.asyncio
async def test_who_has_no_patience_is_told_why_there_is_no_first_connection_and_follows_for_good_after_it(
    tmp_path: Path,
) -> None:
    interface = Following(lambda: f"unix:{tmp_path}/line.sock")
    with pytest.raises(LineDown, match="no program serves"):
        await interface.follow(patient=False)
    async with asyncio.timeout(PATIENCE):
        async with served(tmp_path) as line:
            poll(line)
            task = asyncio.ensure_future(interface.follow(patient=False))
            await shows(interface)
        await until(lambda: isinstance(interface.state, Lost))
        async with served(tmp_path) as line:
            poll(line)
            await shows(interface)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    assert task.cancelled()


@pytest.mark.asyncio
async def test_an_interface_that_is_read_only_writes_nothing(tmp_path: Path) -> None:
    async with served(tmp_path) as line, followed(tmp_path, read_only=True) as interface:
        poll(line)
        await shows(interface)
        assert interface.read_only
        with pytest.raises(InvalidCommand, match="this interface is read-only"):
            await interface.write("axes", "5/10", 7)
        assert line.records == []


@pytest.mark.asyncio
async def test_an_interface_is_told_when_its_role_is_changed_and_goes_on_with_its_picture(tmp_path: Path) -> None:
    async with served(tmp_path) as line, followed(tmp_path) as interface:
        poll(line)
        await shows(interface)
        told: list[bool] = []
        interface.on_state(lambda: told.append(interface.read_only))
        picture = interface.picture
        line.authorisation.access = READS
        await until(lambda: told == [True])
        with pytest.raises(InvalidCommand, match="may read this line"):
            await interface.write("axes", "5/10", 7)
        line.authorisation.access = Access()
        await until(lambda: told == [True, False])
        await interface.write("axes", "5/10", 7)
        assert interface.picture is picture


@pytest.mark.asyncio
async def test_interfaces_that_come_and_go_leave_nothing_with_the_line(tmp_path: Path) -> None:
    async with served(tmp_path) as line:
        poll(line)
        for _ in range(20):
            async with followed(tmp_path) as interface:
                await shows(interface)
        await assert_goes_on_alone(line)


@pytest.mark.asyncio
async def test_an_interface_is_told_of_each_picture_and_of_each_change_until_it_no_longer_wants_to_be(
    tmp_path: Path,
) -> None:
    told: list[str] = []
    async with followed(tmp_path) as interface:
        leave = interface.on_picture(lambda method, said: told.append(method))
        leave_state = interface.on_state(lambda: told.append(type(interface.state).__name__))
        async with served(tmp_path) as line:
            poll(line)
            await shows(interface)
            await until(lambda: "frame" in told)
        await until(lambda: "Lost" in told)
        assert {"rows", "values", "groups", "nodes", "frame", "Connected"} <= set(told)
        leave()
        leave_state()
        told.clear()
        async with served(tmp_path):
            await until(lambda: interface.is_connected)
        assert told == []


@pytest.mark.asyncio
async def test_times_of_the_line_are_times_of_day(tmp_path: Path) -> None:
    async with served(tmp_path) as line, followed(tmp_path) as interface:
        poll(line)
        await shows(interface)
        assert abs(interface.wall_time(line.bus.now() - 3600) - interface.wall_time(line.bus.now()) + 3600) < PATIENCE
