"""Poll groups in virtual time: what consumers get, what a write makes stale, what is merged."""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from busmaster import ext
from busmaster.bus.bus import Bus
from busmaster.bus.node import Node
from busmaster.bus.points import Point
from busmaster.bus.polling import Quality, Sample, Stream
from busmaster.contract.profile import LineSettings
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import BusClosed, GarbledReply, InvalidCommand, NodeDown, NoReply, Refused
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.mentor.device import EmulatedMentor
from busmaster.protocols.mentor.handle import MentorDrive as MentorHandle
from busmaster.protocols.modbus.device import EmulatedModbus, Illegal
from busmaster.protocols.modbus.handle import ModbusUnit
from busmaster.protocols.msc.device import EmulatedMsc
from busmaster.protocols.msc.handle import MscController
from busmaster.registry import make_device
from busmaster.testing.virtual_time import VirtualTimeLoop
from tests.stories import cycles, on_a_bus

SERVER_DEVICE_BUSY = 6

# consumers


def test_two_consumers_of_a_group_cost_one_wire_read() -> None:
    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("7")
        group = bus.poll_group("g", period=0.1, points=[point])
        first, second = await asyncio.gather(cycles(group, 5), cycles(group, 5))
        assert [s.cycle for s in first] == [s.cycle for s in second]
        assert Node.of(point).statistics().attempts == first[-1].cycle

    on_a_bus(story)


def test_a_slow_consumer_loses_the_oldest_and_knows_how_many() -> None:
    async def story(bus: Bus) -> None:
        group = bus.poll_group("g", period=0.1, points=[Hcp2Controller(bus, 1).point("7")])
        slow = group.subscribe(buffer=3)
        await cycles(group, 10)
        assert slow.dropped == 7
        assert [(await anext(slow)).cycle for _ in range(3)] == [8, 9, 10]

    on_a_bus(story)


def test_r10_snapshots_come_on_the_grid_and_say_when_they_were_due() -> None:
    async def story(bus: Bus) -> None:
        group = bus.poll_group("g", period=0.1, points=[Hcp2Controller(bus, 1).point("7")])
        snapshots = await cycles(group, 6)
        assert [b.due - a.due for a, b in pairwise(snapshots)] == pytest.approx([0.1] * 5)
        assert all(s.started is not None and s.started - s.due < 0.001 for s in snapshots[1:])

    on_a_bus(story)


def test_points_come_and_go_while_it_runs() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        group = bus.poll_group("g", period=0.1, points=[axis.point("7")])
        await cycles(group, 2)
        group.add(axis.point("8"), axis.point("7"))
        assert set((await cycles(group, 2))[-1]) == {axis.point("7"), axis.point("8")}
        group.remove(axis.point("7"))
        assert set((await cycles(group, 2))[-1]) == {axis.point("8")}

    on_a_bus(story)


def test_a_pause_and_a_demand() -> None:
    async def story(bus: Bus) -> None:
        group = bus.poll_group("g", period=10.0, points=[Hcp2Controller(bus, 1).point("7")])
        await cycles(group, 1)
        asked = bus.now()
        group.demand()
        assert (await cycles(group, 1))[0].due == asked
        group.pause()
        await asyncio.sleep(35.0)
        assert group.statistics().cycles == 2
        group.resume()
        snapshot = (await cycles(group, 1))[0]
        assert snapshot.missed == 0
        assert snapshot.due - asked > 35.0

    on_a_bus(story)


def test_a_demand_is_sent_at_once_and_not_with_what_the_line_does_next() -> None:
    async def story(bus: Bus) -> None:
        group = bus.poll_group("g", period=1000.0, points=[Hcp2Controller(bus, 1).point("7")])
        await cycles(group, 1)
        await asyncio.sleep(1.0)
        asked = bus.now()
        group.demand()
        snapshot = (await cycles(group, 1))[0]
        assert (snapshot.due, snapshot.started) == (asked, asked)
        assert bus.now() - asked < 0.1  # in virtual time: one exchange

    on_a_bus(story)


def test_a_group_says_whether_it_is_paused_and_a_sample_how_old_it_is() -> None:
    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("7")
        group = bus.poll_group("g", period=0.1, points=[point])
        sample = (await cycles(group, 1))[0][point]
        assert sample.started is not None
        assert sample.started < sample.finished
        assert sample.age(sample.finished) == sample.finished - sample.started
        assert sample._replace(started=None).age(sample.finished + 1.0) == pytest.approx(1.0)
        states = [group.paused]
        for change in (group.pause, group.resume):
            change()
            states.append(group.paused)
        assert states == [False, True, False]

    on_a_bus(story)


def test_statistics_say_what_was_asked_and_what_was_had() -> None:
    async def story(bus: Bus) -> None:
        points = [Hcp2Controller(bus, address).point("7") for address in (1, 2)]
        group = bus.poll_group("g", period=0.1, points=points)
        await cycles(group, 21)
        counts = group.statistics()
        assert (counts.cycles, counts.missed, counts.good, counts.bad) == (21, 0, 42, 0)
        assert counts.period == 0.1
        assert counts.achieved == pytest.approx(0.1, rel=0.01)
        assert counts.cycle_time.count == 21
        assert counts.cycle_time.p50 == pytest.approx(0.009, abs=0.002)
        bus.reset_statistics()
        assert group.statistics().cycles == 0
        assert (await cycles(group, 2))[-1].cycle == 23
        assert group.statistics().good == 4

    on_a_bus(story)


def test_a_sample_says_what_it_waited_for() -> None:
    """Node 2 is dead: its failed request is what the poll waited for. Its maximum reply delay is over then: nothing
    resynchronises."""

    async def story(bus: Bus) -> None:
        dead = bus.node(hcp2.PROFILE, 9)
        group = bus.poll_group("g", period=0.5, points=[Hcp2Controller(bus, 1).point("7")])
        due = (await cycles(group, 2))[-1].due + 0.5
        await asyncio.sleep(due - bus.now() - 0.010)
        with pytest.raises(NoReply):
            await dead.request(hcp2.Read(1), retries=0)
        sample = (await cycles(group, 1))[0][Hcp2Controller(bus, 1).point("7")]
        assert sample.due == pytest.approx(due)
        assert sample.started is not None
        assert sample.started - sample.due == pytest.approx(0.150 - 0.010, abs=0.002)
        assert sample.timeline.exchanges_ahead == 1
        assert sample.timeline.quiet_time_ahead == pytest.approx(0.0, abs=0.001)
        assert group.statistics().exchanges_ahead > 0

    on_a_bus(story)


# stale


def test_a_sample_read_before_a_write_to_its_point_ended_is_stale() -> None:
    """The write goes between two reads of one cycle: what was read before it is marked, what comes after is not."""

    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        before, after, other = axis.point("1"), axis.point("99"), Hcp2Controller(bus, 2).point("1")
        between = [axis.point(str(element)) for element in range(10, 30)]
        group = bus.poll_group("g", period=1.0, points=[before, other, *between, after])
        await cycles(group, 1)
        group.demand()
        await asyncio.sleep(0.030)
        await before.write(5.0)
        await after.write(6.0)
        snapshot = (await cycles(group, 1))[0]
        assert snapshot[before].quality is Quality.STALE
        assert snapshot[before].value == 0.0
        assert snapshot[after].quality is Quality.GOOD
        assert snapshot[after].value == 6.0
        assert snapshot[other].quality is Quality.GOOD
        assert group.statistics().stale == 1
        fresh = (await cycles(group, 1))[0]
        assert (fresh[before].value, fresh[before].quality) == (5.0, Quality.GOOD)

    on_a_bus(story)


def test_a_write_that_names_no_point_makes_all_of_its_node_stale() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        mine, other = [axis.point(str(e)) for e in range(1, 20)], Hcp2Controller(bus, 2).point("1")
        group = bus.poll_group("g", period=1.0, points=[other, *mine])
        await cycles(group, 1)
        group.demand()
        await asyncio.sleep(0.040)
        await axis.node.request(hcp2.Write(50, (1.0,)))
        snapshot = (await cycles(group, 1))[0]
        assert snapshot[other].quality is Quality.GOOD
        assert snapshot[mine[0]].quality is Quality.STALE
        assert snapshot[mine[-1]].quality is Quality.GOOD

    on_a_bus(story)


def test_a_read_that_starts_as_the_write_ends_is_not_stale() -> None:
    """It starts in the same moment, before the writer has even woken up."""

    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("1")
        group = bus.poll_group("g", period=1.0, points=[point])
        await cycles(group, 1)
        writing = asyncio.create_task(point.write(5.0))
        await asyncio.sleep(0)
        group.demand()
        sample = (await cycles(group, 1))[0][point]
        await writing
        assert (sample.value, sample.quality) == (5.0, Quality.GOOD)
        assert sample.timeline.exchanges_ahead == 1

    on_a_bus(story)


def test_a_write_whose_caller_gave_up_on_the_wire_makes_stale_too() -> None:
    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("1")
        group = bus.poll_group("g", period=1.0, points=[point])
        await cycles(group, 1)
        writing = asyncio.create_task(point.write(5.0))
        await asyncio.sleep(0)
        assert bus.latest(point) is not None
        writing.cancel()
        await asyncio.sleep(0)
        assert bus.latest(point) is None

    on_a_bus(story)


def test_a_write_that_was_never_sent_makes_nothing_stale() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        point = axis.point("1")
        group = bus.poll_group("g", period=1.0, points=[point])
        await cycles(group, 1)
        reading = asyncio.create_task(axis.read(9))
        await asyncio.sleep(0)
        writing = asyncio.create_task(point.write(5.0))
        await asyncio.sleep(0)
        writing.cancel()
        await reading
        assert bus.latest(point) is not None

    on_a_bus(story)


def test_a_write_makes_stale_what_shares_a_place_with_it_under_another_name() -> None:
    async def story(bus: Bus) -> None:
        unit = ModbusUnit(bus, 17)
        whole, half, other = (unit.point(item) for item in ("holding:10:uint32", "holding:11", "holding:12"))
        group = bus.poll_group("g", period=5.0, points=[whole, half, other])
        await cycles(group, 1)
        await half.write(7)
        assert [bus.latest(point) is not None for point in (whole, half, other)] == [False, False, True]
        group.demand()
        await cycles(group, 1)
        await whole.write(8)
        assert [bus.latest(point) is not None for point in (whole, half, other)] == [False, False, True]

    on_a_bus(story, make_device("modbus", 17), settings=ModbusUnit.profile.line)


def test_a_broadcast_makes_every_drive_stale() -> None:
    async def story(bus: Bus) -> None:
        point = MentorHandle(bus, 11).point("1.17")
        group = bus.poll_group("g", period=5.0, points=[point])
        await cycles(group, 1)
        assert bus.latest(point) is not None
        await bus.node(mentor.PROFILE, 0).request(mentor.Write(1, 17, 100))
        assert bus.latest(point) is None

    on_a_bus(story, EmulatedMentor(11), settings=mentor.PROFILE.line)


def test_reading_with_a_greatest_age_takes_the_polled_sample_until_a_write_makes_it_stale() -> None:
    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("1")
        group = bus.poll_group("g", period=1.0, points=[point])
        await cycles(group, 1)
        asked = Node.of(point).statistics().attempts
        assert await point.read(max_age=0.5) == 0.0
        assert Node.of(point).statistics().attempts == asked
        await point.write(5.0)
        assert await point.read(max_age=0.5) == 5.0
        await asyncio.sleep(0.6)
        await point.read(max_age=0.5)
        assert Node.of(point).statistics().attempts == asked + 3

    on_a_bus(story)


# cheaper exchanges


def mscs(values: int = 40, **options: Any) -> tuple[EmulatedMsc, LineSettings]:
    """An MSC with values from 100 up at the addresses from 2000 on."""
    device = EmulatedMsc(3, delay=Delay(0.005), packet_delay=Delay(0.005), **options)
    device.set_value(2000, *range(100, 100 + values))
    return device, LineSettings(9600)


def test_of_two_groups_with_a_point_the_younger_sample_serves() -> None:
    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("7")
        slow = bus.poll_group("slow", period=100.0, points=[point])
        await cycles(slow, 1)
        quick = bus.poll_group("quick", period=0.1, points=[point])
        await asyncio.sleep(1.0)
        youngest = (await cycles(quick, 1))[0][point]
        assert Node.of(point).latest(point) == youngest
        quick.close()
        slow.demand()
        youngest = (await cycles(slow, 1))[0][point]
        assert Node.of(point).latest(point) == youngest

    on_a_bus(story)


def test_neighbouring_values_come_in_one_exchange_and_points_stay_what_they_are() -> None:
    async def story(bus: Bus) -> None:
        press = MscController(bus, 3, address_step=4, model="MSC-250")
        points = [press.point(str(2000 + 4 * n)) for n in range(8)]
        flags = [press.point(f"flag:{n}") for n in (3, 5)]
        group = bus.poll_group("g", period=1.0, points=[*points, *flags])
        snapshot = (await cycles(group, 1))[0]
        assert [snapshot[point].value for point in points] == [100 + n for n in range(8)]
        assert [snapshot[flag].value for flag in flags] == [True, False]
        assert Node.of(press).statistics().attempts == 2
        merged = (await bus.plan()).groups[0].merged
        assert [m.serves for m in merged] == [8, 2]

    device, settings = mscs()
    device.flags.add(3)
    on_a_bus(story, device, settings=settings)


def test_what_is_merged_is_weighed_again_when_reply_times_are_known() -> None:
    """Three values: one block while replies are thought to be slow, three reads when they turn out to be quick."""

    async def story(bus: Bus) -> None:
        press = MscController(bus, 3, address_step=4)
        group = bus.poll_group("g", period=1.0, points=[press.point(str(2000 + 4 * n)) for n in range(3)])
        assert (await bus.plan()).groups[0].exchanges == 1
        await cycles(group, 9)
        assert Node.of(press).statistics().attempts == 8 + 3
        assert (await bus.plan()).groups[0].exchanges == 3

    device, settings = mscs()
    on_a_bus(story, device, settings=settings)


def test_a_refused_batch_falls_back_to_single_reads_in_the_same_period() -> None:
    """The block would reach past the last address that exists: the controller says NAK, and no snapshot shows it."""

    async def story(bus: Bus) -> None:
        press = MscController(bus, 3, address_step=4)
        points = [press.point(str(2000 + 4 * n)) for n in range(6)]
        group = bus.poll_group("g", period=4.0, points=points)
        started = bus.now()
        snapshots = await cycles(group, 3)
        assert [[s[point].value for point in points] for s in snapshots] == [[100 + n for n in range(6)]] * 3
        assert snapshots[0].finished - started < 4.0
        assert (await bus.plan()).groups[0].merged == ()

    device, settings = mscs(values=6, addresses=2024)
    on_a_bus(story, device, settings=settings)


def test_a_refused_value_that_stands_alone_is_refused() -> None:
    async def story(bus: Bus) -> None:
        press = MscController(bus, 3, address_step=4)
        point = press.point("60000")
        group = bus.poll_group("g", period=4.0, points=[point])
        assert isinstance((await cycles(group, 1))[0][point].error, Refused)

    device, settings = mscs()
    on_a_bus(story, device, settings=settings)


def test_runs_of_parameters_are_chained_only_by_those_who_opt_in() -> None:
    async def story(bus: Bus) -> None:
        drive = MentorHandle(bus, 11)
        points = [drive.point(f"1.{number}") for number in (17, 18, 19)]
        single = bus.poll_group("single", period=1.0, points=points)
        chained = bus.poll_group("chained", period=1.0, points=points, merge=[mentor.merge_runs])
        first, second = await asyncio.gather(cycles(single, 2), cycles(chained, 2))
        assert [first[1][p].value for p in points] == [second[1][p].value for p in points]
        one, other = (await bus.plan()).groups
        assert (one.exchanges, other.exchanges) == (3, 1)
        assert other.merged[0].saved > 0

    on_a_bus(story, EmulatedMentor(11), settings=mentor.PROFILE.line)


# points of one quantity, made by several hands


def test_a_write_makes_the_same_quantity_stale_by_whatever_name_it_is_polled() -> None:
    async def story(bus: Bus) -> None:
        drive = MentorHandle(bus, 11)
        polled = [drive.point("1.17"), drive.point("01.17"), drive.point("1.17:hires")]
        other = drive.point("1.18")
        group = bus.poll_group("g", period=5.0, points=[*polled, other])
        await cycles(group, 1)
        await drive.point("1.17:wide").write(7)
        assert [bus.latest(point) for point in polled] == [None] * 3
        assert bus.latest(other) is not None

    on_a_bus(story, EmulatedMentor(11), settings=mentor.PROFILE.line)


def test_two_handles_that_scale_a_parameter_differently_have_different_points() -> None:
    async def story(bus: Bus) -> None:
        raw, scaled = MentorHandle(bus, 11), MentorHandle(bus, 11, decimals={"1.17": 1})
        await raw.write("1.17", 476)
        items = ("1.17", "1.17:2")
        points = [handle.point(item) for item in items for handle in (raw, scaled)]
        group = bus.poll_group("g", period=1.0, points=points)
        snapshot = (await cycles(group, 1))[0]
        assert [snapshot[point].value for point in points[:2]] == [476, 47.6]
        assert [snapshot[point].value[0] for point in points[2:]] == [476, 47.6]
        assert await scaled.point("1.17").read(max_age=1.0) == 47.6
        assert MentorHandle(bus, 11, decimals={"1.17": 1}).point("1.17") == points[1]

    on_a_bus(story, EmulatedMentor(11), settings=mentor.PROFILE.line)


# values that mean nothing


def test_a_value_that_cannot_be_decoded_is_an_error_of_its_point_alone() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        good = axis.point("7")
        bad = Point(axis.node, "colour", hcp2.Read(7), decode={1.0: "red"}.__getitem__)
        group = bus.poll_group("g", period=0.1, points=[good, bad])
        snapshot = (await cycles(group, 2))[-1]
        assert snapshot[good].value == 0.0
        sample: Sample[Any] = snapshot[bad]
        assert (sample.value, sample.quality) == (None, Quality.BAD)
        assert isinstance(snapshot[bad].error, GarbledReply)
        assert (await bus.statistics()).losses == 0
        with pytest.raises(GarbledReply, match="colour"):
            await bad.read()

    on_a_bus(story)


def test_two_tasks_may_share_a_stream() -> None:
    async def story(bus: Bus) -> None:
        stream = bus.poll_group("g", period=0.1, points=[Hcp2Controller(bus, 1).point("7")]).subscribe()
        first, second = await asyncio.gather(anext(stream), anext(stream))
        assert {first.cycle, second.cycle} == {1, 2}

    on_a_bus(story)


def test_samples_carry_the_time_of_day_which_follows_a_clock_that_was_set(monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(bus: Bus) -> None:
        def machine(seconds: float) -> None:
            monkeypatch.setattr(time, "time", lambda: bus.now() + seconds)

        axis = Hcp2Controller(bus, 1)
        points = [axis.element(1), axis.element(2)]
        group = bus.poll_group("g", period=0.1, points=points)
        found = []
        for offset in (1000.0, 1000.002, 5000.0, 400.0):
            machine(offset)
            [_, snapshot] = await cycles(group, 2)
            found.append({round(snapshot[point].wall - snapshot[point].finished, 6) for point in points})
            assert snapshot.wall_at(snapshot.finished) == snapshot.wall
            assert snapshot.wall_at(snapshot.due) == pytest.approx(snapshot.wall - (snapshot.finished - snapshot.due))
            assert bus.wall_time() - bus.now() == pytest.approx(min(found[-1]))
        assert found == [{1000.0}, {1000.0}, {5000.0}, {400.0}]  # 2 ms is two clocks read one after the other

    on_a_bus(story)


def test_samples_carry_the_right_time_of_day_though_the_program_was_stopped_while_it_read_the_clocks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def story(bus: Bus) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualTimeLoop)
        standstills = [10.0]

        def wakes() -> float:
            """The machine's clock, which is read after the program has stood still."""
            loop.jump(standstills.pop() if standstills else 0.0)
            return bus.now() + 1000.0

        monkeypatch.setattr(time, "time", wakes)
        assert bus.wall_time() - bus.now() == pytest.approx(1000.0)

    on_a_bus(story)


# groups by their names


def test_a_name_belongs_to_one_group_at_a_time() -> None:
    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("7")
        groups = [bus.poll_group(name, period=0.1, points=[point]) for name in ("fast", "slow")]
        assert [bus.group(group.name) for group in groups] == groups
        with pytest.raises(InvalidCommand, match="a poll group 'fast' already exists"):
            bus.poll_group("fast", period=0.2, points=[point])
        groups[0].close()
        with pytest.raises(InvalidCommand, match=r"no poll group 'fast'; there are: slow$"):
            bus.group("fast")
        again = bus.poll_group("fast", period=0.2, points=[point])
        groups[0].close()  # the group that it was does not end the new one
        assert bus.group("fast") is again
        groups[1].close()
        again.close()
        with pytest.raises(InvalidCommand, match=r"no poll group 'fast'; there are: none$"):
            bus.group("fast")

    on_a_bus(story)


def test_whoever_follows_the_groups_is_called_when_one_is_made_or_ends() -> None:
    async def story(bus: Bus) -> None:
        point, seen = Hcp2Controller(bus, 1).point("7"), list[list[str]]()
        bus._line.on_groups.append(lambda: seen.append([group.name for group in bus.groups]))
        group = bus.poll_group("a", period=0.1, points=[point])
        bus.poll_group("b", period=0.1, points=[point])
        group.close()
        group.close()
        assert seen == [["a"], ["a", "b"], ["b"]]

    on_a_bus(story)


def test_a_group_that_is_closed_ends_its_consumers_and_takes_no_more() -> None:
    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("7")
        group = bus.poll_group("g", period=0.1, points=[point])
        consumers = [group.subscribe(), group.subscribe(changes=True)]
        await cycles(group, 2)
        group.close()
        assert [[snapshot.cycle async for snapshot in consumer] for consumer in consumers] == [[1, 2], [1, 2]]
        for changes in (False, True):
            with pytest.raises(BusClosed, match="poll group 'g' is closed"):
                group.subscribe(changes=changes)
        assert bus.latest(point) is None
        sent = Node.of(point).statistics().attempts
        await asyncio.sleep(1.0)
        assert Node.of(point).statistics().attempts == sent

    on_a_bus(story)


def test_a_group_reads_only_points_of_its_own_bus_and_is_unchanged_by_a_refusal() -> None:
    other = Bus(MemoryPort(Line(LineSettings(57600), [EmulatedMint(1)])))

    async def story(bus: Bus) -> None:
        own, foreign = Hcp2Controller(bus, 1).point("7"), Hcp2Controller(other, 1).point("8")
        group = bus.poll_group("g", period=0.1, points=[own])
        for points in ([foreign], [Hcp2Controller(bus, 1).point("9"), foreign]):
            with pytest.raises(InvalidCommand, match="poll group 'g': 1/8 belongs to another bus"):
                group.add(*points)
        assert group.points == (own,)
        with pytest.raises(InvalidCommand, match="belongs to another bus"):
            bus.poll_group("h", period=0.1, points=[foreign])
        assert [group.name for group in bus.groups] == ["g"]

    on_a_bus(story)


def test_the_last_periods_are_kept_without_a_pause_and_until_a_reset() -> None:
    async def story(bus: Bus) -> None:
        group = bus.poll_group("g", period=0.1, points=[Hcp2Controller(bus, 1).point("7")])
        await cycles(group, 4)
        assert group.recent_periods == pytest.approx((0.1,) * 3, abs=0.001)
        group.pause()
        await asyncio.sleep(5.0)
        group.resume()
        await cycles(group, 3)
        assert group.recent_periods == pytest.approx((0.1,) * 5, abs=0.001)
        assert group.statistics().achieved == pytest.approx(0.1, abs=0.001)
        group.reset_statistics()
        assert group.recent_periods == ()
        counts = group.statistics()
        assert (counts.missed, counts.jitter.count, counts.cycle_time.count, counts.achieved) == (0, 0, 0, 0.0)

    on_a_bus(story)


def test_the_time_between_cycles_that_are_demanded_during_a_pause_is_no_period() -> None:
    async def story(bus: Bus) -> None:
        group = bus.poll_group("g", period=0.1, points=[Hcp2Controller(bus, 1).point("7")])
        await cycles(group, 2)
        assert len(group.recent_periods) == 1
        group.pause()
        for _ in range(2):
            await asyncio.sleep(5.0)
            group.demand()
            await cycles(group, 1)
        group.resume()
        await cycles(group, 3)
        assert group.recent_periods == pytest.approx((0.1,) * 3, abs=0.001)
        assert group.statistics().achieved == pytest.approx(0.1, abs=0.001)

    on_a_bus(story)


def test_missed_cycles_are_counted_until_a_reset() -> None:
    async def story(bus: Bus) -> None:
        group = bus.poll_group("g", period=0.003, points=[Hcp2Controller(bus, 1).point("7")])
        missed = (await cycles(group, 5))[-1].missed
        group.pause()
        assert group.statistics().missed == missed > 0
        group.reset_statistics()
        assert group.statistics().missed == 0

    on_a_bus(story)


def test_when_a_point_was_last_good_is_known_while_it_fails() -> None:
    device = EmulatedMint(1)

    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        point, never = axis.point("7"), axis.point("8")
        group = bus.poll_group("g", period=1.0, points=[point])
        assert group.good_at(point) is None
        [snapshot] = await cycles(group, 1)
        good = snapshot[point].wall
        assert group.good_at(point) == good
        device.faults.dead = 1.0
        for _ in range(3):
            [snapshot] = await cycles(group, 1)
            assert snapshot[point].error is not None
            assert group.good_at(point) == good
        group.add(never)
        await cycles(group, 2)
        assert (group.good_at(never), group.good_at(point)) == (None, good)
        group.remove(point)
        assert group.good_at(axis.point("9")) is None
        group.add(point)
        await cycles(group, 2)
        assert group.good_at(point) is None, "a point that was removed begins again"

    on_a_bus(story, device)


def test_when_a_point_was_last_good_is_known_after_a_read_after_a_write_that_failed() -> None:
    def decode(raw: float) -> float:
        if raw >= 5:
            raise GarbledReply("out of range")
        return raw

    async def story(bus: Bus) -> None:
        controller = Hcp2Controller(bus, 1)
        point = replace(controller.point("7"), decode=decode, read_after_write=True)
        group = bus.poll_group("g", period=1000.0, points=[point])
        [snapshot] = await cycles(group, 1)
        changes = group.subscribe(changes=True)
        await controller.write(7, 6)
        while (change := await anext(changes))[point].error is None:
            pass
        assert group.latest is not None
        assert group.latest[point].error is not None
        assert change.cycle == snapshot.cycle
        assert group.good_at(point) == snapshot[point].wall

    on_a_bus(story)


def test_a_stream_that_is_closed_holds_what_it_has_and_takes_no_more() -> None:
    async def story(bus: Bus) -> None:
        group = bus.poll_group("g", period=0.1, points=[Hcp2Controller(bus, 1).point("7")])
        stream = group.subscribe(buffer=8)
        await cycles(group, 2)
        stream.close()
        stream.close()
        await cycles(group, 2)
        assert ([snapshot.cycle async for snapshot in stream], stream.dropped) == ([1, 2], 0)
        waits = group.subscribe()
        ending = asyncio.ensure_future(anext(waits))
        await asyncio.sleep(0)
        waits.close()
        with pytest.raises(StopAsyncIteration):
            await ending
        for wrong in (0, -1, 1.5, True):
            with pytest.raises(InvalidCommand, match="a buffer"):
                group.subscribe(buffer=wrong)  # type: ignore[arg-type]  # some of them

    on_a_bus(story)


def test_a_stream_ends_with_the_first_cause_that_it_was_given() -> None:
    async def story(bus: Bus) -> None:
        stream = Stream[int]([], 4)
        stream.put(1)
        stream.close(KeyError("first"))
        stream.close(ValueError("second"))
        assert await anext(stream) == 1
        for _ in range(2):
            with pytest.raises(KeyError, match="first"):
                await anext(stream)
        ended = Stream[int]([], 4)
        ended.close()
        ended.close(ValueError("later"))
        with pytest.raises(StopAsyncIteration):
            await anext(ended)

    on_a_bus(story)


def test_an_application_may_leave_the_loop_over_a_group_and_its_consumer_ends() -> None:
    async def story(bus: Bus) -> None:
        group = bus.poll_group("g", period=0.1, points=[Hcp2Controller(bus, 1).point("7")])
        iteration = aiter(group)
        await anext(iteration)
        assert len(group._consumers) == 1
        await iteration.aclose()  # type: ignore[attr-defined]  # it is a generator
        assert group._consumers == []

    on_a_bus(story)


def test_the_last_value_is_that_of_the_last_reply_and_not_of_a_later_read_that_failed() -> None:
    device = EmulatedMint(1)

    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        await axis.write(7, 5.0)
        first = bus.poll_group("first", period=1000.0, points=[axis.point("7")])
        await cycles(first, 1)
        device.faults.dead = 1.0
        [failed] = await cycles(bus.poll_group("second", period=1000.0, points=[axis.point("7")]), 1)
        assert isinstance(failed[axis.point("7")].error, NoReply)
        assert ext.last_value(axis.point("7")) == 5.0

    on_a_bus(story, device)


def test_a_sample_that_becomes_stale_within_its_cycle_is_counted_once() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        points = [axis.point(str(element)) for element in range(1, 25)]
        group = bus.poll_group("g", period=10.0, points=points)
        await cycles(group, 1)
        group.demand()
        await asyncio.sleep(0.030)
        await points[0].write(5.0)
        await cycles(group, 1)
        counts = group.statistics()
        assert (counts.cycles, counts.good, counts.late, counts.stale, counts.bad) == (2, 47, 0, 1, 0)

    on_a_bus(story)


def test_a_read_that_one_node_refuses_is_still_merged_for_the_others() -> None:
    devices = [make_device("modbus", 17), make_device("modbus", 18, size=3)]

    async def story(bus: Bus) -> None:
        units = [ModbusUnit(bus, address) for address in (17, 18)]
        points = [unit.point(f"holding:{place}") for unit in units for place in range(5)]
        group = bus.poll_group("g", period=5.0, points=points)
        [snapshot] = await cycles(group, 1)
        assert [point.key for point, sample in snapshot.items() if sample.error is not None] == [
            "18/holding:3",
            "18/holding:4",
        ]
        merged = (await bus.plan()).groups[0].merged
        assert [(reads.node, reads.serves) for reads in merged if reads.node == "node 17"] == [("node 17", 5)]
        sent = Node.of(units[0]).statistics().attempts
        await cycles(group, 3)
        assert Node.of(units[0]).statistics().attempts == sent + 3

    on_a_bus(story, *devices, settings=ModbusUnit.profile.line)


def test_a_merge_of_the_group_that_a_node_refuses_is_not_in_the_plan() -> None:
    async def story(bus: Bus) -> None:
        drive = MentorHandle(bus, 11)
        points = [drive.point(f"1.{number}") for number in (35, 36, 37)]  # the drive has no 1.37
        group = bus.poll_group("g", period=1.0, points=points, merge=[mentor.merge_runs])
        planned = (await bus.plan()).groups[0]
        assert [reads.serves for reads in planned.merged] == [3]
        [snapshot] = await cycles(group, 1)
        assert [snapshot[point].error is None for point in points] == [True, True, False]
        planned = (await bus.plan()).groups[0]
        assert (planned.exchanges, planned.merged) == (3, ())

    on_a_bus(story, EmulatedMentor(11), settings=mentor.PROFILE.line)


def test_reads_are_merged_again_when_a_node_that_was_busy_is_not() -> None:
    class Busy(EmulatedModbus):
        busy = False

        def _read(self, function: int, first: int, count: int, now: float) -> bytes:
            if self.busy:
                raise Illegal(SERVER_DEVICE_BUSY)
            return super()._read(function, first, count, now)

    device = Busy(17)

    async def story(bus: Bus) -> None:
        unit = ModbusUnit(bus, 17)
        points = [unit.point(f"holding:{place}") for place in range(5)]
        group = bus.poll_group("g", period=5.0, points=points)
        await cycles(group, 1)
        device.busy = True
        [snapshot] = await cycles(group, 1)
        assert all(isinstance(sample.error, Refused) for sample in snapshot.values())
        device.busy = False
        assert [merged.serves for merged in (await bus.plan()).groups[0].merged] == [5]
        sent = Node.of(unit).statistics().attempts
        [snapshot] = await cycles(group, 1)
        assert [sample.value for sample in snapshot.values()] == [0] * 5
        assert Node.of(unit).statistics().attempts == sent + 1

    on_a_bus(story, device, settings=ModbusUnit.profile.line)


def test_what_a_closed_group_has_read_is_not_the_value_before_a_write() -> None:
    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("7")
        group = bus.poll_group("g", period=0.1, points=[point])
        await cycles(group, 1)
        assert Node.of(point)._held(point) is not None
        group.close()
        assert Node.of(point)._held(point) is None

    on_a_bus(story)


def test_periods_are_measured_by_the_times_at_which_cycles_were_due_if_nothing_can_be_sent() -> None:
    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("7")
        group = bus.poll_group("g", period=0.1, points=[point])
        Node.of(point).suspend(100.0)
        [*_, snapshot] = await cycles(group, 4)
        assert (snapshot.started, isinstance(snapshot[point].error, NodeDown)) == (None, True)
        assert group.recent_periods == pytest.approx((0.1,) * 3)
        counts = group.statistics()
        assert counts.achieved == pytest.approx(0.1)
        assert (counts.exchanges_ahead, counts.quiet_time_ahead) == (0.0, 0.0), "none waited: nothing was sent"

    on_a_bus(story)


def test_the_time_of_a_cycle_counts_from_when_it_was_due() -> None:
    async def story(bus: Bus) -> None:
        dead = bus.node(hcp2.PROFILE, 9)
        group = bus.poll_group("g", period=0.5, points=[Hcp2Controller(bus, 1).point("7")])
        due = (await cycles(group, 2))[-1].due + 0.5
        group.reset_statistics()
        await asyncio.sleep(due - bus.now() - 0.010)
        with pytest.raises(NoReply):
            await dead.request(hcp2.Read(1), retries=0)
        await cycles(group, 2)
        counts = group.statistics()
        assert (counts.cycles, counts.cycle_time.count) == (2, 2)
        assert counts.cycle_time.highest > 0.140
        assert counts.exchanges_ahead == pytest.approx(0.5)  # one exchange before one of the two cycles

    on_a_bus(story)
