"""What is told of a bus that is polled: on standard error, in lines, and at the end."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace

import anyio
import pytest

from busmaster.app.cli import watching
from busmaster.app.cli.arguments import View
from busmaster.app.cli.output import Level
from busmaster.app.cli.watching import Watch, json_cycle, plain_cycle
from busmaster.arbiter import learned
from busmaster.arbiter.counters import DriverErrors
from busmaster.bus.bus import Bus
from busmaster.bus.meaning import Meaning
from busmaster.contract.learning import LEARNED
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.emulator.serve import TcpServer
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.registry import make_device
from busmaster.transport.tcp import TcpPort
from tests.stories import in_virtual_time


@asynccontextmanager
async def watched(server: TcpServer, *addresses: int) -> AsyncIterator[Watch]:
    """A bus that polls outputs and axis 0 of these controllers every 20 ms, and a watch over it."""
    bus = Bus(TcpPort(server.host, server.port, baudrate=57600))
    handles = [Hcp2Controller(bus, address) for address in addresses]
    points = [handle.point(item) for handle in handles for item in ("outputs", "axis0.idle")]
    async with bus, anyio.create_task_group() as tasks:
        watch = Watch(bus, "test", View())
        group = bus.poll_group("axes", period=0.02, points=points)
        watch.add(group)
        tasks.start_soon(watch.listen)
        yield watch
        tasks.cancel_scope.cancel()


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
        plain = [text.split(" ", 1)[1] for text in plain_cycle(snapshot)]
        assert plain == ["1/10 1.250", "1/11 1 on"]
        samples = json.loads(json_cycle(watch, snapshot))["samples"]
        assert (samples["1/10"]["value"], samples["1/11"]["value"], samples["1/11"]["label"]) == (1.25, 1, "on")
        assert "label" not in samples["1/10"]


@pytest.mark.asyncio
async def test_an_alarm_is_a_warning_to_who_does_not_look(
    controllers: TcpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[tuple[str, Level]] = []
    monkeypatch.setattr(watching, "note", lambda line, level: said.append((line, level)))
    async with watched(controllers, 1) as watch:
        controller = Hcp2Controller(watch.bus, 1)
        watch.groups[0].add(replace(controller.point("10"), meaning=Meaning(high=5, hysteresis=1)))
        for value in (6, 4):
            await controller.write(10, value)
            while f"1/10 {'is back at 4' if value == 4 else '= 6'}" not in (said[-1][0] if said else ""):  # noqa: ASYNC110  # another task makes it true
                await asyncio.sleep(0.01)
    alarms = [(text, level) for text, level in said if text.startswith("1/10")]
    assert alarms[:2] == [
        ("1/10 = 6 is above its high of 5", Level.WARNING),
        ("1/10 is back at 4, was above its high of 5", Level.NOTICE),
    ]


@pytest.mark.asyncio
async def test_a_watch_that_ends_too_early_says_why_nothing_was_asked_but_not_of_a_noisy_line(
    capfd: pytest.CaptureFixture[str],
) -> None:
    line = Line(hcp2.PROFILE.line, [])
    async with Bus(MemoryPort(line)) as bus:
        watch = Watch(bus, "test", View())
        watch.summarise()
        assert "no request was sent: a new line first waits" in capfd.readouterr().err
        bus._pump.data_received(b"?")
        watch.summarise()
        assert "no request was sent" not in capfd.readouterr().err


@pytest.mark.asyncio
async def test_what_the_uart_found_wrong_ends_the_summary_if_there_was_anything(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = DriverErrors(0, 0, 0, 0, 0)
    async with Bus(MemoryPort(Line(hcp2.PROFILE.line, []))) as bus:
        monkeypatch.setattr(bus._pump, "driver_errors", lambda: found)
        watch = Watch(bus, "test", View())
        watch.summarise()
        assert "uart" not in capfd.readouterr().err
        found = DriverErrors(framing=12, parity=0, breaks=1, overruns=0, buffer_overruns=2)
        watch.summarise()
        assert capfd.readouterr().err.splitlines()[-1] == (
            "busmaster: uart: 12 framing errors, 1 break, 2 bytes lost in the driver; run `busmaster doctor` for advice"
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
        assert "busmaster: node 1: learned windows: Read 5.26 ms" in capfd.readouterr().err.splitlines()
