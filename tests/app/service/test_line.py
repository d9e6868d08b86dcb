"""What all programs share of a served line: its streams, its points, and how often a group is polled on demand."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster import Bus, Hcp2Controller, InvalidCommand, PollGroup, ext
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.line import MOST_NAMED, ServedLine
from busmaster.app.service.rights import RIGHTS, Role
from busmaster.bus.node import Node
from tests.stories import on_a_bus


def on_a_line(story: Callable[[ServedLine, Bus], Awaitable[None]]) -> None:
    async def run(bus: Bus) -> None:
        line = ServedLine(bus, Authorisation(bus), 1.0, "the winder")
        await story(line, bus)
        await line.journal.close()

    on_a_bus(run)


class Demanded:
    """Counts the cycles that are demanded of a group, at times of its own."""

    def __init__(self, bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        self.cycles = 0
        monkeypatch.setattr(bus, "now", lambda: self.now)
        monkeypatch.setattr(PollGroup, "demand", lambda _: self._demand())

    def _demand(self) -> None:
        self.cycles += 1

    def count(self, line: ServedLine, group: PollGroup, role: Role, at: float) -> int:
        self.now, before = at, self.cycles
        line.demand(group, role)
        return self.cycles - before


def test_a_role_demands_a_group_once_in_so_many_periods_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(line: ServedLine, bus: Bus) -> None:
        points = [Hcp2Controller(bus, 1).point("1")]
        groups = [bus.poll_group(name, period=10.0, points=points) for name in ("axes", "slow")]
        demanded = Demanded(bus, monkeypatch)
        every = {role: RIGHTS[role].demand_every * 10.0 for role in Role}
        for role in (Role.READ, Role.WRITE):
            assert demanded.count(line, groups[0], role, 1000.0) == 1
            assert demanded.count(line, groups[0], role, 1000.0 + every[role] - 0.1) == 0
            assert demanded.count(line, groups[1], role, 1000.0 + every[role] - 0.1) == 1
            assert demanded.count(line, groups[0], role, 1000.0 + every[role]) == 1
            assert demanded.count(line, groups[0], role, 1000.0 + 2 * every[role] - 0.1) == 0
        assert [demanded.count(line, groups[0], Role.ADMIN, 1000.0) for _ in range(3)] == [1, 1, 1]

    on_a_line(story)


def test_a_group_that_ended_leaves_no_demand_and_no_stream_to_a_later_one(monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(line: ServedLine, bus: Bus) -> None:
        points = [Hcp2Controller(bus, 1).point("1")]
        group = bus.poll_group("axes", period=10.0, points=points)
        demanded = Demanded(bus, monkeypatch)
        source = line.broadcast_of(group)
        assert line.broadcast_of(group) is source
        for role in Role:
            line.demand(group, role)
        line._forget_group(group)
        assert line.broadcast_of(group) is not source
        group.close()
        later = bus.poll_group("axes", period=10.0, points=points)
        assert [demanded.count(line, later, role, 0.1) for role in Role] == [1, 1, 1]

    on_a_line(story)


def test_a_program_that_leaves_the_stream_of_a_group_may_not_demand_it_sooner(monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(line: ServedLine, bus: Bus) -> None:
        group = bus.poll_group("axes", period=10.0, points=[Hcp2Controller(bus, 1).point("1")])
        demanded = Demanded(bus, monkeypatch)
        reader: Any = SimpleNamespace(notify_surely=lambda *_: None)
        cycles = 0
        for _ in range(3):
            source = line.broadcast_of(group)
            source.join(reader, 1)
            cycles += demanded.count(line, group, Role.READ, 1000.0)
            source.leave(reader, 1)
        assert cycles == 1

    on_a_line(story)


def test_each_stream_of_the_line_is_shared_until_its_end() -> None:
    async def story(line: ServedLine, bus: Bus) -> None:
        for source, end in (
            (line.events, line._end_events),
            (line.overview, line._end_overview),
            (line.exchanges, line._end_exchanges),
        ):
            first = source()
            assert source() is first
            end()
            assert source() is not first

    on_a_line(story)


def test_a_node_is_known_by_its_protocol_and_its_address() -> None:
    async def story(line: ServedLine, bus: Bus) -> None:
        Hcp2Controller(bus, 1)
        second = Hcp2Controller(bus, 2)
        assert line.node("hcp2", 2) is second.node
        for protocol, address in (("hcp2", 3), ("mentor", 2)):
            with pytest.raises(InvalidCommand, match=f"node {address} of {protocol} is not on this line"):
                line.node(protocol, address)

    on_a_line(story)


def test_a_write_has_the_name_of_the_point_that_reads_its_places_at_present() -> None:
    async def story(line: ServedLine, bus: Bus) -> None:
        one, two = Hcp2Controller(bus, 1), Hcp2Controller(bus, 2)
        winder = replace(one.point("10"), item="speed")
        group = bus.poll_group("axes", period=10.0, points=[winder])
        assert line.named(Node.of(one), {10}) is winder
        assert line.named(Node.of(two), {10}) is None
        assert line.named(Node.of(one), {10, 11}) is None
        press = replace(two.point("10"), item="press")
        group.add(press)
        assert line.named(Node.of(two), {10}) is press
        group.remove(winder)
        assert line.named(Node.of(one), {10}) is None

    on_a_line(story)


def test_stale_points_of_all_groups_are_named_up_to_a_number() -> None:
    async def story(line: ServedLine, bus: Bus) -> None:
        controller = Hcp2Controller(bus, 1)
        node = Node.of(controller)
        points = [replace(controller.point("1"), item=f"p{number}") for number in range(MOST_NAMED)]
        bus.poll_group("axes", period=10.0, points=points[:30])
        group = bus.poll_group("slow", period=10.0, points=points[30:])
        await controller.write(1, 5)
        when = ext.line_of(bus).last_touched
        assert line.stale_items(ext.record_of(node), when) == [point.item for point in points]
        group.add(replace(controller.point("1"), item="another"))
        assert line.stale_items(ext.record_of(node), when) is None  # all of the node

    on_a_line(story)


def test_the_title_above_the_views_can_change() -> None:
    async def story(line: ServedLine, bus: Bus) -> None:
        overview = line.overview()
        line.title = "the press"
        assert overview._frame().title == "the press"  # type: ignore[attr-defined]  # of this broadcast

    on_a_line(story)
