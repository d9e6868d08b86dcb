"""A program that takes a `BusLike` runs on a `Bus` and on a `RemoteBus`, with the same outcome."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import pytest

from busmaster import (
    BusClosed,
    BusLike,
    Hcp2Controller,
    InvalidCommand,
    LineDown,
    MicroFlexDrive,
    Node,
    Point,
    Priority,
    RemoteBus,
    connect,
)
from busmaster.app.bounds import LONGEST_REQUEST, MOST_PLANNED_READS
from busmaster.app.service import service
from busmaster.app.service.client_messages import PlannedGroupForm, PlannedRead, PlanParams
from busmaster.app.service.messages import decode_request_params, decode_result, encode
from busmaster.app.service.plans import encode_groups, encode_plan, groups_of, plan_of
from busmaster.app.service.remote_group import RemoteGroup
from busmaster.app.service.reply_times import encode_timings
from busmaster.app.service.typed import Raw
from busmaster.bus.bus_like import GroupLike
from busmaster.contract.bounds import LONGEST_PERIOD, SHORTEST_PERIOD
from busmaster.contract.learning import Learned
from busmaster.planning import PlannedGroup, PlannedNode
from busmaster.protocols.hcp2.codec import Write
from busmaster.protocols.modbus.codec import PROFILE as MODBUS
from busmaster.protocols.modbus.codec import ReadRegisters
from tests.app.service.lines import ABSENT, PATIENT, Served, on_a_line, on_a_served_line, raw, until


async def program(bus: BusLike) -> list[object]:
    """Use what both have, and return what came of it: drive 7 is on the line."""
    drive = MicroFlexDrive(bus, 7)
    group: GroupLike = bus.poll_group("mine", period=0.02, points=[drive.status_word, drive.speed_measured])
    outcome: list[object] = [group.name, group.period, [point.item for point in group.points]]
    try:
        bus.poll_group("mine", period=1.0, points=[])
    except InvalidCommand as error:
        outcome.append(str(error))
    try:
        bus.poll_group("other", period=-1.0, points=[])
    except InvalidCommand as error:
        outcome.append(str(error))
    events = bus.events()
    async for snapshot in group:
        outcome.append([type(sample.value).__name__ for sample in snapshot.values()])
        sample = bus.latest(drive.status_word)
        assert sample is not None
        assert sample.value == snapshot[drive.status_word].value
        assert group.latest is snapshot
        assert sample.age(bus.now()) < 60
        break
    outcome.append([one.name for one in bus.groups])
    assert bus.group("mine") is group
    try:
        bus.group("mime")
    except InvalidCommand as error:
        outcome.append(str(error))
    outcome.append([(node.profile.name, node.address, node.label) for node in bus.nodes])
    outcome.append((await bus.statistics()).exchanges > 0)
    node = PlannedNode(drive.node.profile, 7)
    more = PlannedGroup("more", 0.001, [(node, drive.status_word.command), (node, drive.speed_measured.command)])
    plan = await bus.plan(more)
    outcome.append([one.exchanges for one in plan.groups])
    outcome.append(plan.groups[-1].name)
    async with drive.exclusive(max_hold=1.0) as held:
        outcome.append(await held.status())
    async with drive.exclusive() as held:
        outcome.append(await held.status())
    consumer = group.subscribe(buffer=4)
    group.close()
    group.close()
    outcome.append(len([snapshot async for snapshot in consumer]) <= 4)
    outcome.append(bus.groups)
    events.close()
    return outcome


def test_a_program_does_the_same_on_a_bus_and_on_a_remote_bus(tmp_path: Path) -> None:
    outcomes: list[list[object]] = []

    async def near(line: Served) -> None:
        MicroFlexDrive(line.bus, 7)
        outcomes.append(await program(line.bus))

    async def far(line: Served) -> None:
        MicroFlexDrive(line.bus, 7)
        async with connect(line.address) as remote:
            outcomes.append(await program(remote))

    on_a_line(tmp_path, near)
    on_a_line(tmp_path, far)
    assert outcomes[0] == outcomes[1]
    assert outcomes[0][:3] == ["mine", 0.02, ["status_word", "speed_measured"]]


def test_the_groups_of_the_owner_are_known_when_a_program_comes_and_when_they_change(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        point = Hcp2Controller(line.bus, 5).point("1")
        fast = line.bus.poll_group("fast", period=0.02, points=[point])
        async with connect(line.address) as remote:
            [theirs] = remote.groups
            assert (theirs.name, theirs.period, theirs.own) == ("fast", 0.02, False)
            assert remote.groups == (theirs,)
            slow = line.bus.poll_group("slow", period=60, points=[point])
            await until(lambda: [group.name for group in remote.groups] == ["fast", "slow"])
            slow.close()
            await until(lambda: remote.groups == (theirs,))
            assert len(line.service.clients[0]._streams) == 0, "only a group that is read costs the owner anything"
            assert (await anext(aiter(theirs)))[theirs.points[0]].value == 0
            assert theirs.points[0].key == point.key
            fast.close()
            assert [snapshot async for snapshot in theirs][16:] == []
            assert theirs.over
            # the number of the stream is free again at the owner
            await until(lambda: len(line.service.clients[0]._streams) == 0)

    on_a_line(tmp_path, story)


def test_a_group_that_was_closed_here_can_be_read_again(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        line.bus.poll_group("fast", period=0.02, points=[Hcp2Controller(line.bus, 5).point("1")])
        async with connect(line.address) as remote:
            for _ in range(2):
                theirs = remote.group("fast")
                assert remote.group("fast") is theirs
                await anext(aiter(theirs))
                theirs.close()
                await until(lambda: not line.service.clients[0]._streams)
            assert len(line.bus.groups) == 1
            await until(lambda: not line.bus.groups[0]._consumers_of_changes)

    on_a_line(tmp_path, story)


def test_the_list_of_groups_is_sent_once_in_a_while_however_often_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service, "GROUPS_EVERY", 3600.0)

    async def story(line: Served, remote: RemoteBus) -> None:
        point = Hcp2Controller(line.bus, 5).point("1")
        for number in range(5):
            line.bus.poll_group(f"group {number}", period=60, points=[point])
        await until(lambda: len(remote.groups) == 5)
        for number in range(5):
            line.bus.group(f"group {number}").close()
            await remote.statistics()
        assert len(remote.groups) == 5, "the next list is due in an hour"
        due = line.service._groups_timer
        assert due is not None
        line.service._send_groups()
        await until(lambda: not remote.groups)

    on_a_served_line(tmp_path, story)


def test_a_service_that_ended_before_the_list_of_groups_was_sent_sends_it_when_it_serves_again(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        point = Hcp2Controller(line.bus, 5).point("1")
        line.bus.poll_group("first", period=60, points=[point])
        await line.service.__aexit__(None, None, None)
        await line.service.__aenter__()
        async with connect(line.address) as remote:
            line.bus.poll_group("second", period=60, points=[point])
            await until(lambda: [group.name for group in remote.groups] == ["first", "second"])

    on_a_line(tmp_path, story)


def test_a_group_that_the_owner_made_again_has_its_new_period(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        point = Hcp2Controller(line.bus, 5).point("1")
        old = line.bus.poll_group("axes", period=60, points=[point])
        await until(lambda: [group.period for group in remote.groups] == [60])
        old.close()
        await until(lambda: not remote.groups)
        line.bus.poll_group("axes", period=30, points=[point])
        await until(lambda: [group.period for group in remote.groups] == [30])

    on_a_served_line(tmp_path, story)


def test_a_value_that_the_owner_reads_between_two_cycles_arrives_with_the_others_of_the_cycle(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        controller = Hcp2Controller(line.bus, 5)
        points = [replace(controller.point("1"), read_after_write=True), controller.point("2")]
        group = line.bus.poll_group("axes", period=3600, points=points)
        await until(lambda: remote.groups)
        theirs = remote.group("axes")
        consumer = theirs.subscribe(changes=True)
        await theirs.ready()
        group.demand()
        cycle = await anext(consumer)
        await points[0].write(7.5)
        between = await anext(consumer)
        assert ([point.key for point in between], between.cycle) == (["5/1", "5/2"], cycle.cycle)
        assert [sample.value for sample in between.values()] == [7.5, 0]

    on_a_served_line(tmp_path, story)


async def first(group: RemoteGroup) -> object:
    return await anext(aiter(group))


async def subscribed(group: RemoteGroup) -> object:
    return await anext(group.subscribe())


def test_what_only_the_owner_can_reject_is_raised_where_the_group_is_iterated(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        point = Hcp2Controller(remote, 5).point("1")
        node = remote.node(point.node.profile, ABSENT, retries=100_000)  # the owner takes 100 at most
        uses: list[Callable[[RemoteGroup], Coroutine[Any, Any, object]]] = [first, subscribed, RemoteGroup.ready]
        for use in uses:
            group = remote.poll_group("mine", period=60, points=[Point(node, "1", point.command)])
            with pytest.raises(InvalidCommand, match="retries"):
                await use(group)
            assert group.over
            assert remote.groups == ()
            with pytest.raises(InvalidCommand, match="retries"):
                group.subscribe()
        assert line.bus.groups == ()
        await remote.poll_group("mine", period=60, points=[point]).ready()

    on_a_served_line(tmp_path, story)


@pytest.mark.parametrize("length", [1, 38, 39, 40, 41, 99])
def test_names_of_groups_that_differ_only_at_their_end_are_different_names(tmp_path: Path, length: int) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        points = [Hcp2Controller(remote, 5).point("1")]
        groups = [remote.poll_group("n" * length + end, period=60, points=points) for end in "ab"]
        for group in groups:
            await group.ready()
        assert [own.name for own in line.bus.groups] == [group.owners_name for group in groups]
        assert remote.groups == tuple(groups)
        for group in groups:
            assert remote.group(group.name) is group
            with pytest.raises(InvalidCommand, match=f"a poll group {group.name!r} already exists"):
                remote.poll_group(group.name, period=60, points=points)

    on_a_served_line(tmp_path, story)


def test_a_group_that_the_owner_never_accepted_raises_that_the_line_is_down(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        group = remote.poll_group("mine", period=60, points=[Hcp2Controller(remote, 5).point("1")])
        [connection] = line.service._clients.values()
        connection.websocket.abort()
        with pytest.raises(LineDown):
            await anext(aiter(group))
        with pytest.raises(LineDown):
            remote.poll_group("other", period=60, points=[])

    on_a_served_line(tmp_path, story)


def test_a_point_of_another_bus_is_rejected_before_anything_is_sent(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        of_owner = Hcp2Controller(line.bus, 5).point("1")
        async with connect(line.address) as other:
            of_other = Hcp2Controller(other, 5).point("1")
            for point in (of_owner, of_other):
                with pytest.raises(InvalidCommand, match="'mine': 5/1 belongs to another bus"):
                    remote.poll_group("mine", period=60, points=[point])
        assert remote.groups == ()

    on_a_served_line(tmp_path, story)


def test_a_group_that_is_closed_before_it_was_accepted_does_not_begin(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        points = [Hcp2Controller(remote, 5).point(str(number)) for number in range(1, 99)]
        for turns in range(4):
            group = remote.poll_group("mine", period=60, points=points)
            for _ in range(turns):
                await anyio.lowlevel.checkpoint()
            group.close()
            await remote.statistics()
            assert line.bus.groups == ()
            assert line.service.clients[0]._gathered == {}

    on_a_served_line(tmp_path, story)


def test_a_group_begins_although_the_program_waits_for_it_no_longer(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        group = remote.poll_group("mine", period=60, points=[Hcp2Controller(remote, 5).point("1")])
        waiting = asyncio.ensure_future(group.ready())
        await asyncio.sleep(0)
        waiting.cancel()
        await asyncio.wait([waiting])
        await group.ready()
        assert [own.name for own in line.bus.groups] == [group.owners_name]

    on_a_served_line(tmp_path, story)


@pytest.mark.slow
def test_a_plan_of_a_remote_bus_is_that_of_its_owner(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        point = Hcp2Controller(line.bus, 5).point("1")
        fast = line.bus.poll_group("fast", period=60, points=[point])
        absent = PlannedNode(point.node.profile, ABSENT, PATIENT, reply_time=0.1)
        known = PlannedNode(point.node.profile, 5, PATIENT)
        more = PlannedGroup("more", 0.05, [(absent, point.command), (known, point.command)], 0.01, Priority.BACKGROUND)
        fast.demand()
        await until(lambda: fast.latest)
        measured = replace(more, reads=[(absent, point.command), (Node.of(point).planned(), point.command)])
        assert await remote.plan(more) == await line.bus.plan(measured)
        assert await remote.plan() == await line.bus.plan()

    on_a_served_line(tmp_path, story)


def test_a_planned_group_arrives_at_the_owner_as_it_was_given(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        profile, command = Hcp2Controller.profile, Hcp2Controller(line.bus, 5).point("1").command
        absent = PlannedNode(profile, ABSENT, PATIENT, reply_time=0.1)
        merged = PlannedNode(MODBUS.with_default_merge(), 14)
        groups = [
            PlannedGroup("m" * 80, LONGEST_PERIOD, [(absent, command)], 0.01, Priority.BACKGROUND),
            PlannedGroup("short", SHORTEST_PERIOD, [(merged, MODBUS.probe)]),
        ]
        params = PlanParams(encode_groups(groups))
        sent = decode_request_params("plan", Raw(encode(params)))
        received = groups_of(sent.groups, line.bus)
        assert received == groups
        assert received[1].reads[0][0].profile.merge is not None, "it is planned with merged reads, as it is polled"
        known = PlannedGroup("known", 1.0, [(PlannedNode(profile, 5, PATIENT, reply_time=0.1), command)])
        [measured] = groups_of(encode_groups([known]), line.bus)
        assert measured.reads == [(Node.of(Hcp2Controller(line.bus, 5)).planned(), command)], (
            "as the line has measured it"
        )
        [form] = encode_groups([known])
        [long] = groups_of([PlannedGroupForm("n" * 1000, form.period, form.reads)], line.bus)
        assert long.name == "n" * 80
        learned = encode_timings(Learned(PATIENT))
        read = PlannedRead("hcp2", ABSENT, form.reads[0].command, learned)
        [planned] = groups_of([PlannedGroupForm("learned", 1.0, [read])], line.bus)
        assert planned.reads[0][0].timings == PATIENT

    on_a_line(tmp_path, story)


def test_a_plan_arrives_at_the_program_as_the_owner_calculated_it(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        unit = PlannedNode(MODBUS.with_default_merge(), 3)
        reads = [(unit, ReadRegisters(first)) for first in (1, 2)]
        plan = await line.bus.plan(PlannedGroup("merged", 0.05, reads), PlannedGroup("more", 0.01, reads[:1]))
        assert plan.groups[0].merged
        assert len(set(plan.worst_waits.values())) > 1
        assert plan_of(decode_result("plan", Raw(encode(encode_plan(plan))))) == plan

    on_a_line(tmp_path, story)


def test_a_plan_that_would_hold_up_the_owner_is_refused(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        command = Hcp2Controller(line.bus, 5).point("1").command
        node = PlannedNode(Hcp2Controller.profile, 5)
        reads = [(node, command)] * MOST_PLANNED_READS
        assert (await remote.plan(PlannedGroup("most", 1.0, reads))).groups[0].exchanges == 1
        for groups, why in (
            (
                [PlannedGroup("one", 1.0, reads), PlannedGroup("two", 1.0, reads[:1])],
                "200 reads planned at once, and not 201",
            ),
            ([PlannedGroup("one", 0.0, reads)], "0.001 to 86400 s, not 0"),
            ([PlannedGroup("one", 1.0, [])] * 201, "200 groups at most"),
            ([PlannedGroup("one", 1.0, []), PlannedGroup("two", 1.0, [], merge=[lambda commands: []])], "merges"),
            ([PlannedGroup("one", 1.0, [reads[0], (node, Write(1, (1.0,)))])], "only reads"),
        ):
            with pytest.raises(InvalidCommand, match=why):
                await remote.plan(*groups)
        both = await asyncio.gather(remote.plan(), remote.plan())
        assert both[0] == both[1]

    on_a_served_line(tmp_path, story)


def test_the_owner_refuses_such_a_plan_itself(tmp_path: Path) -> None:
    read = {"protocol": "hcp2", "address": 5, "command": {"command": "read", "element": 1}}
    write = {**read, "command": {"command": "write", "element": 1, "values": [1.0]}}

    async def story(line: Served) -> None:
        async with raw(line) as client:
            for reads, period, why in (
                ([read] * 201, 1.0, "200 reads planned"),
                ([read], 0.0, "period: expected `float` >= 0.001"),
                ([read], "1", "period: expected `float`, got `str`"),
                ([write], 1.0, "only reads"),
                ([{**read, "address": 99999}], 1.0, "hcp2"),
            ):
                said = await client.ask("plan", groups=[{"name": "one", "period": period, "reads": reads}])
                assert why in said["error"]["message"], said
            said = await client.ask("plan", groups=[{"name": "one", "period": 1.0, "reads": []}] * 201)
            assert "200 groups at most" in said["error"]["message"]
            said = await client.ask("plan", groups="all")
            assert "groups: expected `array`, got `str`" in said["error"]["message"]
            async with line.service.line.planner._turn:
                await client.say(method="plan", params={}, id=2)
                said = await client.ask("plan")
                assert "a plan for this program is already being calculated" in said["error"]["message"]
            assert (await client.hear())["id"] == 2

    on_a_line(tmp_path, story)


def test_plans_of_one_program_are_calculated_one_after_the_other(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        async with line.service.line.planner._turn:
            asked = [asyncio.ensure_future(remote.plan()) for _ in range(2)]
            await until(lambda: line.service.clients[0]._planning)
            await remote.statistics()
        first, second = await asyncio.gather(*asked)
        assert first == second

    on_a_served_line(tmp_path, story)


def test_a_plan_that_does_not_fit_into_a_message_is_refused_before_it_is_sent(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        with pytest.raises(InvalidCommand, match="too long for one message; plan fewer of them at once"):
            await remote.plan(PlannedGroup("x" * (LONGEST_REQUEST // 2), 1.0, []))
        assert (await remote.plan(PlannedGroup("x" * (LONGEST_REQUEST // 2 - 100), 1.0, []))).groups

    on_a_served_line(tmp_path, story)


def test_a_group_is_requested_when_it_is_made_or_named_or_awaited(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        point = Hcp2Controller(remote, 5).point("1")
        mine = remote.poll_group("mine", period=60, points=[point])
        await until(lambda: line.bus.groups)
        await until(lambda: not remote._tasks)
        own = [line.bus.poll_group(name, period=0.02, points=[Hcp2Controller(line.bus, 5).point("1")]) for name in "ab"]
        await until(lambda: len(remote.groups) == 3)
        named = remote.group("a")
        await until(lambda: named.latest)
        [awaited] = [group for group in remote.groups if group.name == "b"]
        assert awaited.latest is None
        await awaited.ready()
        await until(lambda: awaited.latest)
        for group in (mine, named, awaited):
            group.close()
            await group.ready()  # of a closed one nothing is requested
        await remote.statistics()
        assert not line.service.clients[0]._streams
        assert line.bus.groups == tuple(own)

    on_a_served_line(tmp_path, story)


def test_a_plan_ends_with_its_program(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with connect(line.address) as remote, line.service.line.planner._turn:
            asking = asyncio.ensure_future(remote.plan())
            await until(lambda: line.service.clients[0]._planning)
            [client] = line.service.clients
            await remote.link.close()
            with pytest.raises(BusClosed):
                await asking
            await line.alone()
            assert client._planning is not None
            assert client._planning.cancelled()

    on_a_line(tmp_path, story)
