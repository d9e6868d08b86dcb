"""The options of every coroutine: typed once, checked once, and true to what they promise."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, cast

import pytest

from busmaster import (
    Bus,
    BusError,
    Hcp2Controller,
    InvalidCommand,
    MscController,
    NoReply,
    NotStarted,
    Priority,
    Superseded,
    WriteUnconfirmed,
)
from busmaster.bus.node import Node
from busmaster.bus.requester import ORDINARY, RequestOptions, WriteOptions
from busmaster.emulator.device import Delay
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.msc import codec as msc
from busmaster.protocols.msc.device import EmulatedMsc
from tests.stories import cycles, on_a_bus

SLOW = 0.09


def slow() -> EmulatedMint:
    return EmulatedMint(1, delay=Delay(SLOW))


def test_options_are_what_their_names_say_and_none_is_left_out() -> None:
    given = cast("WriteOptions", {"priority": 0, "retries": None, "finish_within": 1})
    assert RequestOptions.of(given, "node 5") == RequestOptions(priority=Priority.URGENT, finish_within=1)
    assert RequestOptions.of({}, "node 5") == ORDINARY == RequestOptions(Priority.COMMAND)
    with pytest.raises(InvalidCommand, match=r"^node 5: finish_within is a time of 0 s or more, not -1$"):
        RequestOptions.of({"finish_within": -1}, "node 5")
    with pytest.raises(TypeError, match="prority"):
        RequestOptions.of(cast("Any", {"prority": 0}), "node 5")


WRONG: list[Callable[[Hcp2Controller], Awaitable[object]]] = [
    lambda axis: axis.read(1, finish_within=-1.0),
    lambda axis: axis.write(1, 2.0, finish_within=cast("Any", "soon")),
    lambda axis: axis.write(1, 2.0, finish_within=True),
    lambda axis: axis.element(1).write(2.0, **cast("Any", {"verify": True})),
    lambda axis: axis.read(1, **cast("Any", {"verify": True})),
    lambda axis: axis.node.request(hcp2.Read(1), **cast("Any", {"verify": True})),
]


@pytest.mark.parametrize("ask", WRONG)
def test_an_option_that_is_none_is_refused_before_anything_is_sent(
    ask: Callable[[Hcp2Controller], Awaitable[object]],
) -> None:
    async def story(bus: Bus) -> None:
        with pytest.raises(InvalidCommand):
            await ask(Hcp2Controller(bus, 1))
        assert (await bus.statistics()).exchanges == 0

    on_a_bus(story)


def test_a_caller_that_gives_up_is_freed_in_time_and_knows_whether_it_was_sent() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        await axis.read(1)
        began = bus.now()
        outcomes = await asyncio.gather(
            axis.write(1, 7.0, finish_within=0.03),
            axis.write(2, 8.0, finish_within=0.04),
            axis.read(3, finish_within=0.05),
            timed(bus, axis.write(4, 9.0)),
            return_exceptions=True,
        )
        assert [type(outcome) for outcome in outcomes] == [WriteUnconfirmed, NotStarted, NotStarted, float]
        assert outcomes[3] == pytest.approx(began + 2 * SLOW, abs=0.02)  # behind the one that ran out, and no other
        assert (device.comms[1], device.comms[2], device.comms[4]) == (7.0, 0.0, 9.0)
        began = bus.now()
        with pytest.raises(NoReply, match="sent, but not answered within its time: 30 ms, 1 attempt"):
            await axis.read(1, finish_within=0.03)
        assert bus.now() - began == pytest.approx(0.03, abs=0.002)
        assert await axis.read(1, finish_within=1.0) == 7.0

    device = slow()
    on_a_bus(story, device)


async def timed(bus: Bus, work: Awaitable[None]) -> float:
    await work
    return bus.now()


ON_ANY_LINE = pytest.mark.parametrize("limited", [False, True])
"""On a line where a node has a limit, each write is checked before it is sent."""


def with_limit(bus: Bus, limited: bool) -> Hcp2Controller:
    axis = Hcp2Controller(bus, 1)
    if limited:
        axis.element(9).limit(maximum=1.0)
    return axis


@ON_ANY_LINE
def test_a_request_whose_caller_has_gone_is_not_sent(limited: bool) -> None:
    async def story(bus: Bus) -> None:
        node = with_limit(bus, limited).node
        reading = asyncio.ensure_future(node.request(hcp2.Read(1)))
        await asyncio.sleep(0.01)
        writing = asyncio.ensure_future(node.request(hcp2.Write(1, (5.0,))))
        await asyncio.sleep(0.01)
        writing.cancel()
        await reading
        assert await node.request(hcp2.Read(2)) == 0.0
        assert writing.cancelled()
        assert device.comms[1] == 0.0
        assert Node.of(Hcp2Controller(bus, 1)).statistics().attempts == 2

    device = slow()
    on_a_bus(story, device)


@ON_ANY_LINE
def test_a_write_that_was_given_up_makes_older_samples_stale(limited: bool) -> None:
    async def story(bus: Bus) -> None:
        axis = with_limit(bus, limited)
        point, other = axis.element(1), axis.element(2)
        group = bus.poll_group("g", period=10.0, phase=0.0, points=[point, other])
        async for _ in group:
            break
        assert bus.latest(point) is not None
        with pytest.raises(WriteUnconfirmed):
            await point.write(5.0, finish_within=0.03)
        assert bus.latest(point) is None
        assert bus.latest(other) is not None

    on_a_bus(story, slow())


def test_a_read_that_was_given_up_makes_no_sample_stale() -> None:
    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("7")
        group = bus.poll_group("g", period=1000.0, points=[point])
        await cycles(group, 1)
        with pytest.raises(NoReply):
            await point.read(finish_within=0.01)
        assert bus.latest(point) is not None

    on_a_bus(story, EmulatedMint(1, delay=Delay(0.05)))


def test_a_call_of_several_exchanges_has_one_time_for_all_of_them() -> None:
    """Ten long values are several telegrams: what is written by then is, and nobody is told that nothing was."""

    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        await axis.read(1)
        values = [123456.789 + n for n in range(10)]
        began = bus.now()
        with pytest.raises(WriteUnconfirmed) as caught:
            await axis.write(10, *values, finish_within=1.5 * SLOW)
        assert bus.now() - began == pytest.approx(1.5 * SLOW, abs=0.002)
        assert device.comms[10] != 0.0
        assert isinstance(caught.value, BusError)
        with pytest.raises(NotStarted):
            await axis.write(10, *values, finish_within=0.0)
        await axis.read(1)
        with pytest.raises(WriteUnconfirmed, match="only a part of it was written, then: not sent within its time"):
            await asyncio.gather(axis.write(10, *values, start_within=0.05), axis.read(1), axis.read(2))
        await axis.write(10, *values, finish_within=2.0)
        assert device.comms[10:20] == pytest.approx(values, rel=1e-6)

    device = slow()
    on_a_bus(story, device)


def test_a_write_that_could_not_be_read_back_in_time_was_not_left_undone() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        await axis.read(1)
        with pytest.raises(
            WriteUnconfirmed, match="acknowledged, but not read back, then: sent, but not answered"
        ) as caught:
            await axis.write(1, 5.0, verify=True, finish_within=1.5 * SLOW)
        assert (caught.value.label, caught.value.command, caught.value.attempts) == ("node 1", "read element 1", 1)
        assert device.comms[1] == 5.0
        await axis.write(1, 6.0, verify=True, finish_within=1.0)
        device.comms[1] = 6.0
        device.faults.deaf = 1.0
        with pytest.raises(NoReply):  # of a read by itself, that is what it is
            await axis.read(1, retries=0)

    device = slow()
    on_a_bus(story, device)


def test_a_read_back_without_a_reply_is_told_as_what_it_is() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        await axis.read(1)
        writing = asyncio.ensure_future(axis.write(1, 5.0, verify=True))
        await asyncio.sleep(0.5 * SLOW)
        device.faults.dead = 1.0
        with pytest.raises(NoReply, match="read element 1"):
            await writing
        assert device.comms[1] == 5.0

    device = slow()
    on_a_bus(story, device)


def test_msc_blocks_and_their_verification_have_one_time_too() -> None:
    async def story(bus: Bus) -> None:
        press = MscController(bus, 3, address_step=4)
        await press.read(2000)
        with pytest.raises(WriteUnconfirmed):
            await press.load_cam(2000, range(64), finish_within=0.3)
        began = bus.now()
        with pytest.raises((NoReply, NotStarted)):
            await press.read(2000, 320, finish_within=0.3)
        assert bus.now() - began == pytest.approx(0.3, abs=0.002)

    on_a_bus(story, EmulatedMsc(3, address_step=4), settings=msc.PROFILE.line)


def test_a_caller_cancelled_while_it_has_a_time_is_cancelled() -> None:
    async def story(bus: Bus) -> None:
        reading = asyncio.create_task(Hcp2Controller(bus, 1).read(1, finish_within=0.05))
        await asyncio.sleep(0.02)
        reading.cancel()
        with pytest.raises(asyncio.CancelledError):
            await reading
        await asyncio.sleep(0.2)
        assert (await bus.statistics()).cancelled == 1

    on_a_bus(story, slow())


def test_cancelled_in_the_very_turn_in_which_its_time_is_over_it_is_cancelled_and_nothing_is_lost() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        await axis.read(1)
        for early in range(-3, 4):
            reading = asyncio.create_task(axis.read(1, finish_within=0.05))
            await asyncio.sleep(0.05 + early * 1e-4)
            reading.cancel()
            with pytest.raises((asyncio.CancelledError, NoReply)):
                await reading
            assert await axis.read(1) == 0.0

    on_a_bus(story, slow())


@ON_ANY_LINE
def test_a_request_decided_before_the_node_was_told_to_stop_is_not_sent(limited: bool) -> None:
    async def story(bus: Bus) -> None:
        node, other = with_limit(bus, limited).node, Hcp2Controller(bus, 2).node
        seen = node.stops
        await node.request(hcp2.Write(1, (1.0,)), stops_seen=seen)
        Hcp2Controller(bus, 1).node.note_stop()
        other.note_stop()
        with pytest.raises(Superseded, match="stopped after this write was decided"):
            await node.request(hcp2.Write(1, (2.0,)), stops_seen=seen)
        assert (device.comms[1], node.stops, other.stops) == (1.0, seen + 1, 1)

    device = EmulatedMint(1)
    on_a_bus(story, device)


def test_a_timed_request_takes_the_same_options() -> None:
    async def story(bus: Bus) -> None:
        node = Node.of(Hcp2Controller(bus, 1))
        value, timeline = await node.timed_request(hcp2.Read(1), priority=Priority.URGENT, finish_within=1.0)
        assert (value, timeline.attempts) == (0.0, 1)
        with pytest.raises(NoReply):
            await node.timed_request(hcp2.Read(1), finish_within=0.03)

    on_a_bus(story, slow())


def test_equal_writes_of_the_safe_state_that_wait_for_the_line_are_sent_once() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        await axis.read(1)
        sent = Node.of(axis).statistics().attempts
        reading = asyncio.ensure_future(axis.read(1))
        await asyncio.sleep(0.01)
        await asyncio.gather(*(axis.write(2, 5.0, safe=True, priority=Priority.URGENT) for _ in range(3)))
        await reading
        assert Node.of(axis).statistics().attempts == sent + 2
        assert device.comms[2] == 5.0

    device = slow()
    on_a_bus(story, device)


@ON_ANY_LINE
def test_equal_stops_that_wait_for_the_line_are_sent_once(limited: bool) -> None:
    async def story(bus: Bus) -> None:
        node = with_limit(bus, limited).node
        stop = hcp2.Write(2, (5.0,))
        reading = asyncio.ensure_future(node.request(hcp2.Read(1)))
        await asyncio.sleep(0.01)
        await asyncio.gather(*(node.request(stop, stop=True, priority=Priority.URGENT) for _ in range(3)))
        await reading
        assert Node.of(Hcp2Controller(bus, 1)).statistics().attempts == 2
        assert device.comms[2] == 5.0

    device = slow()
    on_a_bus(story, device)


def test_a_probe_of_a_dead_node_is_sent_each_time() -> None:
    """Its caller wants it now: the budget for requests to dead nodes does not apply."""

    async def story(bus: Bus) -> None:
        node = Node.of(Hcp2Controller(bus, 9))
        assert [await node.probe() for _ in range(40)] == [False] * 40
        counts = node.statistics()
        assert counts.attempts - counts.probes == 40

    on_a_bus(story, slow())
