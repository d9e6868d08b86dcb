"""Hundreds of points and groups on one bus: what grows with them is done a piece at a time, and the line goes on."""

from __future__ import annotations

import asyncio
import gc
import logging
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from busmaster.arbiter.schedule import AT_ONCE, SLICE, Schedule
from busmaster.arbiter.transaction import Transaction
from busmaster.bus.bus import Bus
from busmaster.bus.points import Point
from busmaster.bus.polling import PollGroup
from busmaster.contract.exchange import Command
from busmaster.contract.profile import Batch
from busmaster.errors import InvalidCommand
from busmaster.planning.merging import WEIGHING
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.mentor.handle import MentorDrive
from busmaster.testing.virtual_time import VirtualTimeLoop
from tests.stories import cycles, on_a_bus

PERIODS = (0.25, 0.5, 1.0, 2.0, 0.1, 0.3, 0.7, 5.0)
SLICE_TAKES = 0.0005
"""Seconds of virtual time, in these tests."""


def points_of(bus: Bus, nodes: Sequence[int], elements: Sequence[int]) -> list[Point[Any]]:
    return [Hcp2Controller(bus, node).element(element) for node in nodes for element in elements]


def watched_slices(monkeypatch: pytest.MonkeyPatch, told: Callable[[], None]) -> None:
    """`told` is called after each call of the schedule."""
    begin = Schedule.begin

    def watched(self: Schedule, now: float) -> list[Transaction]:
        begun = begin(self, now)
        told()
        return begun

    monkeypatch.setattr(Schedule, "begin", watched)


@pytest.mark.slow
def test_two_hundred_groups_added_at_once_fail_nothing_and_exchanges_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each slice of the work takes half a millisecond here: reads must come between them as they came before."""
    slices = 0

    def takes_time() -> None:
        nonlocal slices
        slices += 1
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualTimeLoop)
        loop._now += SLICE_TAKES

    watched_slices(monkeypatch, takes_time)

    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        await axis.read(1)
        before = bus.now()
        await axis.read(1)
        usual = bus.now() - before
        points = points_of(bus, (1, 2), range(1, 10))
        groups = [
            bus.poll_group(str(n), period=100 * PERIODS[n % 8], points=points[n % 16 : n % 16 + 2]) for n in range(200)
        ]
        took = []
        while not all(group.poll.placed for group in groups):
            asked = bus.now()
            await axis.read(1)
            took.append(bus.now() - asked)
        assert slices > 100
        assert len(took) > 0.5 * slices * SLICE_TAKES / (2 * usual)
        assert max(took) < 3 * usual
        await asyncio.sleep(100 * max(PERIODS))
        assert all(group.latest for group in groups)
        assert sum(group.statistics().bad for group in groups) == 0
        for node in bus.nodes:
            assert node.statistics().no_reply == 0
            assert node.statistics().max_reply_delay == hcp2.PROFILE.timings.read.max_reply_delay

    on_a_bus(story)


def test_the_exchanges_of_a_large_group_are_chosen_a_slice_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = 0
    at_each_look: list[int] = []
    open_ = hcp2.Read.open

    def counted(self: hcp2.Read, *arguments: Any) -> Any:
        nonlocal opened
        opened += 1
        return open_(self, *arguments)

    def look() -> None:
        nonlocal opened
        at_each_look.append(opened)
        opened = 0

    monkeypatch.setattr(hcp2.Read, "open", counted)
    watched_slices(monkeypatch, look)

    async def story(bus: Bus) -> None:
        nonlocal opened
        points = points_of(bus, range(1, 51), range(1, 11))
        opened = 0
        group = bus.poll_group("large", period=100.0, points=points)
        look()
        group.add(*points_of(bus, [51], [1]))
        look()
        assert group.points[:-1] == tuple(points)
        await asyncio.sleep(0.05)
        assert group.poll.placed
        assert sum(at_each_look) >= 501
        assert max(at_each_look) <= SLICE / WEIGHING + 1

    on_a_bus(story)


def test_a_cycle_without_exchanges_is_told_a_piece_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """All its nodes are suspended: every point fails at once, which is work all the same."""
    sampled = 0
    at_each_look: list[int] = []
    make_sample = PollGroup.sampled

    def counted(self: PollGroup, transaction: Transaction) -> None:
        nonlocal sampled
        sampled += 1
        make_sample(self, transaction)

    def look() -> None:
        nonlocal sampled
        at_each_look.append(sampled)
        sampled = 0

    monkeypatch.setattr(PollGroup, "sampled", counted)
    watched_slices(monkeypatch, look)

    async def story(bus: Bus) -> None:
        group = bus.poll_group("large", period=1.0, points=points_of(bus, range(1, 51), range(1, 11)))
        for node in bus.nodes:
            node.suspend(100.0)
        [snapshot] = await cycles(group, 1)
        look()
        assert list(snapshot) == list(group.points)
        assert sum(at_each_look) == 500
        assert max(at_each_look) <= AT_ONCE

    on_a_bus(story)


def test_groups_closed_while_they_are_placed_leave_nothing() -> None:
    async def story(bus: Bus) -> None:
        points = points_of(bus, (1, 2), range(1, 10))
        stays = bus.poll_group("stays", period=0.5, points=points[:1])
        await cycles(stays, 1)
        groups = [bus.poll_group(str(n), period=PERIODS[n % 8], points=points) for n in range(100)]
        kept = [weakref.ref(group) for group in groups]
        for group in groups:
            group.close()
        del group, groups
        assert bus.groups == (stays,)
        asked = (await bus.statistics()).exchanges
        seen = await cycles(stays, 4)
        assert (await bus.statistics()).exchanges == asked + 4
        assert [snapshot.missed for snapshot in seen] == [0] * 4
        gc.collect()
        assert not any(ref() for ref in kept)

    on_a_bus(story)


def test_a_plan_in_steps_is_the_plan_and_others_run_meanwhile() -> None:
    async def story(bus: Bus) -> None:
        points = points_of(bus, (1, 2), range(1, 10))
        for number in range(50):
            bus.poll_group(str(number), period=100 * PERIODS[number % 8], points=points[number % 16 :])
        await asyncio.sleep(5.0)
        turns = 0

        async def count_turns() -> None:
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        counting = asyncio.create_task(count_turns())
        planned = await bus.plan()
        counting.cancel()
        assert planned == bus._plan_at_once(())
        assert turns > 50

    on_a_bus(story)


def test_a_merge_that_raises_is_logged_and_the_group_reads_one_by_one(caplog: pytest.LogCaptureFixture) -> None:
    def broken(commands: Sequence[Command[Any]]) -> list[Batch]:
        raise ZeroDivisionError

    async def story(bus: Bus) -> None:
        points = points_of(bus, [1], range(1, 4))
        group = bus.poll_group("odd", period=1.0, points=points, merge=[broken])
        assert [sample.error for sample in (await cycles(group, 1))[0].values()] == [None] * 3

    with caplog.at_level(logging.ERROR, "busmaster"):
        on_a_bus(story)
    assert "the exchanges of poll group 'odd' could not be chosen" in caplog.text


def test_a_point_of_the_address_that_is_for_all_is_refused() -> None:
    async def story(bus: Bus) -> None:
        with pytest.raises(InvalidCommand, match="no node replies"):
            bus.poll_group("all", period=1.0, points=[MentorDrive(bus, 0).point("1.17")])

    on_a_bus(story, EmulatedMint(1))


def test_samples_keep_the_order_of_the_points_whichever_came_first() -> None:
    async def story(bus: Bus) -> None:
        points = points_of(bus, (1, 9, 2), range(1, 4))
        group = bus.poll_group("g", period=1.0, points=points)
        snapshot = (await cycles(group, 2))[-1]
        assert list(snapshot) == points
        assert sum(sample.error is not None for sample in snapshot.values()) == 3

    on_a_bus(story)
