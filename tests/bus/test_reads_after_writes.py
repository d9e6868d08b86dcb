"""Points with `read_after_write`: read when a write to them is confirmed, not with the next cycle."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any

import pytest

from busmaster import Bus, Hcp2Controller, MemoryPort, ModbusUnit, ext
from busmaster.bus.meaning import Meaning
from busmaster.bus.node import Node, Priority
from busmaster.bus.points import Point
from busmaster.bus.polling import PollGroup, Quality
from busmaster.bus.snapshots import Outdated, ReadAfterWrite, Snapshot
from busmaster.emulator.device import Device
from busmaster.emulator.line import Line
from busmaster.errors import WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import make_device
from busmaster.testing.virtual_time import run_in_virtual_time

SLOW = 1000.0
"""Seconds of a period in which no cycle comes by itself while a test runs."""
Story = Callable[[Bus, Device], Awaitable[None]]


def on_a_line(story: Story) -> None:
    async def run() -> None:
        device = make_device("hcp2", 5)
        line = Line(Hcp2Controller.profile.line, [device], chance=random.Random(1))
        async with Bus(MemoryPort(line), seed=1) as bus:
            await story(bus, device)

    run_in_virtual_time(run())


def point_of(bus: Bus, name: str, **changed: Any) -> Point[Any]:
    return replace(Hcp2Controller(bus, 5).point(name), **changed)


async def polled(bus: Bus, *points: Point[Any], name: str = "axes", period: float = SLOW) -> PollGroup:
    """A group that has had its first cycle."""
    group = bus.poll_group(name, period=period, points=points)
    group.demand()
    while group.latest is None:  # noqa: ASYNC110  time is virtual
        await asyncio.sleep(0.01)
    return group


async def settle() -> None:
    """Let all that waits be sent."""
    await asyncio.sleep(1.0)


def held(group: PollGroup, point: Point[Any]) -> tuple[object, Quality]:
    assert group.latest is not None
    sample = group.latest.samples[point]
    return sample.value, sample.quality


def test_a_write_is_confirmed_before_the_read_after_it_is_sent() -> None:
    async def story(bus: Bus, device: Device) -> None:
        point = point_of(bus, "10", read_after_write=True)
        group = await polled(bus, point)
        sent, polls = (await bus.statistics()).exchanges, (await bus.statistics()).waits[Priority.POLL].count
        await point.write(7.0)
        assert (await bus.statistics()).exchanges == sent + 1
        assert bus._reads_after_writes.read == 0
        assert bus.latest(point) is None  # the value before is stale
        await settle()
        assert held(group, point) == (7.0, Quality.GOOD)
        assert (await bus.statistics()).exchanges == sent + 2
        assert (await bus.statistics()).waits[Priority.POLL].count == polls + 1  # commands go before it
        assert bus._reads_after_writes.read == 1
        assert await point.read(max_age=SLOW) == 7.0
        assert Node.of(point)._held(point) == 7.0  # what a limit of the step begins with
        assert (await bus.statistics()).exchanges == sent + 2
        assert group.statistics().cycles == 1

    on_a_line(story)


def test_every_point_of_the_quantity_gets_the_value_in_every_group_and_no_other_is_read() -> None:
    async def story(bus: Bus, device: Device) -> None:
        point, other = point_of(bus, "10", read_after_write=True), point_of(bus, "11")
        twin = point_of(bus, "10", item="twin", decode=lambda raw: raw * 10)
        group = await polled(bus, point, twin, other)
        second = await polled(bus, twin, name="second")
        await settle()
        before = group.latest
        assert before is not None
        await point_of(bus, "10").write(7.0)  # by the name that the protocol has for it
        await settle()
        assert held(group, point) == (7.0, Quality.GOOD)
        assert held(group, twin) == held(second, twin) == (70.0, Quality.GOOD)
        assert group.latest is not None
        assert group.latest.samples[other] is before.samples[other]
        assert before.samples[point].value == 0  # whoever holds the cycle still has what it was

    on_a_line(story)


def test_a_point_without_the_option_is_not_read_and_stays_stale() -> None:
    async def story(bus: Bus, device: Device) -> None:
        point = point_of(bus, "10")
        group = await polled(bus, point)
        sent = (await bus.statistics()).exchanges
        await point.write(7.0)
        await settle()
        assert (await bus.statistics()).exchanges == sent + 1
        assert group.latest is not None
        assert bus.as_of_now(point, group.latest.samples[point]).quality is Quality.STALE

    on_a_line(story)


@pytest.mark.parametrize("options", [{}, {"finish_within": 0.03}], ids=["no reply", "the caller gave up"])
def test_after_a_write_that_was_not_confirmed_nothing_is_read(options: Any) -> None:
    async def story(bus: Bus, device: Device) -> None:
        point = point_of(bus, "10", read_after_write=True)
        group = await polled(bus, point)
        await settle()
        device.faults.lost = 1.0  # it obeys, and does not say so
        with pytest.raises(WriteUnconfirmed):
            await point.write(7.0, **options)
        await settle()
        device.faults.lost = 0.0
        assert (bus._reads_after_writes.read, bus._reads_after_writes.failed) == (0, 0)
        assert group.latest is not None
        assert bus.as_of_now(point, group.latest.samples[point]).quality is Quality.STALE

    on_a_line(story)


def test_one_read_serves_all_writes_that_are_confirmed_before_it_is_sent() -> None:
    async def story(bus: Bus, device: Device) -> None:
        point = point_of(bus, "10", read_after_write=True)
        group = await polled(bus, point)
        await asyncio.gather(*(point.write(float(number)) for number in range(1, 21)))
        await settle()
        assert held(group, point) == (20.0, Quality.GOOD)
        counts = bus._reads_after_writes
        assert counts.read <= 4  # the class of polls has a share of the line, too
        assert counts.shared >= 16
        assert counts.failed == 0
        bus.reset_statistics()
        assert (counts.read, counts.shared, counts.failed) == (0, 0, 0)
        await point.write(3.0)
        await settle()
        assert counts.read == 1  # the next write has a read of its own again

    on_a_line(story)


def test_a_read_after_a_write_that_fails_is_counted_and_the_value_stays_stale() -> None:
    async def story(bus: Bus, device: Device) -> None:
        point = point_of(bus, "10", read_after_write=True)
        group = await polled(bus, point)
        await point.write(7.0)
        device.faults.dead = 1.0
        await settle()
        await settle()
        assert (bus._reads_after_writes.read, bus._reads_after_writes.failed) == (0, 1)
        assert group.latest is not None
        assert bus.as_of_now(point, group.latest.samples[point]).quality is Quality.STALE

    on_a_line(story)


def test_a_cycle_that_read_before_the_write_does_not_bring_the_old_value_back() -> None:
    async def story(bus: Bus, device: Device) -> None:
        point = point_of(bus, "10", read_after_write=True)
        others = [point_of(bus, str(number)) for number in range(11, 99)]
        fast = await polled(bus, point, name="fast", period=0.05)
        slow = await polled(bus, point, *others, name="slow", period=60.0)
        fast.pause()
        for _ in range(20):
            slow.demand()
            await asyncio.sleep(0.1)  # its first read is over, its last is not
            value = round(bus.now())
            cycles = slow.statistics().cycles
            await point.write(value)
            while slow.statistics().cycles == cycles:  # noqa: ASYNC110  time is virtual
                await asyncio.sleep(0.01)
            await settle()
            assert held(slow, point) == (value, Quality.GOOD)

    on_a_line(story)


def test_a_cycle_brings_the_old_value_of_none_of_several_points_back() -> None:
    async def story(bus: Bus, device: Device) -> None:
        points = [point_of(bus, name, read_after_write=True) for name in ("10", "11")]
        group = await polled(bus, *points, *(point_of(bus, str(number)) for number in range(12, 99)))
        group.demand()
        await asyncio.sleep(0.1)  # both are read, the last is not
        for point in points:
            await point.write(7.0)
        await settle()
        assert group.statistics().cycles == 2
        assert [held(group, point) for point in points] == [(7.0, Quality.GOOD)] * 2

    on_a_line(story)


def test_the_value_begins_an_alarm_at_once() -> None:
    async def story(bus: Bus, device: Device) -> None:
        point = point_of(bus, "10", read_after_write=True, meaning=Meaning(high=50.0))
        await polled(bus, point)
        await point.write(60.0)
        await settle()
        alarm = bus.alarms[point]
        assert alarm is not None
        assert (alarm.limit, alarm.value) == ("high", 60.0)

    on_a_line(story)


def test_consumers_of_changes_get_what_became_stale_once_and_then_the_new_value_alone() -> None:
    async def story(bus: Bus, device: Device) -> None:
        point, other = point_of(bus, "10", read_after_write=True), point_of(bus, "11")
        plain = point_of(bus, "12")
        group = await polled(bus, point, other, plain)
        cycles, changes = group.subscribe(), group.subscribe(changes=True)
        await asyncio.gather(point.write(6.0), point.write(7.0), plain.write(1.0))
        await plain.write(2.0)
        await settle()
        group.demand()
        await settle()
        group.close()
        told = [snapshot async for snapshot in changes]
        assert [
            (type(one), {point.item: (one[point].value, one[point].quality.value) for point in one}) for one in told
        ] == [
            (Outdated, {"10": (0, "stale")}),
            (Outdated, {"12": (0, "stale")}),
            (ReadAfterWrite, {"10": (7.0, "good")}),
            (Snapshot, {"10": (7.0, "good"), "11": (0, "good"), "12": (2.0, "good")}),
        ]
        assert [one.finished for one in told] == sorted(one.finished for one in told)
        assert [len(one) async for one in cycles] == [3]

    on_a_line(story)


def test_a_write_to_all_nodes_is_not_followed_by_reads() -> None:
    async def run() -> None:
        async with Bus(MemoryPort(Line(ModbusUnit.profile.line, [make_device("modbus", 5)])), seed=1) as bus:
            point = replace(ModbusUnit(bus, 5).point("holding:10"), read_after_write=True)
            group = await polled(bus, point)
            changes = group.subscribe(changes=True)
            await ModbusUnit(bus, 0).point("holding:10").write(7)
            await settle()
            assert bus._reads_after_writes.read == 0
            group.close()
            assert [(type(one), one[point].quality) async for one in changes] == [(Outdated, Quality.STALE)]

    run_in_virtual_time(run())


def test_all_points_that_a_write_makes_stale_are_read_in_each_group() -> None:
    async def story(bus: Bus, device: Device) -> None:
        points = [point_of(bus, item, read_after_write=True) for item in ("10", "11", "12")]
        first, second = await polled(bus, *points[:2]), await polled(bus, *points[2:], name="second")
        await settle()
        # It is not known what the command of a handle changes, so all points of its node are stale.
        await Hcp2Controller(bus, 5).node.request(hcp2.Write(10, (7.0,)))
        await settle()
        assert bus._reads_after_writes.read == 3
        assert [held(first, point)[1] for point in points[:2]] == [Quality.GOOD] * 2
        assert held(second, points[2])[1] is Quality.GOOD

    on_a_line(story)


def test_the_last_values_of_other_points_are_still_known_after_the_read() -> None:
    async def story(bus: Bus, device: Device) -> None:
        device.preset("11", 4.0)
        point, other = point_of(bus, "10", read_after_write=True), point_of(bus, "11")
        await polled(bus, point, other)
        await point.write(7.0)
        await settle()
        assert [ext.last_value(one) for one in (point, other)] == [7.0, 4.0]

    on_a_line(story)


def test_what_became_stale_has_the_time_of_the_write() -> None:
    async def story(bus: Bus, device: Device) -> None:
        point = point_of(bus, "10")
        group = await polled(bus, point)
        changes = group.subscribe(changes=True)
        await asyncio.sleep(100.0)
        await point.write(7.0)
        outdated = await anext(changes)
        assert outdated.finished == pytest.approx(bus.now(), abs=0.1)
        assert outdated.wall == outdated[point].wall == pytest.approx(outdated.finished + bus.wall_time() - bus.now())
        assert group.latest is not None
        assert outdated.wall - group.latest[point].wall > 99.0

    on_a_line(story)


def test_a_point_that_could_not_be_read_does_not_become_stale() -> None:
    async def story(bus: Bus, device: Device) -> None:
        bad, good = point_of(bus, "10", item="bad", decode={}.pop), point_of(bus, "10", item="good")
        group = await polled(bus, bad, good)
        changes = group.subscribe(changes=True)
        await point_of(bus, "10").write(7.0)
        await settle()
        group.close()
        assert group.latest is not None
        assert group.latest[bad].quality is Quality.BAD
        assert [list(one) async for one in changes] == [[good]]

    on_a_line(story)


def test_a_value_that_was_read_after_a_write_has_the_time_at_which_it_was_read() -> None:
    async def story(bus: Bus, device: Device) -> None:
        point = point_of(bus, "10", read_after_write=True)
        group = await polled(bus, point)
        changes = group.subscribe(changes=True)
        await asyncio.sleep(100.0)
        await point.write(7.0)
        assert isinstance(await anext(changes), Outdated)
        change = await anext(changes)
        assert isinstance(change, ReadAfterWrite)
        assert change.finished == pytest.approx(bus.now(), abs=0.1)
        assert change.wall == change[point].wall == pytest.approx(change.finished + bus.wall_time() - bus.now())

    on_a_line(story)


def test_a_read_that_is_not_sent_within_the_period_of_its_group_is_dropped() -> None:
    async def story(bus: Bus, device: Device) -> None:
        point = point_of(bus, "10", read_after_write=True)
        await polled(bus, point, period=0.3)
        async with Hcp2Controller(bus, 5).exclusive(max_hold=5.0) as held:
            await held.point("10").write(7.0)
            await asyncio.sleep(0.5)
        await settle()
        assert (bus._reads_after_writes.read, bus._reads_after_writes.failed) == (0, 1)

    on_a_line(story)


@pytest.mark.parametrize("again", [False, True], ids=["", "and it is written again without a confirmation"])
def test_a_value_read_after_a_write_in_a_running_cycle_is_counted_once_with_its_quality(again: bool) -> None:
    """The cycle has read the point before the write, so the value that was read after the write is in its snapshot."""

    async def story(bus: Bus, device: Device) -> None:
        point = point_of(bus, "10", read_after_write=True)
        others = [point_of(bus, str(number)) for number in range(11, 99)]
        group = await polled(bus, point, *others)
        await settle()
        bus.reset_statistics()
        group.demand()
        await asyncio.sleep(0.1)  # its first read is over, its last is not
        await point.write(7.0)
        while not bus._reads_after_writes.read:  # noqa: ASYNC110  time is virtual
            await asyncio.sleep(0.001)
        if again:
            device.faults.lost = 1.0
            with pytest.raises(WriteUnconfirmed):
                await point.write(8.0, retries=0)
            device.faults.lost = 0.0
        while not group.statistics().cycles:  # noqa: ASYNC110  time is virtual
            await asyncio.sleep(0.001)
        counts = group.statistics()
        assert held(group, point) == (7.0, Quality.STALE if again else Quality.GOOD)
        assert counts.stale == int(again)
        assert counts.good + counts.late + counts.stale + counts.bad == 89

    on_a_line(story)


def test_what_a_write_makes_stale_is_reported_to_the_consumers_of_each_group() -> None:
    async def story(bus: Bus, device: Device) -> None:
        point = point_of(bus, "10")
        groups = [await polled(bus, point, name=name) for name in ("first", "second", "third")]
        changes = [group.subscribe(changes=True) for group in groups]
        await point.write(7.0)
        assert [(type(one), one.group) for one in [await anext(each) for each in changes]] == [
            (Outdated, "first"),
            (Outdated, "second"),
            (Outdated, "third"),
        ]

    on_a_line(story)
