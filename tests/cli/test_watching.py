"""What a person sees of a bus and may do to it from the screen, on a real bus and an emulated line."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace

import anyio
import pytest

from busmaster.arbiter import learned
from busmaster.arbiter.counters import DriverErrors
from busmaster.bus.bus import Bus
from busmaster.bus.meaning import Meaning
from busmaster.cli import watching
from busmaster.cli.arguments import View
from busmaster.cli.messages import Action, Frame
from busmaster.cli.output import Level
from busmaster.cli.watching import Watch, count_cycles, json_cycle, plain_cycle
from busmaster.contract.learning import LEARNED
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.emulator.serve import TcpServer
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.registry import make_device
from busmaster.transport.tcp import TcpPort
from tests.patience import PATIENCE
from tests.stories import in_virtual_time


@asynccontextmanager
async def watched(server: TcpServer, *addresses: int, read_only: bool = False) -> AsyncIterator[Watch]:
    """A bus that polls outputs and axis 0 of these controllers every 20 ms, and a watch over it."""
    bus = Bus(TcpPort(server.host, server.port, baudrate=57600))
    handles = [Hcp2Controller(bus, address) for address in addresses]
    points = [handle.point(item) for handle in handles for item in ("outputs", "axis0.idle")]
    async with bus, anyio.create_task_group() as tasks:
        watch = Watch(bus, "test", View(read_only=read_only))
        group = bus.poll_group("axes", period=0.02, points=points)
        watch.add(group)
        tasks.start_soon(count_cycles, watch, group)
        tasks.start_soon(watch.listen)
        yield watch
        tasks.cancel_scope.cancel()


async def seen(watch: Watch, what: Callable[[Frame], bool]) -> Frame:
    """The first picture that shows it."""
    with anyio.fail_after(PATIENCE):
        while not what(frame := watch.picture()):  # noqa: ASYNC110  # a picture is looked at, it announces nothing
            await anyio.sleep(0.01)
    return frame


@pytest.mark.asyncio
async def test_the_picture_has_every_point_its_age_and_its_nodes_health(controllers: TcpServer) -> None:
    async with watched(controllers, 1, 2) as watch:
        frame = await seen(watch, lambda frame: all(row.value is not None for row in frame.rows))
        assert [(row.node, row.item, row.value, row.writable) for row in frame.rows] == [
            ("node 1", "outputs", 0, True),
            ("node 1", "axis0.idle", 1, False),
            ("node 2", "outputs", 0, True),
            ("node 2", "axis0.idle", 1, False),
        ]
        assert all(row.age is not None and 0 <= row.age < PATIENCE for row in frame.rows)
        frame = await seen(watch, lambda frame: [node.health for node in frame.nodes] == ["up", "up"])
        assert frame.port == f"{controllers.host}:{controllers.port}  57600 8N1"
        assert frame.line in ("ready", "settling")
        assert 0 < frame.utilisation <= 1


@pytest.mark.asyncio
async def test_people_are_shown_digits_and_names_and_programs_all_digits_and_numbers(controllers: TcpServer) -> None:
    async with watched(controllers, 1) as watch:
        controller = Hcp2Controller(watch.bus, 1)
        await controller.write(10, 1.25, 1)
        pull = replace(controller.point("10"), meaning=Meaning(precision=3))
        mode = replace(controller.point("11"), meaning=Meaning(labels={1: "on"}))
        group = watch.bus.poll_group("meant", period=0.02, points=[pull, mode])
        watch.add(group)
        async for snapshot in group:
            if all(sample.error is None for sample in snapshot.values()):
                break
        plain = [text.split(" ", 1)[1] for text in plain_cycle(watch, snapshot)]
        assert plain == ["1/10 1.250", "1/11 1 on"]
        samples = json.loads(json_cycle(watch, snapshot))["samples"]
        assert (samples["1/10"]["value"], samples["1/11"]["value"], samples["1/11"]["label"]) == (1.25, 1, "on")
        assert "label" not in samples["1/10"]
        watch.saw(snapshot)
        rows = {row.item: row for row in watch.picture().rows}
        assert (rows["10"].value, rows["10"].precision, rows["11"].value) == (1.25, 3, "1 on")


@pytest.mark.asyncio
async def test_an_alarm_is_an_event_of_the_picture_and_a_warning_to_who_does_not_look(
    controllers: TcpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[tuple[str, Level]] = []
    monkeypatch.setattr(watching, "note", lambda line, level: said.append((line, level)))
    async with watched(controllers, 1) as watch:
        controller = Hcp2Controller(watch.bus, 1)
        watch.groups[0].add(replace(controller.point("10"), meaning=Meaning(high=5, hysteresis=1)))
        await controller.write(10, 6)
        await seen(watch, lambda frame: any("1/10 = 6 is above its high" in event for event in frame.events))
        await controller.write(10, 4)
        await seen(watch, lambda frame: any("1/10 is back at 4" in event for event in frame.events))
    alarms = [(text, level) for text, level in said if text.startswith("1/10")]
    assert alarms[:2] == [
        ("1/10 = 6 is above its high of 5", Level.WARNING),
        ("1/10 is back at 4, was above its high of 5", Level.NOTICE),
    ]


@pytest.mark.asyncio
async def test_a_point_that_fails_shows_its_last_good_value_growing_old(controllers: TcpServer) -> None:
    async with watched(controllers, 3) as watch:
        await seen(watch, lambda frame: frame.rows[0].value == 0)
        controllers.call(lambda line, now: line.cut(now, line.device(3)))
        try:
            frame = await seen(watch, lambda frame: bool(frame.rows[0].error))
        finally:
            controllers.call(lambda line, now: line.restore(now))
        assert frame.rows[0].value == 0
        old = frame.rows[0].age
        assert old is not None
        assert old > 0.05


@pytest.mark.asyncio
async def test_a_value_written_from_the_screen_reaches_the_node_and_is_an_event(controllers: TcpServer) -> None:
    async with watched(controllers, 4) as watch:
        await watch.act(Action("write", "node 4", "outputs", "5"))
        frame = await seen(watch, lambda frame: frame.rows[0].value == 5)
        assert frame.events[-1].endswith("node 4 outputs = 5 written")
        await watch.act(Action("write", "node 4", "outputs", "five"))
        assert watch.picture().events[-1].endswith("node 4 outputs = five: 'five' is no number")
        await watch.act(Action("write", "node 4", "axis0.idle", "5"))
        assert watch.picture().events[-1].endswith("axis0.idle is read-only")


@pytest.mark.asyncio
async def test_a_read_only_view_writes_nothing(controllers: TcpServer) -> None:
    async with watched(controllers, 5, read_only=True) as watch:
        await watch.act(Action("write", "node 5", "outputs", "5"))
        assert watch.picture().events[-1].endswith("this line is read-only")
        assert await Hcp2Controller(watch.bus, 5).io.outputs.read() == 0
        assert watch.picture().read_only


@pytest.mark.asyncio
async def test_pausing_stops_the_cycles_and_the_same_key_goes_on(controllers: TcpServer) -> None:
    async with watched(controllers, 6) as watch:
        await seen(watch, lambda frame: frame.groups[0].cycles > 2)
        await watch.act(Action("pause"))
        assert watch.picture().groups[0].paused
        cycles = (await seen(watch, lambda frame: frame.backlog == 0)).groups[0].cycles
        await watch.act(Action("demand"))
        await watch.act(Action("pause"))
        frame = await seen(watch, lambda frame: frame.groups[0].cycles > cycles + 2)
        assert not frame.groups[0].paused


@in_virtual_time
async def test_the_time_for_which_it_was_paused_is_no_period() -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)])))
    async with bus, anyio.create_task_group() as tasks:
        watch = Watch(bus, "test", View())
        group = bus.poll_group("axes", period=0.1, points=[Hcp2Controller(bus, 1).point("1")])
        watch.add(group)
        tasks.start_soon(count_cycles, watch, group)
        for pause in (1.0, 10.0, 1.0):
            await anyio.sleep(pause)
            await watch.act(Action("pause"))
        assert watch.picture().groups[0].achieved == pytest.approx(0.1, abs=0.01)
        tasks.cancel_scope.cancel()


@pytest.mark.asyncio
async def test_a_node_is_suspended_and_goes_on_with_the_same_key(controllers: TcpServer) -> None:
    async with watched(controllers, 7) as watch:
        await seen(watch, lambda frame: frame.rows[0].value == 0)
        await watch.act(Action("suspend", "node 7"))
        frame = await seen(watch, lambda frame: bool(frame.rows[0].error))
        assert frame.nodes[0].health == "suspended"
        await watch.act(Action("suspend", "node 7"))
        frame = await seen(watch, lambda frame: not frame.rows[0].error)
        assert frame.events[-1].endswith("node 7 goes on")


@pytest.mark.asyncio
async def test_a_watch_that_ends_too_early_says_why_nothing_was_asked_but_not_of_a_noisy_line(
    capfd: pytest.CaptureFixture[str],
) -> None:
    line = Line(hcp2.PROFILE.line, [])
    async with Bus(MemoryPort(line)) as bus:
        watch = Watch(bus, "test", View())
        watch.summarise()
        assert "nothing was asked: a new line rests" in capfd.readouterr().err
        bus.pump.data_received(b"?")
        watch.summarise()
        assert "nothing was asked" not in capfd.readouterr().err


@pytest.mark.asyncio
async def test_what_the_uart_found_wrong_ends_the_summary_if_there_was_anything(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = DriverErrors(0, 0, 0, 0, 0)
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, []))) as bus:
        monkeypatch.setattr(bus.pump, "driver_errors", lambda: found)
        watch = Watch(bus, "test", View())
        watch.summarise()
        assert "uart" not in capfd.readouterr().err
        found = DriverErrors(framing=12, parity=0, breaks=1, overruns=0, buffer_overruns=2)
        watch.summarise()
        assert capfd.readouterr().err.splitlines()[-1] == (
            "busmaster: uart: 12 framing errors, 1 break, 2 bytes lost in the driver; "
            "`busmaster doctor` says what to look for"
        )


@in_virtual_time
async def test_what_was_learned_of_reply_times_is_in_the_summary_once_it_is_trusted(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learned, "TRUSTED_AFTER", 3)
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 1)]))) as bus:
        controller = Hcp2Controller(bus, 1, timings=LEARNED)
        watch = Watch(bus, "test", View())
        await controller.read(1)
        watch.summarise()
        assert "learned" not in capfd.readouterr().err
        for _ in range(2):
            await controller.read(1)
        watch.summarise()
        assert "busmaster: node 1: learned windows: Read 6.35 ms" in capfd.readouterr().err.splitlines()
