"""A poll group on a line that another program owns: what a program gets of each cycle."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import pytest

from busmaster import Hcp2Controller, Point, Quality, RemoteBus
from busmaster.app.service.fields import PointForm
from busmaster.app.service.owner_messages import NoBody, PointsBody, SnapshotBody, StreamMessage
from busmaster.app.service.remote_exchanges import RemoteExchanges
from busmaster.app.service.remote_group import RemoteGroup
from busmaster.errors import BusClosed, GarbledReply, InvalidCommand
from tests.app.service.lines import Served, on_a_served_line


def test_a_value_that_the_programs_own_point_cannot_decode_is_bad_and_the_others_of_the_cycle_are_good(
    tmp_path: Path,
) -> None:
    def reject(value: Any) -> NoReturn:
        raise GarbledReply("no such state")

    async def story(line: Served, remote: RemoteBus) -> None:
        good = Hcp2Controller(remote, 5).point("1")
        bad: Point[Any] = replace(Hcp2Controller(remote, 5).point("2"), decode=reject)
        async for snapshot in remote.poll_group("own", period=0.02, points=[good, bad]):
            assert snapshot[good].quality is Quality.GOOD
            assert (snapshot.samples[bad].value, snapshot.samples[bad].quality) == (None, Quality.BAD)
            assert isinstance(snapshot.samples[bad].error, GarbledReply)
            break

    on_a_served_line(tmp_path, story)


def no_point(*_: object) -> NoReturn:
    raise AssertionError("no points were sent")


@pytest.mark.asyncio
async def test_a_consumer_counts_the_cycles_that_its_program_was_too_slow_for() -> None:
    opening = asyncio.ensure_future(asyncio.sleep(0))
    group = RemoteGroup("axes", (), period=0.02, find=no_point, begin=lambda _: (1, opening), end=lambda _: None)
    first = group.subscribe()
    group.receive("points", StreamMessage(1, 3, None))
    second = group.subscribe()
    group.receive("points", StreamMessage(1, 5, None))
    assert (first.dropped, second.dropped, group.dropped) == (5, 2, 5)
    group.receive("ended", StreamMessage(1, 5, NoBody()))
    assert group.over
    await asyncio.gather(opening, return_exceptions=True)


@pytest.mark.asyncio
async def test_only_cycles_of_the_points_that_were_sent_last_are_taken() -> None:
    opening = asyncio.ensure_future(asyncio.sleep(0))
    group = RemoteGroup("axes", (), period=0.02, find=no_point, begin=lambda _: (1, opening), end=lambda _: None)
    consumer = group.subscribe(buffer=2)
    for number, cycles in ((1, (1, 2)), (2, (1, 2, 1, 2))):
        group.receive("points", StreamMessage(1, 0, PointsBody(number, [])))
        for of_set in cycles:
            group.receive("snapshot", StreamMessage(1, 0, SnapshotBody(of_set, of_set, 0.0, 0.0, 0.0, 0, 0.0, [])))
    assert group.latest is not None
    assert group.latest.cycle == 2
    assert [(await anext(consumer)).cycle for _ in range(2)] == [2, 2]
    assert consumer.dropped == 1, "it keeps two"
    await asyncio.gather(opening)


@pytest.mark.asyncio
async def test_a_group_with_a_point_of_a_protocol_that_is_not_installed_ends_with_the_reason() -> None:
    opening = asyncio.ensure_future(asyncio.sleep(0))
    ended: list[int] = []
    group = RemoteGroup("axes", (), period=0.02, find=no_point, begin=lambda _: (1, opening), end=ended.append)
    consumer = group.subscribe()
    points = [PointForm("of-a-plugin", 1, {"command": "read"})]
    group.receive("points", StreamMessage(1, 0, PointsBody(1, points)))
    with pytest.raises(InvalidCommand, match="no such protocol 'of-a-plugin'"):
        await anext(consumer)
    with pytest.raises(InvalidCommand, match="no such protocol 'of-a-plugin'"):
        await group.ready()
    assert (group.over, ended) == (True, [1])


@pytest.mark.asyncio
@pytest.mark.parametrize("followed", [False, True])
async def test_a_group_that_was_closed_is_not_requested_again(followed: bool) -> None:
    begun: list[RemoteGroup] = []
    ended: list[int] = []

    def begin(group: RemoteGroup) -> tuple[int, asyncio.Task[None]]:
        begun.append(group)
        return 7, asyncio.ensure_future(asyncio.sleep(0))

    group = RemoteGroup("axes", (), period=0.02, find=no_point, begin=begin, end=ended.append)
    if followed:
        await group.ready()
    for _ in range(2):
        group.close()
    with pytest.raises(BusClosed, match="is closed"):
        group.subscribe()
    await group.ready()
    assert (len(begun), ended) == ((1, [7]) if followed else (0, []))


def test_a_follower_of_exchanges_receives_exchanges_alone() -> None:
    received: list[Any] = []
    ended: list[bool] = []
    stream = RemoteExchanges(received.append, lambda: ended.append(True))
    stream.receive("exchanges", StreamMessage(1, 0, {"now": 1}))
    stream.receive("ended", StreamMessage(1, 0, NoBody()))
    assert received == [{"now": 1}]
    stream.end()
    assert ended == []
    stream.close()
    assert ended == [True]
