"""What a person sees of a line that another program owns, and may do there: by a real socket, on an emulated line."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable
from dataclasses import replace
from math import nan
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster import Bus, Hcp2Controller, MemoryPort, RemoteBus, connect
from busmaster.app.service import overview, remote_overview
from busmaster.app.service.client_messages import WriteParams
from busmaster.app.service.link import PendingRequest
from busmaster.app.service.overview import COUNTED_AT_ONCE, INTERVAL, PART, Part
from busmaster.app.service.owner_messages import NoBody, StreamMessage
from busmaster.app.service.permission import Access, Permission
from busmaster.app.service.picture import Picture
from busmaster.app.service.remote_overview import RemoteOverview
from busmaster.app.service.rights import Role
from busmaster.arbiter.health import Health
from busmaster.bounds import LONGEST_SUSPENSION
from busmaster.bus.meaning import Meaning
from busmaster.bus.node import Node
from busmaster.bus.points import Point
from busmaster.bus.polling import PollGroup
from busmaster.emulator.line import Line
from busmaster.errors import BusError, InvalidCommand, LineDown, NodeDown, NoReply, WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import make_device
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
            assert other.frame is not None
            said = [text.partition(" by ")[0] for _, text in other.frame.events if " by " in text]
        assert said == ["axes is paused", "axes is resumed", "node 5 is suspended for 60 s", "node 5 is resumed"]

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
