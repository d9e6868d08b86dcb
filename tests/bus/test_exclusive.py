"""Sequences that nobody comes between, as an application writes them; in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

import pytest

from busmaster.arbiter.counters import LineState
from busmaster.arbiter.transaction import Priority
from busmaster.bus.bus import Bus
from busmaster.bus.node import Node
from busmaster.contract.bounds import LONGEST_HOLD
from busmaster.errors import BusClosed, HoldEnded, InvalidCommand, NotStarted
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.handle import Hcp2Controller
from tests.stories import cycles, on_a_bus


class Heard(EmulatedMint):
    """It says by `heard` what it was asked, with its address."""

    heard: list[tuple[int, bool]]

    def take(self, frame: bytes, now: float) -> bool:
        self.heard.append((self.address, frame[-2:-1] != b"\x05"))
        return super().take(frame, now)


def two() -> tuple[list[Heard], list[tuple[int, bool]]]:
    """Two devices, and what both hear: whose it is, and whether it writes."""
    devices, heard = [Heard(1), Heard(2)], list[tuple[int, bool]]()
    for device in devices:
        device.heard = heard
    return devices, heard


async def busy(handles: Sequence[Hcp2Controller], over: asyncio.Event) -> None:
    """Others of the program ask on and on."""
    while not over.is_set():
        await asyncio.gather(*(handle.read(number) for handle in handles for number in (1, 2, 3)))


def test_r9_a_handle_reads_back_what_it_wrote_and_nothing_comes_between() -> None:
    devices, heard = two()

    async def story(bus: Bus) -> None:
        first, second = Hcp2Controller(bus, 1), Hcp2Controller(bus, 2)
        bus.poll_group("polled", period=0.05, points=[first.point("7"), second.point("7")])
        over = asyncio.Event()
        others = asyncio.ensure_future(busy([first, second], over))
        for value in range(20):
            await asyncio.sleep(0.033)
            async with first.exclusive() as held:
                assert isinstance(held, Hcp2Controller)
                await held.write(9, value)
                assert await held.read(9) == value
        over.set()
        await others

    on_a_bus(story, *devices)
    written = [place for place, (_, writes) in enumerate(heard) if writes]
    assert len(written) == 20
    assert all(heard[place + 1] == (1, False) for place in written), "the read behind each write is its own"
    assert heard.count((2, False)) > 100


def test_r9_an_urgent_request_of_anybody_comes_between() -> None:
    devices, heard = two()

    async def story(bus: Bus) -> None:
        first, second = Hcp2Controller(bus, 1), Hcp2Controller(bus, 2)
        async with first.exclusive() as held:
            await held.write(9, 1)
            waits = asyncio.ensure_future(second.read(1))
            assert await second.read(2, priority=Priority.URGENT) == 0
            assert await held.read(9) == 1
            assert not waits.done()
        await waits

    on_a_bus(story, *devices)
    assert heard == [(1, True), (2, False), (1, False), (2, False)]


def test_a_node_or_a_point_of_a_held_handle_is_of_the_sequence_too() -> None:
    async def story(bus: Bus) -> None:
        first, second = Hcp2Controller(bus, 1), Hcp2Controller(bus, 2)
        async with first.node.exclusive(max_hold=1.0) as held:
            await held.request(hcp2.Write(1, (5.0,)))
            waits = asyncio.ensure_future(second.read(1))
            assert await held.request(hcp2.Read(1)) == 5.0
            assert not waits.done()
        async with first.exclusive() as handle:
            await handle.point("1").write(6.0)
            assert await handle.point("1").read() == 6.0
        assert await waits == 0

    on_a_bus(story, *two()[0])


def test_the_line_is_free_when_the_block_is_left_however_it_is_left() -> None:
    async def story(bus: Bus) -> None:
        first, second = Hcp2Controller(bus, 1), Hcp2Controller(bus, 2)
        with pytest.raises(ZeroDivisionError):
            async with first.exclusive(max_hold=5.0) as held:
                await held.write(9, 1 / 0)
        began = bus.now()
        await second.read(1)

        async def holds() -> None:
            async with first.exclusive(max_hold=5.0) as held:
                await held.write(9, 1)
                await asyncio.sleep(3600.0)

        holding = asyncio.ensure_future(holds())
        while bus.state is not LineState.READY or await first.read(9) != 1:  # noqa: ASYNC110  until it was written
            await asyncio.sleep(0.001)
        holding.cancel()
        await asyncio.gather(holding, return_exceptions=True)
        await second.read(1)
        assert bus.now() - began < 6.0

    on_a_bus(story, *two()[0])


def test_a_sequence_whose_time_is_over_says_so_and_others_go_on() -> None:
    devices, heard = two()

    async def story(bus: Bus) -> None:
        first, second = Hcp2Controller(bus, 1), Hcp2Controller(bus, 2)
        async with first.exclusive(max_hold=0.2) as held:
            await held.write(9, 1)
            waits = asyncio.ensure_future(second.read(1))
            await asyncio.sleep(0.3)
            assert waits.done()
            with pytest.raises(
                HoldEnded, match=r"node 1: the sequence has ended: its 0\.2 s have passed.* max_hold"
            ) as ended:
                await held.read(9)
            assert isinstance(ended.value, NotStarted)
            assert ended.value.line == bus.endpoint.name

    on_a_bus(story, *devices)
    assert heard == [(1, True), (2, False)]


def test_what_is_asked_by_a_held_handle_after_its_block_is_refused() -> None:
    async def story(bus: Bus) -> None:
        first = Hcp2Controller(bus, 1)
        async with first.exclusive() as held:
            await held.read(1)
        with pytest.raises(HoldEnded):
            await held.read(1)

    on_a_bus(story, *two()[0])


@pytest.mark.parametrize("wrong", [0, -1.0, LONGEST_HOLD + 0.1, float("nan"), "1", True])
def test_a_hold_that_cannot_be_is_refused(wrong: float) -> None:
    async def story(bus: Bus) -> None:
        first = Hcp2Controller(bus, 1)
        with pytest.raises(InvalidCommand, match="max_hold"):
            async with first.exclusive(max_hold=wrong):
                pass
        async with first.exclusive() as held:
            with pytest.raises(InvalidCommand, match="is already held"):
                async with held.exclusive():
                    pass

    on_a_bus(story, *two()[0])


def test_a_step_that_is_limited_is_measured_within_the_sequence() -> None:
    async def story(bus: Bus) -> None:
        first = Hcp2Controller(bus, 1)
        first.point("9").limit(max_step=10.0)
        async with first.exclusive() as held:
            await held.read(1)
            await held.write(9, 5)
            with pytest.raises(InvalidCommand):
                await held.write(9, 50)
            assert await held.read(9) == 5

    on_a_bus(story, *two()[0])


def test_a_write_of_a_sequence_makes_samples_stale_as_any_other() -> None:
    async def story(bus: Bus) -> None:
        first = Hcp2Controller(bus, 1)
        point = first.point("9")
        group = bus.poll_group("polled", period=0.5, points=[point])
        async for snapshot in group:
            assert snapshot[point].value == 0
            break
        async with first.exclusive() as held:
            await held.point("9").write(4.0)
        assert bus.latest(point) is None

    on_a_bus(story, *two()[0])


def test_the_longest_wait_counts_the_longest_sequence_that_was_begun() -> None:
    async def story(bus: Bus) -> None:
        first = Hcp2Controller(bus, 1)
        await first.read(1)
        alone, urgent = bus.worst_case_wait(), bus.worst_case_wait(Priority.URGENT)
        async with first.exclusive(max_hold=2.0) as held:
            await held.read(1)
        assert bus.worst_case_wait() >= alone + 2.0
        assert bus.worst_case_wait(Priority.URGENT) == urgent

    on_a_bus(story, *two()[0])


def test_a_sequence_on_a_bus_that_is_not_open_says_so() -> None:

    buses: list[Bus] = []

    async def keep(bus: Bus) -> None:
        buses.append(bus)

    on_a_bus(keep, *two()[0])

    async def late() -> None:
        with pytest.raises(BusClosed):
            async with Hcp2Controller(buses[0], 1).exclusive() as held:
                await held.read(1)

    asyncio.run(late())


def test_a_node_of_a_sequence_is_otherwise_its_node() -> None:
    async def story(bus: Bus) -> None:
        first = Hcp2Controller(bus, 1)
        point, node = first.point("9"), Node.of(first)
        await cycles(bus.poll_group("polled", period=10.0, points=[point]), 1)
        async with node.exclusive() as held:
            assert (held.line, held.label, held.address) == (bus.endpoint.name, "node 1", 1)
            assert held.profile is node.profile
            assert held.latest(point) == bus.latest(point) is not None
            assert held.now() == bus.now()
            held.note_stop()
            assert held.stops == node.stops == 1
            held.merge_reads(merge)
            assert node.profile.merge is merge
            held.use_sync_reads(hcp2.Read(3), (hcp2.Read(4), hcp2.Read(5)))
            assert (node.profile.probe, node.profile.sync_reads) == (hcp2.Read(3), (hcp2.Read(4), hcp2.Read(5)))

    def merge(commands: Sequence[Any]) -> Sequence[Any]:
        return ()

    on_a_bus(story, *two()[0])
