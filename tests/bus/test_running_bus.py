"""A bus that runs, in virtual time: its plan, its bounds, and dead nodes as an application sees them."""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from typing import Any

import pytest

from busmaster import ext
from busmaster.arbiter.events import NodeChanged
from busmaster.arbiter.health import Health
from busmaster.arbiter.schedule import line_time
from busmaster.bus.bus import Bus
from busmaster.bus.handle import Handle
from busmaster.bus.node import Node, Priority
from busmaster.contract.learning import LEARNED
from busmaster.contract.profile import LineSettings
from busmaster.contract.tap import Attempt
from busmaster.contract.timing import Timings
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import BusClosed, BusError, InvalidCommand, NodeDown, NoReply
from busmaster.planning import PlannedGroup
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.mentor.device import EmulatedMentor
from busmaster.protocols.mentor.handle import MentorDrive
from busmaster.protocols.modbus.handle import ModbusUnit
from busmaster.registry import find, make_device
from busmaster.testing.virtual_time import run_in_virtual_time
from busmaster.transport.rs485 import Rs485
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort
from tests.stories import cycles, on_a_bus

# plans and bounds of the running bus


@pytest.mark.parametrize("release", [0.0, 0.03])
def test_the_time_for_which_a_drive_still_drives_the_line_belongs_to_the_plan(release: float) -> None:
    times = hcp2.PROFILE.timings.read
    timings = Timings.uniform(replace(times, driver_release_time=release))

    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1, timings=timings)
        bus.poll_group("all", period=0.5, points=[axis.point(str(element)) for element in range(1, 6)])
        await asyncio.sleep(20.0)
        prediction = await bus.plan()
        assert (await bus.statistics()).utilisation == pytest.approx(prediction.utilisation, abs=0.02)

    on_a_bus(story, EmulatedMint(1, delay=Delay(0.05)))


def test_the_plan_of_a_running_bus_is_what_it_does() -> None:
    """With reply times as measured, whatever the values' lengths: within 2 percentage points."""

    async def story(bus: Bus) -> None:
        axes = [Hcp2Controller(bus, address) for address in (1, 2)]
        for period in (0.2, 0.5):
            bus.poll_group(f"{period}", period=period, points=[a.point(str(e)) for a in axes for e in range(1, 6)])
        await asyncio.sleep(5.0)
        bus.reset_statistics()
        await asyncio.sleep(20.0)
        prediction = await bus.plan()
        assert (await bus.statistics()).utilisation == pytest.approx(prediction.utilisation, abs=0.02)
        assert prediction.fits
        for group, planned in zip(bus.groups, prediction.groups, strict=True):
            assert group.statistics().cycle_time.mean == pytest.approx(planned.cycle, rel=0.1)
            assert group.statistics().cycle_time.highest <= planned.worst_cycle

    devices = [EmulatedMint(address, delay=Delay(0.001, 0.009)) for address in (1, 2)]
    devices[0].comms = [-1234567.8912] * 100
    on_a_bus(story, *devices)


def test_a_plan_of_what_might_be_added() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        group = bus.poll_group("now", period=0.1, points=[axis.point("1")])
        await cycles(group, 10)
        greedy = PlannedGroup("greedy", 0.05, [(Node.of(axis).planned(), hcp2.Read(e)) for e in range(1, 40)])
        assert (await bus.plan()).fits
        assert not (await bus.plan(greedy)).fits

    on_a_bus(story)


def test_r9_the_worst_case_includes_the_time_for_which_a_port_holds_a_frame_back() -> None:
    def hold(rs485: Rs485 | None) -> float:
        bus = Bus(SerialPort("/dev/none", baudrate=57600, rs485=rs485))
        group = PlannedGroup("g", 1.0, [(Node.of(Hcp2Controller(bus, 1)).planned(), hcp2.Read(1))])
        return asyncio.run(bus.plan(group)).worst_waits[Priority.URGENT]

    assert hold(Rs485(delay_before=0.02)) >= hold(None) + 0.02
    assert hold(Rs485(delay_after=0.02)) == hold(None), "it ends before the reply begins"


def test_r9_the_worst_case_wait_of_the_line_at_hand() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        await axis.read(1)
        hold = bus.worst_case_wait(Priority.COMMAND) / (1 + 4 + 3)  # with three exchanges before each (R15)
        reading = [asyncio.create_task(axis.read(e)) for e in range(1, 10)]
        await asyncio.sleep(0)
        assert bus.worst_case_wait(Priority.COMMAND) == pytest.approx(hold * (1 + 4 * (8 + 2) + 3))
        assert bus.worst_case_wait(Priority.URGENT) == pytest.approx(hold)
        await asyncio.gather(*reading)
        group = bus.poll_group("g", period=0.5, points=[axis.point(str(e)) for e in range(1, 5)])
        await cycles(group, 1)
        assert bus.worst_case_wait(Priority.POLL) == pytest.approx(0.5 + 4 * 8 * 5 * hold)
        with pytest.raises(NoReply):
            await bus.node(hcp2.PROFILE, 9).request(hcp2.Read(1), retries=0)
        assert bus.worst_case_wait(Priority.POLL) == pytest.approx(0.5 + 4 * 16 * 5 * hold)

    on_a_bus(story)


# dead nodes, seen by an application


def test_r11_the_hook_of_a_node_that_returns_runs_before_its_polls_and_health_is_told() -> None:
    device = EmulatedMint(1)

    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("7")
        order: list[str] = []

        async def restore(node: Node) -> None:
            order.append("hook begins")
            await asyncio.sleep(1.0)
            await point.write(42.0)
            order.append("hook ends")

        Node.of(point).on_return = restore
        health = bus.events()
        group = bus.poll_group("g", period=0.1, points=[point])
        await cycles(group, 3)
        device.faults.dead = 1.0
        await asyncio.sleep(10.0)
        assert isinstance(group.latest[point].error if group.latest else None, NodeDown)
        device.faults.dead = 0.0
        async for snapshot in group:
            if snapshot[point].error is None:
                break
        order.append("polled")
        assert snapshot[point].value == 42.0
        assert order == ["hook begins", "hook ends", "polled"]
        assert [h async for h in until_back(health)] == [Health.UP, Health.SUSPECT, Health.DOWN, Health.UP]

    on_a_bus(story, device)


def test_r11_a_node_that_returns_again_while_its_hook_runs_gets_another_run_after_it() -> None:
    device = EmulatedMint(1)

    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("7")
        order: list[str] = []

        async def restore(node: Node) -> None:
            order.append("begins")
            await asyncio.sleep(20.0)
            order.append("ends")

        Node.of(point).on_return = restore
        group = bus.poll_group("g", period=0.5, points=[point])
        await cycles(group, 3)

        async def wait_for(health: Health) -> None:
            while Node.of(point).health is not health:
                await cycles(group, 1)
                with contextlib.suppress(BusError):
                    await point.read()

        for _ in range(2):
            device.faults.dead = 1.0
            await wait_for(Health.DOWN)
            device.faults.dead = 0.0
            await wait_for(Health.UP)
        assert order == ["begins"]
        while (await cycles(group, 1))[0][point].error is not None:
            pass
        assert order == ["begins", "ends", "begins", "ends"]

    on_a_bus(story, device)


async def until_back(events: AsyncIterator[object]) -> AsyncIterator[Health]:
    """The changes of health up to a return from DOWN."""
    async for event in events:
        if isinstance(event, NodeChanged):
            yield event.after
            if event.before is Health.DOWN:
                return


def test_a_suspended_node_rests_and_comes_back_by_itself() -> None:
    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("7")
        group = bus.poll_group("g", period=0.1, points=[point])
        await cycles(group, 1)
        Node.of(point).suspend(for_=2.0)
        with pytest.raises(NodeDown, match="suspended"):
            await point.read()
        assert isinstance((await cycles(group, 3))[-1][point].error, NodeDown)
        await asyncio.sleep(2.0)
        assert (await cycles(group, 1))[0][point].error is None

    on_a_bus(story)


def test_what_a_cycle_takes_is_a_guess_until_it_is_measured() -> None:
    """The phases of groups that are added later rest on it."""

    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        group = bus.poll_group("g", period=0.1, points=[axis.point("1")])
        guessed = group.poll.cost
        await cycles(group, 5)
        bus.poll_group("h", period=0.1, points=[axis.point("2")])
        read = hcp2.Read(1).open(1, hcp2.PROFILE.timings)
        assert guessed == pytest.approx(line_time(read, bus._byte_time))
        assert group.poll.cost == pytest.approx(0.002 + (8 + 6) * bus._byte_time, abs=0.0005)

    on_a_bus(story)


def test_a_refused_probe_of_a_suspect_is_an_answer_and_a_request_that_was_not_sent_is_none() -> None:
    async def story(bus: Bus) -> None:
        node = Node.of(Hcp2Controller(bus, 1))
        await node.request(hcp2.Read(1))
        assert await node.probe()
        node.suspend(10.0)
        assert not await node.probe()
        node.suspend(0.0)
        node._record.health = Health.SUSPECT
        node._record.profile = replace(hcp2.PROFILE, probe=hcp2.Read(105))
        node._record.failures = 1
        node._record.failed_at = bus.now()
        assert await node.probe()

    on_a_bus(story, EmulatedMint(1, axes=0, refuse_reserved=True))


def test_a_second_handle_with_the_same_timings_is_welcome_after_max_reply_delay_was_raised() -> None:
    async def story(bus: Bus) -> None:
        timings = hcp2.PROFILE.timings.with_window(0.12)
        first = Hcp2Controller(bus, 1, timings=timings)
        Node.of(first)._record.timings = timings.with_max_reply_delay(0.3)
        assert Hcp2Controller(bus, 1, timings=timings).node is first.node
        with pytest.raises(InvalidCommand, match="other timings"):
            Hcp2Controller(bus, 1, timings=hcp2.PROFILE.timings)

    on_a_bus(story)


def test_r11_a_hook_that_fails_is_logged_and_the_polls_of_its_node_go_on(caplog: pytest.LogCaptureFixture) -> None:
    device = EmulatedMint(1)

    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("7")

        async def restore(node: Node) -> None:
            raise KeyError("ramp")

        Node.of(point).on_return = restore
        group = bus.poll_group("g", period=0.5, points=[point])
        await cycles(group, 2)
        device.faults.dead = 1.0
        while Node.of(point).health is not Health.DOWN:
            await cycles(group, 1)
        device.faults.dead = 0.0
        while (await cycles(group, 1))[0][point].error is not None:
            pass
        [record] = [record for record in caplog.records if record.levelname == "ERROR"]
        assert record.message == f"{bus.endpoint.name}: the on_return hook of node 1 failed"
        assert record.exc_info is not None
        assert isinstance(record.exc_info[1], KeyError)
        assert not bus._tasks - {task for task in bus._tasks if not task.done()}

    on_a_bus(story, device)


def test_a_suspension_is_ended_by_0_and_lasts_a_day_at_most() -> None:
    async def story(bus: Bus) -> None:
        node = Node.of(Hcp2Controller(bus, 1))
        states = [node.suspended]
        node.suspend(86_400.0)
        states.append(node.suspended)
        await asyncio.sleep(86_399.0)
        states.append(node.suspended)
        node.suspend(0.0)
        states.append(node.suspended)
        await node.request(hcp2.Read(1))
        for wrong in (86_400.5, -1.0):
            with pytest.raises(InvalidCommand, match="node 1: a suspension"):
                node.suspend(wrong)
        states.append(node.suspended)
        assert states == [False, True, True, False, False]

    on_a_bus(story)


def test_a_node_describes_itself_by_protocol_address_and_health() -> None:
    async def story(bus: Bus) -> None:
        node = Node.of(Hcp2Controller(bus, 1))
        assert repr(node) == "<Node hcp2 1 unknown>"
        await node.request(hcp2.Read(1))
        assert repr(node) == "<Node hcp2 1 up>"

    on_a_bus(story)


def test_a_probe_on_a_bus_that_is_not_open_proves_nothing_about_the_node() -> None:
    async def probe() -> None:
        with pytest.raises(BusClosed):
            await Node.of(Hcp2Controller(Bus(SerialPort("/dev/ttyS0", baudrate=57600)), 1)).probe()

    asyncio.run(probe())


def test_two_taps_receive_the_same_traffic_and_each_until_it_is_removed() -> None:
    async def story(bus: Bus) -> None:
        axis, taps = Hcp2Controller(bus, 1), [Counted(), Counted()]
        for tap in taps:
            ext.add_tap(bus, tap)
        await axis.read(1)
        assert taps[0].seen == taps[1].seen == ["transmitted", "received", "attempted"]
        ext.remove_tap(bus, taps[0])
        await axis.read(1)
        assert (len(taps[0].seen), len(taps[1].seen)) == (3, 6)
        ext.remove_tap(bus, taps[1])
        await axis.read(1)
        assert len(taps[1].seen) == 6

    on_a_bus(story)


class Counted:
    """A tap that keeps the names of its calls, each once for bytes that follow one another."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        self._note("transmitted")

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        self._note("received")

    def attempted(self, attempt: Attempt, /) -> None:
        self._note("attempted")

    def _note(self, name: str) -> None:
        if self.seen[-1:] != [name]:
            self.seen.append(name)


def test_a_reset_begins_all_statistics_again() -> None:
    async def story(bus: Bus) -> None:
        point = replace(Hcp2Controller(bus, 1).point("7"), read_after_write=True)
        group = bus.poll_group("g", period=0.1, points=[point])
        await cycles(group, 3)
        await point.write(5.0)
        await asyncio.sleep(0.5)
        assert ext.reads_after_writes(bus).read == 1
        group.pause()
        await asyncio.sleep(0.2)
        bus.reset_statistics()
        assert ext.reads_after_writes(bus).read == 0
        assert (await bus.statistics()).exchanges == Node.of(point).statistics().attempts == 0
        assert group.statistics().cycles == 0

    on_a_bus(story)


def test_behind_a_port_of_unknown_rate_a_byte_takes_the_time_of_the_first_protocol() -> None:
    bus = Bus(TcpPort("127.0.0.1", 1))
    assert bus._byte_time == pytest.approx(10 / 9600)
    bus.node(hcp2.PROFILE, 1)
    assert bus._byte_time == hcp2.PROFILE.line.byte_time
    bus.node(replace(hcp2.PROFILE, name="slower", line=LineSettings(1200), shares_line_with=frozenset({"hcp2"})), 1)
    assert bus._byte_time == hcp2.PROFILE.line.byte_time
    known = Bus(TcpPort("127.0.0.1", 1, baudrate=9600))
    known.node(hcp2.PROFILE, 1)
    assert known._byte_time == pytest.approx(10 / 9600)


def test_a_greatest_age_is_a_time_and_only_a_good_sample_serves() -> None:
    device = EmulatedMint(1)

    async def story(bus: Bus) -> None:
        point = Hcp2Controller(bus, 1).point("7")
        for wrong in (-1.0, float("nan"), "1"):
            with pytest.raises(InvalidCommand, match="node 1: max_age"):
                await point.read(max_age=wrong)  # type: ignore[arg-type]  # one of them
        group = bus.poll_group("g", period=1000.0, points=[point])
        await cycles(group, 1)
        await asyncio.sleep(100.0)
        sent = Node.of(point).statistics().attempts
        assert await point.read(max_age=float("inf")) == 0.0
        assert Node.of(point).statistics().attempts == sent
        device.faults.dead = 1.0
        group.demand()
        await cycles(group, 1)
        device.faults.dead = 0.0
        assert await point.read(max_age=float("inf")) == 0.0
        assert Node.of(point).statistics().attempts > sent + 1

    on_a_bus(story, device)


def test_the_reply_time_in_plans_is_that_of_the_last_replies() -> None:
    """A drive replies more slowly when its program has grown: 400 quick replies and 500 slow ones."""
    device = EmulatedMint(1, delay=Delay(0.002))

    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        group = bus.poll_group("g", period=5.0, points=[axis.point(str(element)) for element in range(1, 51)])
        await cycles(group, 8)
        assert (Node.of(axis).planned().reply_time or 1.0) < 0.003
        device.delay = Delay(0.020)
        await cycles(group, 10)
        assert (Node.of(axis).planned().reply_time or 0.0) > 0.014

    on_a_bus(story, device)


def test_a_plan_behind_a_port_of_unknown_rate_is_for_the_line_of_the_first_protocol() -> None:
    bus = Bus(TcpPort("127.0.0.1", 1))
    assert asyncio.run(bus.plan()).line == LineSettings(9600)
    bus.node(hcp2.PROFILE, 1)
    assert hcp2.PROFILE.line != LineSettings(9600)
    assert asyncio.run(bus.plan()).line == hcp2.PROFILE.line


def test_r9_polls_in_the_background_are_not_among_those_before_a_poll() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        points = [axis.point(str(element)) for element in range(1, 15)]
        await axis.read(1)
        hold = bus.worst_case_wait(Priority.COMMAND) / (1 + 4 + 3)  # with three exchanges before each (R15)
        group = bus.poll_group("fast", period=0.5, points=points[:4])
        low = bus.poll_group("slow", period=0.5, points=points[4:], priority=Priority.BACKGROUND)
        await asyncio.gather(cycles(group, 1), cycles(low, 1))
        # Twice as many turns as without a group in the background, and no more rivals.
        assert bus.worst_case_wait(Priority.POLL) == pytest.approx(0.5 + 4 * 16 * 5 * hold)
        assert bus.worst_case_wait(Priority.BACKGROUND) == pytest.approx(0.5 + 4 * 16 * 10 * hold)

    on_a_bus(story)


def test_hooks_that_still_run_are_cancelled_when_the_bus_is_closed() -> None:
    devices, begun, cancelled = [EmulatedMint(1), EmulatedMint(2)], list[int](), list[int]()

    async def restore(node: Node) -> None:
        begun.append(node.address)
        try:
            await asyncio.sleep(1e6)
        except asyncio.CancelledError:
            cancelled.append(node.address)
            raise

    async def story(bus: Bus) -> None:
        axes = [Hcp2Controller(bus, address) for address in (1, 2)]
        for axis in axes:
            Node.of(axis).on_return = restore
        group = bus.poll_group("g", period=0.5, points=[axis.point("7") for axis in axes])
        for dead, health in ((0.0, Health.UP), (1.0, Health.DOWN), (0.0, Health.UP)):
            for device in devices:
                device.faults.dead = dead
            while any(Node.of(axis).health is not health for axis in axes):
                await cycles(group, 1)
        await cycles(group, 1)

    on_a_bus(story, *devices)
    assert sorted(begun) == sorted(cancelled) == [1, 2]


def test_the_time_before_a_bus_is_entered_is_not_time_of_its_line() -> None:
    async def story() -> None:
        bus = Bus(MemoryPort(Line(LineSettings(57600), [EmulatedMint(1)], chance=random.Random(1))))
        await asyncio.sleep(100.0)
        async with bus:
            await Hcp2Controller(bus, 1).read(1)
            assert (await bus.statistics()).elapsed < 5.0

    run_in_virtual_time(story())


def test_a_plan_at_once_evaluates_merges_that_no_group_has_enabled() -> None:
    async def story(bus: Bus) -> None:
        drive = MentorDrive(bus, 11)
        bus.poll_group("g", period=1.0, points=[drive.point(f"1.{number}") for number in range(17, 25)])
        assert ext.plan_at_once(bus).groups[0].could_save == 0.0
        saved = ext.plan_at_once(bus, could_merge=[mentor.merge_runs]).groups[0].could_save
        assert saved == (await bus.plan(could_merge=[mentor.merge_runs])).groups[0].could_save > 0.0

    on_a_bus(story, EmulatedMentor(11), settings=mentor.PROFILE.line)


def test_a_plan_with_pauses_is_the_plan_and_pauses() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        for number in range(10):
            points = [axis.point(str(element)) for element in range(1, 50)]
            bus.poll_group(str(number), period=1000.0, points=points)
        began = bus.now()
        planned = await ext.plan_with_pauses(bus, pause=2.0)
        assert bus.now() - began > 4.0
        assert [group.exchanges for group in planned.groups] == [49] * 10

    on_a_bus(story)


def test_the_cycles_of_a_clients_group_take_turns_with_those_of_the_owner() -> None:
    async def story(bus: Bus) -> None:
        axis, client = Hcp2Controller(bus, 1), ext.line_of(bus).add_client(1.0)
        points = [axis.point(str(element)) for element in range(1, 41)]
        long = bus.poll_group("long", period=1000.0, points=points[1:], client=client)
        short = bus.poll_group("short", period=1000.0, points=points[:1])
        await asyncio.gather(cycles(long, 1), cycles(short, 1))
        long.demand()
        await asyncio.sleep(0.001)
        short.demand()
        [[first], [second]] = await asyncio.gather(cycles(short, 1), cycles(long, 1))
        assert first.due > second.due
        assert first.finished - first.due < (second.finished - second.due) / 4

    on_a_bus(story)


def test_the_statistics_of_a_node_have_its_learned_reply_times() -> None:
    async def story(bus: Bus) -> None:
        axis, other = Hcp2Controller(bus, 1, timings=LEARNED), Hcp2Controller(bus, 2)
        await axis.read(1)
        await other.read(1)
        [times] = Node.of(axis).statistics().learned
        assert (times.kind, times.trusted) == ("Read", False)
        assert 0.0 < times.slowest < times.window < hcp2.PROFILE.timings.read.window
        assert Node.of(other).statistics().learned == ()

    on_a_bus(story)


def test_a_hold_of_a_client_is_charged_to_it() -> None:
    async def story(bus: Bus) -> None:
        node, client = Node.of(Hcp2Controller(bus, 1)), ext.line_of(bus).add_client(1.0)
        hold = ext.hold(node, 0.5, client)
        assert hold.client is client
        assert ext.hold(node, 0.5).client is not client
        ext.line_of(bus).release(hold)

    on_a_bus(story)


def test_a_plan_has_the_period_the_phase_and_the_class_of_each_running_group() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        points = [axis.point(str(element)) for element in range(1, 6)]
        first = bus.poll_group("first", period=0.5, phase=0.1, points=points[:1])
        second = bus.poll_group("second", period=2.0, points=points, priority=Priority.BACKGROUND)
        planned = [group.planned() for group in (first, second)]
        assert [(one.name, one.period, one.priority) for one in planned] == [
            ("first", 0.5, Priority.POLL),
            ("second", 2.0, Priority.BACKGROUND),
        ]
        assert planned[0].phase == 0.1
        one, other = (await bus.plan()).groups
        assert other.worst_wait - other.period > one.worst_wait - one.period

    on_a_bus(story)


def test_r9_the_worst_case_includes_queued_polls_and_the_longest_period_of_a_group() -> None:
    async def story(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        await axis.read(1)
        hold = bus.worst_case_wait(Priority.COMMAND) / (1 + 4 + 3)  # with three exchanges before each (R15)
        alone = {priority: bus.worst_case_wait(priority) for priority in (Priority.POLL, Priority.BACKGROUND)}
        for priority, before in alone.items():
            reading = [asyncio.ensure_future(axis.read(element, priority=priority)) for element in range(1, 7)]
            await asyncio.sleep(0)
            assert bus.worst_case_wait(priority) >= before + 4 * 5 * hold
            await asyncio.gather(*reading)
            assert bus.worst_case_wait(priority) == before

    def with_groups(*periods: float) -> float:
        waits: list[float] = []

        async def story(bus: Bus) -> None:
            axis = Hcp2Controller(bus, 1)
            groups = [bus.poll_group(str(n), period=p, points=[axis.point(str(n))]) for n, p in enumerate(periods, 1)]
            bus.poll_group("empty", period=0.95, points=[])
            await asyncio.gather(*(cycles(group, 1) for group in groups))
            waits.append(bus.worst_case_wait(Priority.POLL))

        on_a_bus(story)
        return waits[0]

    on_a_bus(story)
    assert with_groups(0.5, 0.8) - with_groups(0.5, 0.5) == pytest.approx(0.3)
    assert with_groups(0.8, 0.5) == with_groups(0.5, 0.8)


def test_r9_the_worst_case_is_that_of_the_slowest_node_and_of_the_longest_read_of_a_kind() -> None:
    slow = Timings.uniform(replace(hcp2.PROFILE.timings.read, window=0.4, max_reply_delay=0.6))

    async def nodes(bus: Bus) -> None:
        quick, other = Hcp2Controller(bus, 1), Hcp2Controller(bus, 2, timings=slow)
        group = PlannedGroup("g", 1.0, [(Node.of(quick).planned(), hcp2.Read(1))])
        await quick.read(1)
        before, planned = bus.worst_case_wait(Priority.URGENT), (await bus.plan(group)).worst_waits
        await other.read(1)
        assert bus.worst_case_wait(Priority.URGENT) > before + 0.3
        assert (await bus.plan(group)).worst_waits[Priority.URGENT] > planned[Priority.URGENT] + 0.3
        Hcp2Controller(bus, 3)  # a node to which nothing was sent
        await quick.read(1)
        assert bus.worst_case_wait(Priority.URGENT) > before + 0.3

    async def slow_first(bus: Bus) -> None:
        other, quick = Hcp2Controller(bus, 2, timings=slow), Hcp2Controller(bus, 1)
        await other.read(1)
        before = bus.worst_case_wait(Priority.URGENT)
        await quick.read(1)
        assert bus.worst_case_wait(Priority.URGENT) == before

    async def reads(bus: Bus) -> None:
        unit = ModbusUnit(bus, 17)
        short = bus.poll_group("short", period=1.0, points=[unit.point(f"holding:{place}") for place in range(2)])
        await cycles(short, 1)
        before = bus.worst_case_wait(Priority.URGENT)
        long = bus.poll_group("long", period=1.0, points=[unit.point(f"holding:{place}") for place in range(90)])
        await cycles(long, 1)
        assert bus.worst_case_wait(Priority.URGENT) > before + 2 * 80 * bus._byte_time

    on_a_bus(nodes)
    on_a_bus(slow_first)
    on_a_bus(reads, make_device("modbus", 17), settings=ModbusUnit.profile.line)


def test_r9_the_bounds_include_the_programs_that_share_the_line_and_the_time_for_which_a_port_holds_bytes() -> None:
    async def shared(bus: Bus) -> None:
        axis = Hcp2Controller(bus, 1)
        bus.poll_group("g", period=1.0, points=[axis.point("1")])
        alone = (await bus.plan()).worst_waits[Priority.COMMAND]
        ext.line_of(bus).add_client(1.0)
        assert (await bus.plan()).worst_waits[Priority.COMMAND] > alone

    def hold(latency: float) -> float:
        bus = Bus(SerialPort("/dev/none", baudrate=57600, receive_latency=latency))
        Node.of(Hcp2Controller(bus, 1))._kinds[hcp2.Read] = hcp2.Read(1)
        return bus.worst_case_wait(Priority.URGENT)

    on_a_bus(shared)
    assert hold(0.02) >= hold(0.0) + 0.02


@pytest.mark.parametrize(
    ("kind", "item", "options"),
    [
        ("modbus", "holding:0", {}),
        ("mentor", "1.17", {}),
        ("mentor", "1.18:2", {}),
        ("msc", "2000", {"packet_delay": Delay(0.02)}),
        ("msc", "2004:3", {"packet_delay": Delay(0.02)}),
    ],
)
def test_the_reply_time_in_plans_is_that_of_the_drive_whatever_its_exchanges_are(
    kind: str, item: str, options: dict[str, Any]
) -> None:
    found = find(kind)
    address = 11

    async def story(bus: Bus) -> None:
        handle: Callable[..., Handle] = found.handle
        point = handle(bus, address).point(item)
        [*_, snapshot] = await cycles(bus.poll_group("g", period=1.0, points=[point]), 3)
        assert snapshot[point].error is None
        assert Node.of(point).planned().reply_time == pytest.approx(0.02, abs=1e-6)

    on_a_bus(story, make_device(kind, address, delay=Delay(0.02), **options), settings=found.profile.line)


def test_a_seed_makes_the_times_of_probes_repeatable() -> None:
    async def story(seed: int | None, sent: list[float]) -> None:
        line = Line(LineSettings(57600), [EmulatedMint(1)], chance=random.Random(1))
        async with Bus(MemoryPort(line), seed=seed) as bus:
            with pytest.raises(NoReply):
                await bus.node(hcp2.PROFILE, 9).request(hcp2.Read(1), retries=0)
            tap = Sent()
            ext.add_tap(bus, tap)
            await asyncio.sleep(30.0)
            sent += tap.times

    times: list[list[float]] = [[], [], []]
    for seed, sent in zip((1, 1, 2), times, strict=True):
        run_in_virtual_time(story(seed, sent))
    assert times[0] == times[1] != times[2]
    assert len(times[0]) > 3


class Sent(Counted):
    """A tap that keeps the times of sent bytes."""

    def __init__(self) -> None:
        super().__init__()
        self.times: list[float] = []

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        self.times.append(now)
