"""A bus is opened once and closed once, whatever happens to whoever does it."""

from __future__ import annotations

import asyncio
import random
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import anyio
import pytest
from anyio.from_thread import start_blocking_portal

from busmaster.bus.bus import Bus
from busmaster.bus.node import Node
from busmaster.bus.polling import PollGroup
from busmaster.contract.profile import LineSettings
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Echo, Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import BacklogFull, BusClosed, BusError, InvalidCommand, LineDown
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.testing.virtual_time import run_in_virtual_time
from busmaster.transport.serial_port import SerialPort


def slow_bus() -> Bus:
    """On a line whose one controller takes 80 ms to answer."""
    line = Line(LineSettings(57600), [EmulatedMint(1, delay=Delay(0.080))], chance=random.Random(1))
    return Bus(MemoryPort(line), seed=1)


def test_a_bus_that_was_closed_is_not_opened_again() -> None:
    async def story() -> None:
        bus = slow_bus()
        async with bus:
            axis = Hcp2Controller(bus, 1)
        with pytest.raises(BusClosed):
            async with bus:
                pass
        for use in (lambda: bus.poll_group("late", period=1.0, points=[axis.point("1")]), bus.events):
            with pytest.raises(BusClosed) as closed:
                use()
            assert closed.value.line == bus.endpoint.name

    run_in_virtual_time(story())


def test_a_bus_that_is_being_closed_takes_nothing_new() -> None:
    async def story() -> None:
        bus = slow_bus()
        await bus.__aenter__()
        axis = Hcp2Controller(bus, 1)
        await axis.read(1)
        reading = asyncio.create_task(axis.read(1))
        await asyncio.sleep(0.01)
        closing = asyncio.create_task(bus.__aexit__(None, None, None))
        await asyncio.sleep(0.01)
        assert not closing.done()
        with pytest.raises(BusClosed, match="the bus was closed"):
            await axis.read(2)
        with pytest.raises(BusClosed, match="the bus was closed"):
            bus.poll_group("late", period=1.0, points=[axis.element(1)])
        await closing
        assert await reading == 0.0

    run_in_virtual_time(story())


def test_closing_ends_even_if_whoever_closes_is_cancelled_meanwhile() -> None:
    """The exchange on the wire may run out, for 80 ms; the owner's patience ends within them."""

    async def story() -> None:
        bus = slow_bus()

        async def own() -> None:
            async with bus:
                reading = asyncio.create_task(Hcp2Controller(bus, 1).read(1))
                await asyncio.sleep(0.5)
                reading.cancel()
                following = asyncio.create_task(Hcp2Controller(bus, 1).read(1))
                await asyncio.sleep(0.01)
                following.cancel()

        owner = asyncio.create_task(own())
        await asyncio.sleep(0.52)
        owner.cancel()
        with pytest.raises(asyncio.CancelledError):
            await owner
        assert not bus.running
        await asyncio.sleep(0)
        assert asyncio.all_tasks() == {asyncio.current_task()}

    run_in_virtual_time(story())


@pytest.mark.parametrize("patient", [True, False])
def test_closing_tells_whoever_waits_however_many_they_are_and_whoever_closes_is_cancelled(patient: bool) -> None:
    """They are told a few at a time; nobody may be forgotten when the owner does not wait for that."""

    async def story() -> None:
        bus = slow_bus()
        await bus.__aenter__()
        axis = Hcp2Controller(bus, 1)
        await axis.read(1)
        reading = [asyncio.create_task(axis.read(1)) for _ in range(500)]
        await asyncio.sleep(0.01)
        closing = asyncio.create_task(bus.__aexit__(None, None, None))
        await asyncio.sleep(0)
        assert sum(read.done() for read in reading) < 100
        if not patient:
            closing.cancel()
        await asyncio.wait([closing])
        told = await asyncio.wait_for(asyncio.gather(*reading, return_exceptions=True), 1.0)
        assert not any(type(error) is not BusClosed for error in told[1:])
        assert told[0] == 0.0 if patient else isinstance(told[0], BusError)

    run_in_virtual_time(story())


def test_a_closed_bus_sets_no_timer() -> None:
    async def story() -> None:
        async with slow_bus() as bus:
            dead = Hcp2Controller(bus, 9)
            bus.poll_group("dead", period=0.5, points=[dead.point("1")])
            await asyncio.sleep(3.0)
        Node.of(dead).suspend(5.0)
        with pytest.raises(RuntimeError, match="no timer is set"):
            await asyncio.Event().wait()

    with pytest.raises(RuntimeError, match="no timer is set"):
        run_in_virtual_time(story())


def test_a_bus_that_was_not_entered_says_so_and_is_entered_once() -> None:
    async def story() -> None:
        bus = slow_bus()
        axis = Hcp2Controller(bus, 1)
        for use in (
            axis.read(1),
            axis.write(1, 2.0),
            Node.of(axis).timed_request(hcp2.Read(1)),
            axis.node.request(READ),
        ):
            with pytest.raises(BusClosed, match=r"node 1: the bus is not open .*; use the bus inside `async with`"):
                await use
        with pytest.raises(BusClosed, match="the bus is not open"):
            bus.poll_group("early", period=1.0, points=[axis.element(1)])
        async with bus:
            with pytest.raises(InvalidCommand, match="the bus on the emulated line is open already: enter it once"):
                await bus.__aenter__()
            assert await axis.read(1) == 0.0
        with pytest.raises(BusClosed, match=r"node 1: the bus was closed .*; make a new Bus"):
            await axis.read(1)

    run_in_virtual_time(story())


READ = hcp2.Read(1)
USES: dict[str, Callable[[Bus, Hcp2Controller, PollGroup], Any]] = {
    "a request": lambda _, axis, group: axis.read(1),
    "a write": lambda _, axis, group: axis.write(1, 2.0),
    "a point": lambda _, axis, group: axis.element(1).read(),
    "a timed request": lambda _, axis, group: Node.of(axis).timed_request(READ),
    "a probe": lambda _, axis, group: Node.of(axis).probe(),
    "a node's statistics": lambda _, axis, group: Node.of(axis).statistics(),
    "suspend": lambda _, axis, group: Node.of(axis).suspend(1.0),
    "a new node": lambda bus, *_: Hcp2Controller(bus, 2),
    "a new group": lambda bus, *_: bus.poll_group("other", period=1.0, points=[]),
    "a group's points": lambda _, axis, group: group.add(axis.element(2)),
    "a group's statistics": lambda _, axis, group: group.statistics(),
    "demand": lambda _, axis, group: group.demand(),
    "subscribe": lambda _, axis, group: group.subscribe(),
    "close": lambda _, axis, group: group.close(),
    "statistics": lambda bus, *_: bus.statistics(),
    "resetting statistics": lambda bus, *_: bus.reset_statistics(),
    "plan": lambda bus, *_: bus.plan(),
    "the longest wait": lambda bus, *_: bus.worst_case_wait(),
    "events": lambda bus, *_: bus.events(),
    "leaving": lambda bus, *_: bus.__aexit__(None, None, None),
}


def in_a_loop_of_its_own(name: str, use: Callable[[], Any]) -> None:
    """What `asyncio.run` in another thread does with a bus of this one."""

    async def main() -> None:
        found = use()
        if asyncio.iscoroutine(found):
            await found

    asyncio.run(main())
    pytest.fail(f"{name} was let pass")


def test_a_bus_used_from_another_thread_says_at_once_what_to_do_instead() -> None:
    with start_blocking_portal() as portal, portal.wrap_async_context_manager(slow_bus()) as bus:
        axis = portal.call(Hcp2Controller, bus, 1)
        group = portal.call(lambda: bus.poll_group("group", period=100.0, phase=50.0, points=[axis.element(1)]))
        for name, use in USES.items():
            with pytest.raises(InvalidCommand, match=r"used from thread .* hand the call to that loop, with portal"):
                in_a_loop_of_its_own(name, partial(use, bus, axis, group))
        assert portal.call(bus.statistics).exchanges == 0
        assert portal.call(axis.read, 1) == 0.0


def test_without_any_loop_it_says_so_too_and_what_it_advises_works() -> None:
    async def story() -> None:
        async with slow_bus() as bus:
            axis, loop = Hcp2Controller(bus, 1), asyncio.get_running_loop()

            def other_thread() -> float:
                with pytest.raises(InvalidCommand, match=threading.current_thread().name):
                    bus.statistics().send(None)
                with pytest.raises(InvalidCommand, match="run_coroutine_threadsafe"):
                    axis.read(1).send(None)
                return asyncio.run_coroutine_threadsafe(axis.read(1), loop).result(10.0)

            with ThreadPoolExecutor(1) as threads:
                assert await loop.run_in_executor(threads, other_thread) == 0.0
            assert await anyio.to_thread.run_sync(lambda: anyio.from_thread.run(axis.read, 1)) == 0.0

    asyncio.run(story())


def test_another_loop_of_the_same_thread_is_told_so_and_a_loop_that_pauses_is_not() -> None:
    first, second = asyncio.new_event_loop(), asyncio.new_event_loop()
    bus = slow_bus()
    first.run_until_complete(bus.__aenter__())
    axis = Hcp2Controller(bus, 1)
    with pytest.raises(InvalidCommand, match="outside the event loop that opened it"):
        second.run_until_complete(axis.read(1))
    assert first.run_until_complete(axis.read(1)) == 0.0
    first.run_until_complete(bus.__aexit__(None, None, None))
    first.close()
    second.close()


def test_a_bus_that_is_entered_under_another_library_than_asyncio_says_what_it_needs_and_opens_nothing() -> None:
    """Trio awaits as this does: it sends into the coroutine, and no loop of asyncio runs."""
    bus = slow_bus()
    with pytest.raises(InvalidCommand, match=r"needs asyncio's event loop.* not by trio"):
        bus.__aenter__().send(None)
    assert not bus.running


def test_anyios_cancel_scopes_and_task_groups_work_around_a_bus() -> None:
    async def story() -> list[float]:
        read: list[float] = []
        async with slow_bus() as bus, anyio.create_task_group() as tasks:
            axis = Hcp2Controller(bus, 1)
            with anyio.move_on_after(0.01) as scope:
                await axis.read(1)
            assert scope.cancelled_caught
            tasks.start_soon(lambda: collect(axis, read))
        return read

    async def collect(axis: Hcp2Controller, read: list[float]) -> None:
        read.append(await axis.read(1))

    assert anyio.run(story) == [0.0]


def test_a_bus_whose_port_could_not_be_opened_can_be_entered_again() -> None:
    bus = Bus(SerialPort("/dev/no-such-port", baudrate=57600))

    async def story() -> None:
        for _ in range(2):
            with pytest.raises(LineDown) as failed:
                await bus.__aenter__()
            assert failed.value.line == "/dev/no-such-port"
            assert not bus.running

    asyncio.run(story())


def test_a_bus_queues_as_many_requests_of_a_class_as_its_capacity() -> None:
    async def story() -> None:
        line = Line(LineSettings(57600), [EmulatedMint(1)], chance=random.Random(1))
        async with Bus(MemoryPort(line), capacity=3) as bus:
            axis = Hcp2Controller(bus, 1)
            await axis.read(1)
            found = await asyncio.gather(*(axis.read(1) for _ in range(10)), return_exceptions=True)
            assert sorted({type(one) for one in found}, key=str) == [BacklogFull, float]
            assert 3 <= sum(isinstance(one, float) for one in found) <= 4  # one of them on the wire

    run_in_virtual_time(story())


@pytest.mark.parametrize("echo", [Echo(), Echo(0.004)])
def test_a_bus_on_a_line_with_an_echo_does_not_take_its_own_bytes_for_a_reply(echo: Echo) -> None:
    async def story() -> None:
        line = Line(LineSettings(57600), [EmulatedMint(1)], chance=random.Random(1), echo=echo)
        async with Bus(MemoryPort(line)) as bus:
            axis = Hcp2Controller(bus, 1)
            for value in range(5):
                await axis.write(1, value)
                assert await axis.read(1) == value
            counts = Node.of(axis).statistics()
            assert counts.ok == counts.attempts >= 10
            assert (counts.retries, counts.late) == (0, 0)

    run_in_virtual_time(story())


def test_a_strict_bus_takes_longer_because_it_holds_ambiguous_replies() -> None:
    took: dict[bool, float] = {}

    async def story(strict: bool) -> None:
        line = Line(LineSettings(57600), [EmulatedMint(1)], chance=random.Random(1))
        async with Bus(MemoryPort(line), strict=strict) as bus:
            axis = Hcp2Controller(bus, 1)
            await axis.read(1)
            began = bus.now()
            for _ in range(10):
                await axis.read(1)
            took[strict] = bus.now() - began

    for strict in (False, True):
        run_in_virtual_time(story(strict))
    assert took[True] > took[False]
