"""The state that nodes, poll groups and other programs share: last values, stale values, stops, and who may write."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import pytest

from busmaster import Bus, Hcp2Controller, MicroFlexDrive, ModbusUnit, ext
from busmaster.arbiter.transaction import LEFT
from busmaster.bus.condition import LineCondition
from busmaster.bus.node import Node, Priority
from busmaster.bus.points import Point
from busmaster.bus.samples import Quality
from busmaster.errors import LineDown, Superseded, WriteUnconfirmed
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.modbus.codec import WriteRegisters
from busmaster.registry import make_device
from tests.stories import cycles, on_a_bus

# the value that was read last, by whichever name


def modbus() -> Any:
    device = make_device("modbus", 17)
    device.preset("holding:0", *range(100, 110))
    return device


def test_the_last_value_of_a_point_is_found_in_a_run_that_was_polled_until_the_node_is_written() -> None:
    async def story(bus: Bus) -> None:
        unit = ModbusUnit(bus, 17)
        run, single, beyond = unit.point("holding:0:10"), unit.point("holding:3"), unit.point("holding:9:int32")
        other = bus.node(unit.profile, 18)
        assert ext.last_value(run) is None
        group = bus.poll_group("g", period=1000.0, points=[run])
        await cycles(group, 1)
        assert ext.last_value(run) == tuple(range(100, 110))
        assert ext.last_value(single) == 103
        assert ext.last_value(unit.point("holding:3:int32")) == (103 << 16) + 104
        assert ext.last_value(beyond) is None, "a half of it was not read"
        assert ext.last_value(replace(single, decode={}.__getitem__)) is None, "it cannot be decoded"
        with pytest.raises(WriteUnconfirmed):
            await other.request(WriteRegisters(3, (1,)), idempotent=True, retries=0)
        assert ext.last_value(single) == 103, "another node was written"
        await unit.write("holding:5", 7)
        assert (ext.last_value(single), ext.last_value(run)) == (None, None)
        group.demand()
        await cycles(group, 1)
        assert (ext.last_value(unit.point("holding:5")), ext.last_value(single)) == (7, 103)
        group.close()
        assert ext.last_value(single) is None

    on_a_bus(story, modbus(), settings=ModbusUnit.profile.line)


def test_the_newest_of_several_reads_is_the_last_value() -> None:
    device = modbus()

    async def story(bus: Bus) -> None:
        unit = ModbusUnit(bus, 17)
        # The group that was made first reads last, so that the order of the groups does not decide.
        first = bus.poll_group("first", period=1000.0, points=[unit.point("holding:3")])
        second = bus.poll_group("second", period=1000.0, points=[unit.point("holding:3"), unit.point("holding:4")])
        for group, value in ((first, 1), (second, 2), (first, 3), (second, 4)):
            await cycles(group, 1) if group.latest is None else None
            device.preset("holding:3", value)
            group.demand()
            await cycles(group, 1)
            assert ext.last_value(unit.point("holding:3")) == value
            assert ext.last_value(unit.point("holding:3:1")) == (value,)

    on_a_bus(story, device, settings=ModbusUnit.profile.line)


def test_the_last_value_is_that_of_its_own_node() -> None:
    other = make_device("modbus", 18)
    other.preset("holding:0", *range(200, 210))

    async def story(bus: Bus) -> None:
        points = [ModbusUnit(bus, address).point("holding:3") for address in (17, 18)]
        await cycles(bus.poll_group("g", period=1000.0, points=points), 1)
        assert [ext.last_value(point) for point in points] == [103, 203]

    on_a_bus(story, modbus(), other, settings=ModbusUnit.profile.line)


# values that are no longer current


def test_an_error_of_a_sample_stays_its_error_while_the_line_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    device = EmulatedMint(1)

    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        good: Point[Any] = axis.point("1")
        bad: Point[Any] = Point(axis.node, "bad", hcp2.Read(1), decode={}.__getitem__)
        [snapshot] = await cycles(bus.poll_group("g", period=1000.0, points=[good, bad]), 1)
        monkeypatch.setattr(type(bus._line), "condition", LineCondition(True, bus.now(), "unplugged"))
        lost = bus.as_of_now(good, snapshot[good])
        assert isinstance(lost.error, LineDown)
        assert (lost.value, lost.quality) == (None, Quality.BAD)
        assert bus.as_of_now(bad, snapshot[bad]) is snapshot[bad]
        assert bus.latest(good) is None
        monkeypatch.undo()
        assert bus.latest(good) == snapshot[good]
        assert bus.latest(bad) is None

    on_a_bus(story, device)


def test_a_value_is_outdated_by_a_write_and_by_a_loss_of_the_line_since_its_request() -> None:
    async def story(bus: Bus) -> None:
        axis, line = Hcp2Controller(bus, 1), ext.line_of(bus)
        point, other = axis.point("1"), axis.point("2")
        await asyncio.sleep(1.0)
        before = bus.now()
        assert not line.is_outdated(point, before)
        await point.write(5.0)
        assert (line.is_outdated(point, before), line.is_outdated(other, before)) == (True, False)
        assert not line.is_outdated(point, bus.now())
        await asyncio.sleep(1.0)
        line.losses.lost(bus.now(), "unplugged")
        line.losses.found(bus.now())
        assert line.is_outdated(other, before)
        await asyncio.sleep(1.0)
        assert not line.is_outdated(other, bus.now())

    on_a_bus(story)


def test_nothing_is_kept_of_the_writes_to_nodes_that_were_given_back() -> None:
    async def story(bus: Bus) -> None:
        own = Hcp2Controller(bus, 1)
        await own.element(3).write(1.0)
        kept = len(bus._line._touched), len(bus._line._written)
        lent = bus._lend_node(hcp2.PROFILE, 2)
        await lent.request(hcp2.Write(1, (1.0, 2.0)))
        await lent.request(hcp2.Write(5, (1.0,)), touches=hcp2.Read(5))
        assert len(bus._line._touched) > kept[0]
        bus._give_back(lent)
        assert (len(bus._line._touched), len(bus._line._written)) == kept

    on_a_bus(story)


# stops, and writes that are not of the safe state


def test_a_stop_and_a_write_are_reported_at_once_to_everyone_with_their_node() -> None:
    async def story(bus: Bus) -> None:
        stopped, written = list[tuple[int, str]](), list[tuple[int, str]]()

        def follow(who: int) -> None:
            ext.line_of(bus).on_stop.append(lambda record: stopped.append((who, record.label)))
            ext.line_of(bus).on_touched.append(lambda record, when: written.append((who, record.label)))

        for who in (1, 2):
            follow(who)
        await MicroFlexDrive(bus, 2).disable()
        Hcp2Controller(bus, 1).node.note_stop()
        assert stopped == [(1, "node 2"), (2, "node 2"), (1, "node 1"), (2, "node 1")]
        assert written == [(1, "node 2"), (2, "node 2")]

    on_a_bus(story, make_device("microflex", 2), EmulatedMint(1))


def test_only_safe_writes_are_accepted_until_everyone_who_wanted_that_accepts_others_again() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        await axis.read(1)
        on_wire = asyncio.ensure_future(axis.write(1, 1.0))
        await asyncio.sleep(0.001)
        queued = [asyncio.ensure_future(axis.write(2, 1.0)), asyncio.ensure_future(axis.write(3, 1.0))]
        await asyncio.sleep(0)
        accept = [ext.take_only_safe_writes(bus), ext.take_only_safe_writes(bus)]
        await on_wire
        for waiting in queued:
            with pytest.raises(Superseded):
                await waiting
        with pytest.raises(Superseded) as refused:
            await axis.write(4, 1.0)
        assert (refused.value.what, refused.value.hint) == (LEFT, "")
        assert (refused.value.label, refused.value.command) == ("node 1", "write element 4 = 1")
        await axis.write(4, 2.0, safe=True)
        assert [await axis.read(element) for element in (1, 2, 3, 4)] == [1.0, 0.0, 0.0, 2.0]
        accept[0]()
        with pytest.raises(Superseded):
            await axis.write(4, 1.0)
        accept[1]()
        await axis.write(4, 3.0)
        assert await axis.read(4) == 3.0

    on_a_bus(story)


# programs that share the line


def test_the_longest_wait_counts_the_programs_that_share_the_line_while_they_do() -> None:
    async def story(bus: Bus) -> None:
        await Hcp2Controller(bus, 1).read(1)
        line, alone = ext.line_of(bus), bus.worst_case_wait()
        clients = [line.add_client(1.0), line.add_client(1.0)]
        assert line.sharing.clients == 2
        shared = bus.worst_case_wait()
        assert shared > alone
        line.remove_client(clients[0])
        assert alone < bus.worst_case_wait() < shared
        line.remove_client(clients[1])
        assert bus.worst_case_wait() == alone

    on_a_bus(story)


def test_the_longest_wait_counts_the_requests_that_go_before_another() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        await axis.read(1)
        alone = {priority: bus.worst_case_wait(priority) for priority in (Priority.URGENT, Priority.COMMAND)}
        reads = [asyncio.ensure_future(axis.read(1)) for _ in range(5)]
        await asyncio.sleep(0)
        assert bus.worst_case_wait(Priority.COMMAND) > alone[Priority.COMMAND]
        assert bus.worst_case_wait(Priority.URGENT) == alone[Priority.URGENT]
        await asyncio.gather(*reads)
        assert bus.worst_case_wait(Priority.COMMAND) == alone[Priority.COMMAND]

    on_a_bus(story)


def test_only_a_node_of_this_process_is_found_behind_a_handle() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        assert Node.of(axis) is Node.of(axis.point("1")) is axis.node
        async with axis.exclusive() as held:
            with pytest.raises(ValueError, match="node 1 is not a node of a bus in this process"):
                Node.of(held)

    on_a_bus(story)


def test_whether_a_request_was_sent_is_known_also_after_it_was_cancelled() -> None:
    async def story(bus: Bus) -> None:
        node = Node.of(Hcp2Controller(bus, 1))
        await node.request(hcp2.Read(1))
        requests = [ext.Request(hcp2.Read(1)) for _ in range(3)]
        assert not requests[0].sent
        running = [asyncio.ensure_future(ext.run(node, request)) for request in requests[:2]]
        await asyncio.sleep(0.001)
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        assert [request.sent for request in requests] == [True, False, False]
        await asyncio.sleep(1.0)
        assert [request.sent for request in requests] == [True, False, False]

    on_a_bus(story)


def test_the_longest_wait_counts_each_queued_write_once_though_writes_to_one_node_wait_for_each_other() -> None:
    async def story(bus: Bus) -> None:
        axis, other = Hcp2Controller(bus, 1), Hcp2Controller(bus, 2)
        for controller in (axis, other):
            await controller.write(1, 1.0)
            await controller.read(1)
        waits = []
        for waiting in (
            [axis.write(element, 1.0) for element in range(1, 7)],
            [axis.read(element) for element in range(1, 7)],
        ):
            tasks = [asyncio.ensure_future(one) for one in waiting]
            await asyncio.sleep(0)
            waits.append(bus.worst_case_wait(Priority.COMMAND))
            await asyncio.gather(*tasks)
        assert waits[0] == waits[1] > bus.worst_case_wait(Priority.COMMAND)

    on_a_bus(story)
