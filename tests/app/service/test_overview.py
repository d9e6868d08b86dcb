"""What a person sees of a line that another program owns, and may do there: by a real socket, on an emulated line."""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import Awaitable, Callable
from dataclasses import replace
from functools import partial
from math import nan
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster import Bus, Hcp2Controller, MemoryPort, MicroFlexDrive, Quality, RemoteBus, Sample, connect, ext
from busmaster.app.service import overview, remote_overview
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.client_messages import WriteParams
from busmaster.app.service.fields import NonFinite
from busmaster.app.service.link import PendingRequest
from busmaster.app.service.overview import COUNTED_AT_ONCE, INTERVAL, KEPT_EVENTS, PART, EventLog, Overview, Part
from busmaster.app.service.owner_messages import NoBody, StreamMessage
from busmaster.app.service.permission import Access, Permission
from busmaster.app.service.picture import Picture
from busmaster.app.service.remote_overview import RemoteOverview
from busmaster.app.service.rights import Role
from busmaster.arbiter.health import Health
from busmaster.bus.meaning import Meaning
from busmaster.bus.node import Node
from busmaster.bus.points import Point
from busmaster.bus.polling import PollGroup
from busmaster.contract.bounds import LONGEST_SUSPENSION
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryTransport
from busmaster.errors import BusError, InvalidCommand, LineDown, NodeDown, NoReply, WriteUnconfirmed
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.modbus.handle import ModbusUnit
from busmaster.registry import make_device
from busmaster.statistics import Quantiles, Timeline
from tests.app.service.lines import ABSENT, PATIENT, Served, on_a_served_line, raw, until
from tests.patience import PATIENCE
from tests.stories import in_virtual_time


def polled(bus: Bus, name: str = "axes", *items: str, address: int = 5, period: float = 0.02) -> PollGroup:
    controller = Hcp2Controller(bus, address)
    return bus.poll_group(name, period=period, points=[controller.point(item) for item in items or ("outputs", "10")])


Watched = Callable[[Served, Picture, RemoteOverview], Awaitable[None]]


def on_a_watched_line(folder: Path, story: Watched, *, read_only: bool = False) -> None:
    async def with_picture(line: Served, remote: RemoteBus) -> None:
        polled(line.bus)
        picture = Picture()
        view = await remote.overview(picture.receive)
        await until(lambda: picture.frame is not None and picture.rows and picture.rows[0].value is not None)
        await story(line, picture, view)

    on_a_served_line(folder, with_picture, read_only=read_only)


def test_it_has_every_point_its_group_its_node_and_the_line(tmp_path: Path) -> None:
    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        frame = picture.frame
        assert frame is not None
        assert (frame.title, frame.line, frame.read_only) == (line.service.name, line.bus.endpoint.name, False)
        await until(lambda: picture.frame and picture.frame.state == "ready")
        assert [(row.name, row.key, row.value, row.writable, row.error) for row in picture.rows] == [
            ("node 5 outputs", "5/outputs", 0, True, ""),
            ("node 5 10", "5/10", 0, True, ""),
        ]
        await until(lambda: picture.groups[0].cycles > 5)
        assert [(group.name, group.period, group.paused) for group in picture.groups] == [("axes", 0.02, False)]
        await until(lambda: [node.health for node in picture.nodes.values()] == ["up"])
        assert picture.nodes["hcp2", 5].requests > 5
        assert 0 < frame.utilisation <= 1
        await until(lambda: len(picture.rows[0].past) > 2)

    on_a_watched_line(tmp_path, story)


def test_a_name_a_number_of_digits_and_a_cause_are_the_owners(tmp_path: Path) -> None:
    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        controller = Hcp2Controller(line.bus, 5)
        await controller.write(10, 1.25, 1)
        pull = replace(controller.point("10"), meaning=Meaning(precision=3))
        mode = replace(controller.point("11"), meaning=Meaning(labels={1: "on"}))
        dead = Hcp2Controller(line.bus, 8).point("1")
        line.bus.poll_group("meant", period=0.02, points=[pull, mode, dead])
        await until(lambda: len(picture.rows) == 5 and picture.rows[4].error)
        shown = {row.key: row for row in picture.rows if row.group == "meant"}
        assert (shown["5/10"].value, shown["5/10"].precision) == (1.25, 3)
        assert shown["5/11"].value == "1 on"
        assert shown["8/1"].value is None
        assert shown["8/1"].error.startswith(("no reply", "not responding"))
        # A row has no room for what to do.
        assert (await view.details("meant", "8/1"))["hint"] in (NoReply.hint, NodeDown.hint)
        assert (await view.details("meant", "5/10"))["hint"] == ""

    on_a_watched_line(tmp_path, story)


def test_a_value_that_left_its_limits_says_so_until_it_is_back(tmp_path: Path) -> None:
    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        controller = Hcp2Controller(line.bus, 5)
        line.bus.groups[0].add(replace(controller.point("11"), meaning=Meaning(high=5)))
        await controller.write(11, 6)
        await until(lambda: picture.rows[-1].item == "11" and picture.rows[-1].alarm == "high")
        await controller.write(11, 1)
        await until(lambda: picture.rows[-1].value == 1 and not picture.rows[-1].alarm)

    on_a_watched_line(tmp_path, story)


def test_points_that_come_and_go_are_shown_and_those_that_stay_keep_their_past(tmp_path: Path) -> None:
    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        await until(lambda: len(picture.rows[0].past) > 2)
        before = list(picture.rows[0].past)
        group = polled(line.bus, "more", *map(str, range(1, 12)), address=6)
        await until(lambda: len(picture.rows) == 13)
        group.close()
        line.bus.groups[0].add(Hcp2Controller(line.bus, 5).point("11"))
        await until(lambda: [row.item for row in picture.rows] == ["outputs", "10", "11"])
        assert list(picture.rows[0].past)[: len(before)] == before
        assert picture.frame is not None
        await until(lambda: picture.frame and picture.frame.groups == 1)

    on_a_watched_line(tmp_path, story)


def test_more_points_than_one_message_holds_are_all_there_and_beyond_the_bound_they_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(overview, "MOST_POINTS", 2 * PART)

    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        controller = Hcp2Controller(line.bus, 5)
        points: list[Point[object]] = [replace(controller.point("10"), item=f"p{n}") for n in range(2 * PART + 50)]
        line.bus.poll_group("many", period=0.02, points=points)
        await until(lambda: len(picture.rows) == 2 * PART and picture.rows[-1].value == 0)
        assert picture.frame is not None
        await until(lambda: picture.frame and picture.frame.left_out == 52)

    on_a_watched_line(tmp_path, story)


@pytest.mark.slow
def test_a_pause_and_a_suspension_are_for_all_and_say_whose_wish_they_were(tmp_path: Path) -> None:
    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        other = Picture()
        async with connect(line.address) as second:
            await second.overview(other.receive)
            await view.pause("axes", True)
            await until(lambda: other.groups and other.groups[0].paused and picture.groups[0].paused)
            cycle = line.bus.groups[0].statistics().cycles
            await view.demand("axes")
            await until(lambda: line.bus.groups[0].statistics().cycles > cycle)
            await view.pause("axes", False)
            for too_long in (1e308, LONGEST_SUSPENSION + 1):
                with pytest.raises(InvalidCommand, match="node 5: a suspension lasts 86400 s at most"):
                    await view.suspend("hcp2", 5, too_long)
            await view.suspend("hcp2", 5, 60.0)
            await until(lambda: other.nodes and other.nodes["hcp2", 5].health == "suspended")
            await until(lambda: other.rows[0].error == "suspended for maintenance")
            await view.suspend("hcp2", 5, 0.0)
            await until(lambda: not other.rows[0].error)

            def said() -> list[str]:
                assert other.frame is not None
                return [text.partition(" by ")[0] for _, text in other.frame.events if " by " in text]

            # The events come with the next frame: maybe after the values.
            await until(lambda: len(said()) > 3)
            assert said() == ["axes is paused", "axes is resumed", "node 5 is suspended for 60 s", "node 5 is resumed"]

    on_a_watched_line(tmp_path, story)


def test_a_value_is_written_through_the_authorisation_under_the_owners_limits(tmp_path: Path) -> None:
    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        Hcp2Controller(line.bus, 5).point("outputs").limit(maximum=7)
        await view.write("axes", "5/outputs", 5)
        await until(lambda: picture.rows[0].value == 5)
        with pytest.raises(InvalidCommand, match="maximum of 7"):
            await view.write("axes", "5/outputs", 8)
        for key in ("5/nothing", "5/output"):  # the second is the beginning of a key
            with pytest.raises(InvalidCommand, match=f"has no point '{key}'"):
                await view.write("axes", key, 1)
        wrong: list[object] = ["five", None, [1, 2], {}]
        for value in wrong:
            with pytest.raises(InvalidCommand):
                await view.write("axes", "5/outputs", value)
        assert [outcome for _, outcome in line.audit()] == ["written", *["refused"] * 5]
        assert {point for point, _ in line.audit()} == {"5/outputs"}

    on_a_watched_line(tmp_path, story)


def test_a_read_only_line_says_so_and_writes_nothing(tmp_path: Path) -> None:
    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        assert picture.frame is not None
        assert picture.frame.read_only
        with pytest.raises(InvalidCommand, match="this line is read-only"):
            await view.write("axes", "5/outputs", 5)
        assert line.audit() == [("5/outputs", "refused")]

    on_a_watched_line(tmp_path, story, read_only=True)


def test_who_may_only_read_looks_and_neither_pauses_nor_suspends_nor_writes(tmp_path: Path) -> None:
    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        line.authorisation.access = Access(users={os.getuid(): Permission("user me", Role.READ)})
        for wish in (view.pause("axes", True), view.suspend("hcp2", 5, 60.0), view.write("axes", "5/outputs", 5)):
            with pytest.raises(InvalidCommand, match="user me may"):
                await wish
        await view.demand("axes")
        line.authorisation.access = Access(users={os.getuid(): Permission("user me", Role.WRITE, {("hcp2", 6): None})})
        with pytest.raises(InvalidCommand, match="user me may not pause or suspend this"):
            await view.pause("axes", True)
        await view.suspend("hcp2", 6, 60.0)
        assert [node.label for node in line.bus.nodes if node.suspended] == ["node 6"]
        assert not line.bus.groups[0].paused

    async def with_another_node(line: Served, picture: Picture, view: RemoteOverview) -> None:
        Hcp2Controller(line.bus, 6)
        await story(line, picture, view)

    on_a_watched_line(tmp_path, with_another_node)


def test_details_have_limits_alarms_and_the_last_exchange(tmp_path: Path) -> None:
    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        controller = Hcp2Controller(line.bus, 5)
        controller.point("10").limit(minimum=-1, maximum=50)
        point = replace(controller.point("10"), meaning=Meaning(high=40))
        line.bus.poll_group("slow", period=0.02, points=[point])
        await until(lambda: picture.rows[-1].group == "slow" and picture.rows[-1].value == 0)
        told = await view.details("slow", "5/10")
        [limit] = told["limits"]
        assert (limit["minimum"], limit["maximum"], limit["max_step"], limit["writable"]) == (-1, 50, None, True)
        assert (told["high"], told["low"], told["command"]) == (40, None, "read element 10")
        times = told["timeline"]
        assert times["queued"] <= times["started"] < times["first_byte"] <= times["last_byte"]
        assert times["started"] - PATIENCE < told["due"] <= times["started"]
        assert told["sample"][-1] == ""
        await controller.write(10, 45)
        await until(lambda: line.bus.alarms[point] is not None)
        told = await view.details("slow", "5/10")
        assert (told["sample"][0], told["sample"][-1]) == (45, "high")
        with pytest.raises(InvalidCommand, match="no poll group 'none'"):
            await view.details("none", "5/10")

    on_a_watched_line(tmp_path, story)


def test_a_wish_of_a_person_reaches_the_owner_as_it_was_meant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        [group] = line.bus.groups
        for paused in (True, False):
            await view.pause("axes", paused)
            assert group.paused is paused
        node = line.bus.nodes[0]
        for seconds, suspended in ((60.0, True), (0.0, False)):
            await view.suspend("hcp2", 5, seconds)
            assert node.suspended is suspended
        asked: list[WriteParams] = []
        ask = view._link.ask

        def noted(method: str, params: Any, **options: Any) -> PendingRequest:
            asked.append(params)
            return ask(method, params, **options)

        monkeypatch.setattr(view._link, "ask", noted)
        before = line.bus.now()
        await view.write("axes", "5/outputs", 5)
        with pytest.raises(InvalidCommand, match="must be a finite number"):
            await view.write("axes", "5/10", nan)
        for params in asked:
            assert params.options is not None
            assert params.options.start_within == remote_overview.SOON
            assert params.requested is not None
            assert before <= params.requested <= line.bus.now()
        await view.suspend("hcp2", 5, 3600.5)
        events = [text for _, text in line.service.line.journal.entries]
        assert any(text.startswith("node 5 is suspended for 3600") for text in events)

    on_a_watched_line(tmp_path, story)


def test_a_write_of_a_person_that_was_sent_when_the_connection_was_lost_is_unconfirmed(tmp_path: Path) -> None:
    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        absent = Hcp2Controller(line.bus, ABSENT, timings=PATIENT)
        line.bus.groups[0].pause()
        line.bus.poll_group("absent", period=60, points=[absent.point("1")]).pause()
        writing = asyncio.ensure_future(view.write("absent", f"{ABSENT}/1", 1))
        await line.sent()
        [connection] = line.service._clients.values()
        connection.websocket.abort()
        with pytest.raises(WriteUnconfirmed, match="the write may have been sent"):
            await writing

    on_a_watched_line(tmp_path, story)


@pytest.mark.asyncio
async def test_a_view_that_its_owner_ends_says_so() -> None:
    received: list[str] = []
    link: Any = SimpleNamespace(check=lambda: None)
    view = RemoteOverview(link, lambda: 0.0, lambda method, body: received.append(method))
    view.receive("frame", StreamMessage(1, 0, NoBody()))
    view.receive("ended", StreamMessage(1, 0, NoBody()))
    assert received == ["frame"]
    with pytest.raises(BusError, match="shows it no more; see its log"):
        await view.over()


@pytest.mark.slow
def test_what_happened_before_somebody_looks_is_told(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        line.service.line.journal.note("the winder was threaded")
        controller = Hcp2Controller(line.bus, 8, timings=PATIENT)
        while Node.of(controller).health is not Health.DOWN:
            with pytest.raises(BusError):
                await controller.read(1)
        picture = Picture()
        await remote.overview(picture.receive)
        await until(lambda: picture.frame is not None)
        assert picture.frame is not None
        first, *_, last = [text for _, text in picture.frame.events]
        assert first == "the winder was threaded"
        assert last.startswith("node 8 is down")

    on_a_served_line(tmp_path, story)


def test_the_end_of_the_owner_and_a_lost_connection_are_told_apart(tmp_path: Path) -> None:
    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        async with connect(line.address) as second:
            lost = await second.overview(Picture().receive)
            await until(lambda: len(line.service.clients) == 2)
            connection = list(line.service._clients.values())[1]
            connection.websocket.abort()
            with pytest.raises(LineDown, match="was lost"):
                await lost.over()
        await line.service.__aexit__(None, None, None)
        with pytest.raises(LineDown, match="has ended"):
            await view.over()
        await line.service.__aenter__()  # for its context to leave

    on_a_watched_line(tmp_path, story)


class Full:
    """A way on which nothing leaves."""

    full = True

    def send(self, message: bytes, /) -> None:
        raise AssertionError("it is full")


def test_one_that_does_not_read_sees_fewer_pictures_and_no_other_fewer(tmp_path: Path) -> None:
    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        async with raw(line) as stuck:
            await stuck.ask("overview", stream=3)
            client = line.service.clients[1]
            client.outbox._sink = Full()
            await until(lambda: client.outbox.waiting > 1)
            seen = picture.frame.now if picture.frame else 0.0
            await until(lambda: picture.frame and picture.frame.now > seen + 4 * INTERVAL)
            assert 1 < client.outbox.waiting < 10

    on_a_watched_line(tmp_path, story)


@pytest.mark.slow
def test_the_line_goes_between_one_part_and_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    turn, worked = 0, list[int]()

    async def turns() -> None:
        nonlocal turn
        while True:
            turn += 1
            await asyncio.sleep(0)

    for name in ("send_values", "_encode_groups", "_encode_nodes"):
        owner = Part if name == "send_values" else overview
        plain = getattr(owner, name)

        def noted(*arguments: Any, plain: Any = plain) -> Any:
            told = plain(*arguments)
            if told:
                worked.append(turn)
            return told

        monkeypatch.setattr(owner, name, noted)

    async def story(line: Served, picture: Picture, view: RemoteOverview) -> None:
        controller = Hcp2Controller(line.bus, 5)
        points: list[Point[object]] = [replace(controller.point("10"), item=f"p{n}") for n in range(5 * PART)]
        line.bus.poll_group("many", period=0.02, points=points)
        for address in range(20, 20 + 2 * COUNTED_AT_ONCE):
            Hcp2Controller(line.bus, address)
        turning = asyncio.ensure_future(turns())
        worked.clear()
        await until(lambda: len(worked) > 50)
        turning.cancel()
        assert len(worked) == len(set(worked))

    on_a_watched_line(tmp_path, story)


def test_nothing_is_worked_out_while_nobody_looks(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        polled(line.bus)
        async with connect(line.address) as second:
            await second.overview(lambda method, body: None)
            assert line.service.line._overview is not None
        await until(lambda: line.service.line._overview is None)
        picture = Picture()
        await remote.overview(picture.receive)
        await until(lambda: picture.rows and picture.rows[0].value == 0)

    on_a_served_line(tmp_path, story)


@in_virtual_time
async def test_the_time_for_which_a_group_was_paused_is_no_period() -> None:
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)]))) as bus:
        group = polled(bus, "axes", "1", address=1, period=0.1)
        for seconds in (1.0, 10.0, 1.0, 10.0):
            await asyncio.sleep(seconds)
            group.resume() if group.paused else group.pause()
        assert group.statistics().achieved == pytest.approx(0.1, abs=0.01)
        assert max(group.recent_periods) < 0.2
        assert group.statistics().jitter.highest < 0.1
        assert group.statistics().missed == 0


# the messages of a picture


class Screen:
    """A client of an overview that keeps the latest message of each part."""

    def __init__(self) -> None:
        self.latest: dict[tuple[str, int], Any] = {}
        self.count = 0

    def notify(self, stream: int, method: str, body: Any) -> None:
        raise AssertionError("a picture is not dropped")

    def notify_surely(self, stream: int, method: str, body: Any, part: int = 0) -> None:
        self.latest[method, part] = json.loads(bytes(body))
        self.count += 1

    def parts(self, method: str) -> list[Any]:
        """Return the messages of a method in the order of their parts."""
        return [body for (name, _), body in sorted(self.latest.items()) if name == method]


def overview_of(bus: Bus) -> Overview:
    return Overview(bus, Authorisation(bus), EventLog(bus), lambda: "the winder", lambda: None)


@in_virtual_time
async def test_each_part_names_its_place_and_a_screen_that_joins_later_gets_all_parts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(overview, "PART", 2)
    monkeypatch.setattr(overview, "MOST_POINTS", 8)
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)]))) as bus:
        points: list[Point[Any]] = [Hcp2Controller(bus, 1).point(str(element)) for element in range(1, 6)]
        for name in ("a", "b", "c", "d", "e", "f"):
            bus.poll_group(name, period=0.1, points=points if name in "ab" else points[:1])
        for address in range(2, 12):
            bus.node(hcp2.PROFILE, address)
        pictures, first, second = overview_of(bus), Screen(), Screen()
        pictures.join(first, 1)
        await asyncio.sleep(2.0)
        for group in bus.groups:
            group.pause()
        await asyncio.sleep(1.0)
        pictures.join(second, 1)
        await asyncio.sleep(2.0)
        for screen in (first, second):
            rows, values = screen.parts("rows"), screen.parts("values")
            assert [(body["first"], len(body["rows"])) for body in rows] == [(0, 2), (2, 2), (4, 1), (5, 2), (7, 1)]
            assert [(body["first"], len(body["values"])) for body in values] == [(0, 2), (2, 2), (4, 1), (5, 2), (7, 1)]
            assert {value[0] for body in values for value in body["values"]} == {0.0}
            groups, nodes = screen.parts("groups"), screen.parts("nodes")
            assert [(body["first"], len(body["groups"])) for body in groups] == [(0, 5), (5, 1)]
            assert [(body["first"], len(body["nodes"])) for body in nodes] == [(0, 5), (5, 5), (10, 1)]
            assert [one["address"] for body in nodes for one in body["nodes"]] == [*range(1, 12)]
            [frame] = screen.parts("frame")
            assert (frame["points"], frame["left_out"], frame["groups"], frame["nodes"]) == (8, 6, 6, 11)
            assert {body["set"] for body in (*rows, *values, frame)} == {1}
        assert second.latest == {**first.latest, ("frame", 0): second.latest["frame", 0]}
        sent = first.count
        bus.group("a").close()
        await asyncio.sleep(0.5)
        assert {body["set"] for body in (*first.parts("rows")[:3], *first.parts("frame"))} == {2}
        assert first.count > sent
        for screen in (first, second):
            pictures.leave(screen, 1)
        await pictures._journal.close()


@in_virtual_time
async def test_a_picture_of_other_points_has_the_counts_of_their_groups() -> None:
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)]))) as bus:
        for name in ("a", "b", "c", "d"):
            polled(bus, name, "1", address=1, period=0.1)
        pictures, screen = overview_of(bus), Screen()
        pictures.join(screen, 1)
        await asyncio.sleep(1.0)
        for number, closed in enumerate(("a", "b", "c"), 2):
            bus.group(closed).close()
            while screen.latest["frame", 0]["set"] != number:  # noqa: ASYNC110  time is virtual
                await asyncio.sleep(0.01)
            [groups] = screen.parts("groups")
            assert [group["name"] for group in groups["groups"]] == [group.name for group in bus.groups]
        pictures.leave(screen, 1)
        await pictures._journal.close()


@in_virtual_time
async def test_unchanged_values_and_rows_are_sent_once(monkeypatch: pytest.MonkeyPatch) -> None:
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)]))) as bus:
        group = polled(bus, "axes", "1", address=1, period=0.1)
        await anext(aiter(group))
        group.pause()
        await asyncio.sleep(1.0)
        pictures, screen = overview_of(bus), Screen()
        pictures.join(screen, 1)
        await asyncio.sleep(1.0)
        seen: list[str] = []
        monkeypatch.setattr(screen, "notify_surely", lambda stream, method, body, part=0: seen.append(method))
        await asyncio.sleep(5.0)
        assert set(seen) == {"frame", "groups", "nodes"}
        assert seen.count("frame") == pytest.approx(5.0 / INTERVAL, abs=1)
        assert seen.count("groups") == pytest.approx(5.0 / 0.6, abs=2)  # the first picture after COUNTED_EVERY
        pictures.leave(screen, 1)
        await pictures._journal.close()


@in_virtual_time
async def test_a_screen_that_joins_while_others_look_has_the_counts_in_its_first_picture(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)]))) as bus:
        group = polled(bus, "axes", "1", address=1, period=0.1)
        await anext(aiter(group))
        group.pause()
        pictures, screens = overview_of(bus), [Screen(), Screen(), Screen()]
        seen: list[list[str]] = [[], [], []]
        for screen, methods in zip(screens, seen, strict=True):
            noted = partial(lambda methods, stream, method, body, part=0: methods.append(method), methods)
            monkeypatch.setattr(screen, "notify_surely", noted)
        pictures.join(screens[0], 1)
        await until(lambda: "frame" in seen[0])
        seen[0].clear()
        pictures.join(screens[1], 1)
        pictures.join(screens[2], 1)
        await until(lambda: "frame" in seen[2])
        assert seen == [["frame"], *[["rows", "values", "groups", "nodes", "frame"]] * 2], "nothing else is new"
        await asyncio.sleep(5.0)
        assert len({(methods.count("groups"), methods.count("nodes")) for methods in seen}) == 2
        assert seen[1].count("groups") == seen[0].count("groups") + 1
        for screen in screens:
            pictures.leave(screen, 1)
        await pictures._journal.close()


@in_virtual_time
async def test_a_screen_that_joins_between_two_counts_gets_the_counts_that_the_others_have() -> None:
    def counts(screen: Screen) -> dict[tuple[str, int], Any]:
        return {key: body for key, body in screen.latest.items() if key[0] in ("groups", "nodes")}

    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)]))) as bus:
        for number in range(COUNTED_AT_ONCE + 1):
            polled(bus, f"group {number}", "1", address=1, period=0.1)
        pictures, first, others = overview_of(bus), Screen(), [Screen(), Screen(), Screen()]
        pictures.join(first, 1)
        await asyncio.sleep(1.0)
        for other in others:
            before = counts(first)
            while counts(first) == before:  # noqa: ASYNC110  time is virtual
                await asyncio.sleep(0.01)
            bus.node(hcp2.PROFILE, 2 + others.index(other))  # it is in the next counts
            sent = counts(first)
            pictures.join(other, 1)
            await asyncio.sleep(1.5 * INTERVAL)
            assert counts(other) == counts(first) == sent
            assert sorted(sent) == [("groups", 0), ("groups", COUNTED_AT_ONCE), ("nodes", 0)]
        await asyncio.sleep(1.0)
        assert [len(screen.latest["nodes", 0]["nodes"]) for screen in (first, *others)] == [4] * 4
        for screen in (first, *others):
            pictures.leave(screen, 1)
        await pictures._journal.close()


@in_virtual_time
async def test_the_counts_of_a_group_and_a_node_are_those_of_their_statistics() -> None:
    devices = [make_device("hcp2", 1), make_device("microflex", 3)]
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, devices))) as bus:
        group = polled(bus, "axes", "1", "2", address=1, period=0.1)
        absent = Hcp2Controller(bus, 2)
        await asyncio.gather(absent.read(1), return_exceptions=True)
        drive = MicroFlexDrive(bus, 3)
        await asyncio.sleep(2.05)
        group.pause()
        await asyncio.sleep(1.0)
        counts, known = group.statistics(), overview._encode_groups(bus, 0).groups[0]
        assert (known.name, known.period, known.paused, known.cycles) == ("axes", 0.1, True, counts.cycles)
        assert (known.missed, known.achieved, known.jitter) == (counts.missed, counts.achieved, counts.jitter.p99)
        for node, one in zip(bus.nodes, overview._encode_nodes(bus, 0).nodes, strict=True):
            of_node = node.statistics()
            assert (one.label, one.protocol, one.address, one.health) == (
                node.label,
                "hcp2",
                node.address,
                node.health.value,
            )
            assert (one.requests, one.failed, one.late) == (of_node.attempts, of_node.fruitless, of_node.late)
            assert (one.p50, one.p99) == (of_node.latency.p50, of_node.latency.p99)
        assert [one.kind for one in overview._encode_nodes(bus, 0).nodes] == ["hcp2", "hcp2", "microflex"]
        row = overview._encode_point(group, drive.point("command_word"))
        assert (row.protocol, row.kind, row.address) == ("hcp2", "microflex", 3)
        Node.of(absent).suspend(60.0)
        assert overview.health_text(Node.of(absent)) == "suspended"


@in_virtual_time
async def test_the_frame_has_the_cause_and_the_time_of_a_lost_line() -> None:
    port = MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)]))
    async with Bus(port) as bus:
        await Hcp2Controller(bus, 1).read(1)
        pictures = overview_of(bus)
        pictures._journal.note("first")
        pictures._journal.note("second")
        frame = pictures._frame()
        settings = bus.endpoint.settings
        assert settings is not None
        assert (frame.title, frame.settings) == ("the winder", f"{settings.baudrate} {settings.framing}")
        assert (frame.state, frame.since, frame.why, frame.read_only) == ("ready", None, "", False)
        assert [text for _, text in frame.events] == ["first", "second"]
        assert (frame.elapsed, frame.losses) == (ext.line_statistics(bus).elapsed, 0)
        pictures._authorisation.read_only = True
        assert pictures._frame().read_only
        node = bus.nodes[0]
        node.suspend(60.0)
        assert overview.health_text(node) == "suspended"
        polled(bus, "axes", "1", address=1, period=60.0)
        pictures._regroup()
        [part] = pictures._parts
        await asyncio.sleep(61.0)
        assert part.send_values(1, bus)
        node.suspend(60.0)
        transport = bus._pump._transport
        assert isinstance(transport, MemoryTransport)
        transport.lose(OSError("unplugged"))
        await until(lambda: bus.condition.is_lost)
        lost = pictures._frame()
        assert (lost.state, lost.why, lost.since) == ("offline", bus.condition.reason, bus.condition.since)
        assert "unplugged" in lost.why
        assert lost.losses == 1
        assert overview.health_text(node) == "offline"  # suspended or not
        assert part.send_values(1, bus)  # no value is good any more
        await pictures._journal.close()


def test_points_are_the_same_as_before_only_if_they_are_the_same_objects() -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line)))
    point = Hcp2Controller(bus, 1).point("1")
    one, other = object(), object()
    group: Any = one
    assert overview._same((group, (point,)), (group, (point,)))
    renamed = replace(point, meaning=Meaning(precision=1))
    assert renamed == point
    second: Any = other
    for groups in ((group, (renamed,)), (group, (point, point)), (group, ()), (second, (point,))):
        assert not overview._same((group, (point,)), groups)
    named: Any = SimpleNamespace(name="axes")
    points = (point, replace(point, encode=None))
    assert [overview._encode_point(named, one).writable for one in points] == [True, False]
    row = overview._encode_point(named, replace(point, item="pull", unit="N"))
    assert (row.group, row.key, row.node, row.item, row.unit) == ("axes", "1/pull", "node 1", "pull", "N")


@pytest.mark.parametrize(
    ("value", "meaning", "shown"),
    [
        (1.25, Meaning(precision=1), 1.25),
        (7, Meaning(), 7),
        (None, Meaning(), None),
        (True, Meaning(), "1"),
        ("text", Meaning(), "text"),
        ((1.25, 2.0), Meaning(precision=1), "1.2,2.0"),
    ],
)
def test_a_number_is_shown_as_it_is_and_anything_else_as_text(value: Any, meaning: Meaning, shown: Any) -> None:
    point = replace(Hcp2Controller(Bus(MemoryPort(Line(hcp2.PROFILE.line))), 1).point("1"), meaning=meaning)
    found = overview.shown(point, value)
    assert (type(found), found) == (type(shown), shown)


@in_virtual_time
async def test_details_have_only_the_limits_of_the_places_of_their_point() -> None:
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)]))) as bus:
        controller = Hcp2Controller(bus, 1)
        controller.point("10").limit(minimum=-1, maximum=50, max_step=5)
        controller.point("12").limit(writable=False)
        point = replace(controller.point("10"), meaning=Meaning(low=-3.5, high=40))
        other = replace(controller.point("11"), meaning=Meaning(labels={0: "off", 1: "run"}))
        group = bus.poll_group("axes", period=60.0, points=[point, other])
        before = overview.encode_details(bus, group, point)
        assert (before.sample, before.hint, before.timeline, before.due) == (None, "", None, None)
        snapshot = await anext(aiter(group))
        details = overview.encode_details(bus, group, point)
        assert [(limit.minimum, limit.maximum, limit.max_step, limit.writable) for limit in details.limits] == [
            (-1, 50, 5, True)
        ]
        assert (details.low, details.high, details.labels) == (-3.5, 40, {})
        from_zero = overview.encode_details(bus, group, replace(point, meaning=Meaning(low=0)))
        assert (from_zero.low, from_zero.high) == (0, None)
        sample = snapshot[point]
        assert details.sample is not None
        assert details.timeline is not None
        assert (details.sample.value, details.sample.requested, details.due) == (0, sample.started, sample.due)
        assert (details.timeline.queued, details.timeline.attempts) == (sample.timeline.queued, 1)
        labelled = overview.encode_details(bus, group, other)
        assert (labelled.limits, labelled.labels) == ([], {"0": "off", "1": "run"})
        assert overview.encode_details(bus, group, replace(controller.point("12"))).limits[0].writable is False
        await controller.write(10, 1)
        stale = overview.encode_details(bus, group, point).sample
        assert stale is not None
        assert stale.quality != details.sample.quality  # as it is at present


def test_a_sample_that_was_never_sent_has_the_time_of_its_end() -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line)))
    point = Hcp2Controller(bus, 1).point("1")
    error = NoReply("no reply within 5 ms", hint="look at the cable")
    sample: Sample[Any] = Sample(
        None, error, 1.0, None, 2.0, Quality.BAD, Timeline(1.0, None, None, None, 0, 0, 0.0), 0.0
    )
    shown = overview._encode_value(bus, point, sample)
    assert shown is not None
    assert (shown.value, shown.requested, shown.error, shown.alarm) == (None, 2.0, "no reply within 5 ms", "")
    assert overview._encode_value(bus, point, None) is None
    endless = overview._encode_value(bus, point, sample._replace(value=float("inf"), error=None, started=1.5))
    assert endless is not None
    assert (endless.value, endless.requested, endless.error) == (NonFinite("inf"), 1.5, "")


@in_virtual_time
async def test_values_are_sent_again_when_they_change_or_a_write_makes_them_stale_and_not_each_cycle() -> None:
    device = EmulatedMint(1)
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, [device]))) as bus:
        controller = Hcp2Controller(bus, 1)
        fast = polled(bus, "fast", "1", address=1, period=0.1)
        slow = polled(bus, "slow", "2", address=1, period=1000.0)
        for group in (fast, slow):
            await anext(aiter(group))
        pictures, screen = overview_of(bus), Screen()
        pictures.join(screen, 1)
        await asyncio.sleep(1.0)
        before = screen.parts("values")
        assert [(body["first"], body["values"][0][0]) for body in before] == [(0, 0.0), (1, 0.0)]
        screen.latest.clear()
        cycles = fast.statistics().cycles
        await asyncio.sleep(2.0)
        assert fast.statistics().cycles > cycles + 10
        quality = before[1]["values"][0][1]
        await controller.write(2, 5.0)
        await asyncio.sleep(1.0)
        [body] = [body for body in screen.parts("values") if body["first"] == 1]
        assert body["values"][0][1] != quality
        pictures.leave(screen, 1)
        await pictures._journal.close()


@in_virtual_time
async def test_a_value_that_is_read_after_a_write_is_shown_before_the_next_cycle() -> None:
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)]))) as bus:
        point = replace(Hcp2Controller(bus, 1).point("2"), read_after_write=True)
        await anext(aiter(bus.poll_group("slow", period=1000.0, points=[point])))
        pictures = overview_of(bus)
        pictures._regroup()
        [part] = pictures._parts
        part.send_values(1, bus)
        await point.write(5.0)
        assert part.send_values(1, bus)  # it is stale
        await asyncio.sleep(1.0)
        assert part.send_values(1, bus)
        assert json.loads(part.values)["values"][0][:2] == [5.0, "good"]
        await pictures._journal.close()


@in_virtual_time
async def test_the_log_keeps_events_with_a_text_and_ends_when_it_is_closed() -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)])))
    journal = EventLog(bus)
    async with bus:
        journal.begin()
        await Hcp2Controller(bus, 1).read(1)  # the node is up, which needs no sentence
        await asyncio.sleep(0.1)
        assert [text for _, text in journal.entries if not text] == []
        for number in range(2 * KEPT_EVENTS):
            journal.note(f"event {number}")
        assert len(journal.entries) == KEPT_EVENTS
        assert {when for when, _ in journal.entries} == {bus.now()}
        task = journal._task
        assert task is not None
        await journal.close()
        assert task.done()


def test_the_groups_and_nodes_of_a_picture_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(overview, "MOST_COUNTED", 1)
    monkeypatch.setattr(overview, "COUNTED_AT_ONCE", 1)

    @in_virtual_time
    async def run() -> None:
        async with Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)]))) as bus:
            for name in ("axes", "slow"):
                polled(bus, name, "1", "2", address=1, period=60.0)
            Hcp2Controller(bus, 2)
            pictures = overview_of(bus)
            assert pictures._regroup()
            assert not pictures._regroup()
            frame = pictures._frame()
            assert (frame.groups, frame.nodes, frame.points, frame.left_out, frame.set) == (1, 1, 2, 0, 1)
            assert list(pictures._count_keys()) == [("groups", 0), ("nodes", 0)]
            counts = replace(ext.line_statistics(bus), elapsed=7.5, backlog=3, losses=2)
            monkeypatch.setattr(ext, "line_statistics", lambda _: counts)
            frame = pictures._frame()
            assert (frame.elapsed, frame.backlog, frame.losses) == (7.5, 3, 2)
            await pictures._journal.close()

    run()


def test_the_latencies_of_a_node_are_its_median_and_its_slowest(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line)))
    node = bus.node(hcp2.PROFILE, 1)
    counts = replace(node.statistics(), attempts=9, no_reply=3, late=2, latency=Quantiles(6, 0.3, 0.25, 0.75, 1.0))
    monkeypatch.setattr(Node, "statistics", lambda _: counts)
    shown = overview._encode_node(node)
    assert (shown.requests, shown.failed, shown.late, shown.p50, shown.p99) == (9, 3, 2, 0.25, 0.75)


def test_details_have_the_hint_of_an_error_and_the_limits_of_a_block() -> None:
    bus = Bus(MemoryPort(Line(ModbusUnit.profile.line)))
    unit = ModbusUnit(bus, 5)
    unit.point("holding:10:3").limit(maximum=7)
    point = unit.point("holding:11")
    timeline = Timeline(1.0, 1.25, None, None, 1, 0, 0.0)
    for error, hint in ((NoReply("no reply"), NoReply.hint), (BusError("odd"), "")):
        sample: Sample[Any] = Sample(None, error, 1.0, 1.25, 2.0, Quality.BAD, timeline, 0.0)
        group: Any = SimpleNamespace(latest=SimpleNamespace(samples={point: sample}))
        details = overview.encode_details(bus, group, point)
        assert (details.hint, details.due) == (hint, 1.0)
        assert [(limit.name, limit.maximum) for limit in details.limits] == [("holding:10:3", 7)]
    assert overview.encode_details(bus, group, unit.point("holding:13")).limits == []
    precise = replace(point, meaning=Meaning(precision=2))
    named: Any = SimpleNamespace(name="axes")
    assert overview._encode_point(named, precise).precision == 2
