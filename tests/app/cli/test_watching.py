"""What is told of a bus that is polled: on standard error, in lines, and at the end."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import anyio
import pytest

from busmaster import Health, LineState
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
from busmaster.events import AlarmChanged, LineChange, LineChanged, NodeChanged, PortFailed, RepliesLate
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


# which events are reported, and how much they matter


def changed(node: str, after: Health) -> NodeChanged:
    record: Any = SimpleNamespace(label=node)
    return NodeChanged(record, Health.UNKNOWN, after, returning=False)


RECORD: Any = SimpleNamespace(label="node 1")
POINT: Any = None
DOWN, UP, NOISY, QUIET = (LineChanged(LineChange[name]) for name in ("DOWN", "UP", "NOISY", "QUIET"))
FAILED = PortFailed("it is not there")


@pytest.mark.parametrize(
    "events",
    [
        [(UP, None), (DOWN, Level.ERROR), (DOWN, None), (UP, Level.NOTICE), (UP, None), (DOWN, Level.ERROR)],
        [(FAILED, Level.ERROR), (FAILED, Level.ERROR), (DOWN, None), (UP, Level.NOTICE), (UP, None)],
        [(NOISY, Level.ERROR), (NOISY, None), (QUIET, Level.NOTICE), (QUIET, None)],
        [
            (changed("a", Health.UP), None),
            (changed("a", Health.DOWN), Level.WARNING),
            (changed("a", Health.DOWN), None),
            (changed("b", Health.DOWN), Level.WARNING),
            (changed("a", Health.SUSPECT), None),
            (changed("a", Health.UP), Level.NOTICE),
            (changed("b", Health.UP), Level.NOTICE),
            (changed("b", Health.UP), None),
        ],
        [(DOWN, Level.ERROR), (changed("a", Health.DOWN), Level.WARNING), (UP, Level.NOTICE)],
        [
            (AlarmChanged(POINT, "high", 5.0, 6.0, active=True), Level.WARNING),
            (AlarmChanged(POINT, "high", 5.0, 4.0, active=False), Level.NOTICE),
            (RepliesLate(RECORD, 0.2, 0.1), Level.WARNING),
            (RepliesLate(RECORD, 0.2, 0.1), Level.WARNING),
        ],
    ],
)
def test_the_begin_and_the_end_of_each_fault_are_reported_once(events: list[tuple[Any, Level | None]]) -> None:
    bus: Any = SimpleNamespace(now=lambda: 0.0, events=lambda: None)
    authorisation: Any = SimpleNamespace()
    watch = Watch(bus, "test", View(), authorisation=authorisation)
    assert [(event, watch._level(event)) for event, _ in events] == events


@pytest.mark.parametrize(
    ("of_file", "advice"),
    [(False, "try --timeout 300"), (True, "set timing = { window = 0.3 } in its section of the file")],
)
@pytest.mark.asyncio
async def test_a_late_reply_is_reported_with_what_the_user_can_change(
    monkeypatch: pytest.MonkeyPatch, of_file: bool, advice: str
) -> None:
    said: list[str] = []
    monkeypatch.setattr(watching, "note", lambda line, level: said.append(line))

    async def events() -> AsyncIterator[Any]:
        yield RepliesLate(RECORD, 0.19, 0.1)
        yield changed("a", Health.SUSPECT)

    bus: Any = SimpleNamespace(now=lambda: 0.0, events=events)
    authorisation: Any = SimpleNamespace()
    await Watch(bus, "test", View(), authorisation=authorisation, of_file=of_file).listen()
    assert said == [f"node 1: late reply, 190 ms after the request; {advice}"]


# the summary


@pytest.mark.parametrize(
    ("losses", "lost", "text"),
    [
        (0, False, ""),
        (1, False, "line: 1 disconnect, offline for 2.5 s"),
        (2, True, "line: 2 disconnects, offline for 2.5 s; still offline: it hung up"),
        (0, True, "line: never connected, offline for 2.5 s; still offline: it hung up"),
    ],
)
def test_how_often_and_for_how_long_the_line_was_lost(
    monkeypatch: pytest.MonkeyPatch, losses: int, lost: bool, text: str
) -> None:
    monkeypatch.setattr("busmaster.app.cli.watching.ext.line_statistics", lambda _: SimpleNamespace(losses=losses))
    monkeypatch.setattr("busmaster.app.cli.watching.ext.lost_seconds", lambda _: 2.5)
    bus: Any = SimpleNamespace(condition=SimpleNamespace(is_lost=lost, reason="it hung up"))
    assert watching.loss_text(bus) == text


def test_the_windows_that_are_trusted_are_named_each() -> None:
    times: Any = [
        SimpleNamespace(kind="Read", packet=False, window=0.005, trusted=True),
        SimpleNamespace(kind="Read", packet=True, window=0.0075, trusted=True),
        SimpleNamespace(kind="Write", packet=False, window=0.006, trusted=False),
    ]
    assert watching.learned_text(times) == "learned windows: Read 5.00 ms, Read (packet) 7.50 ms"
    assert watching.learned_text(times[2:]) == ""


def test_the_summary_has_a_line_for_each_group_and_each_node(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    counts = SimpleNamespace(exchanges=1, unexpected_bytes=0, utilisation=0.421, damaged=0, breaks=0, driver=None)
    monkeypatch.setattr("busmaster.app.cli.watching.ext.line_statistics", lambda _: counts)
    monkeypatch.setattr(watching, "loss_text", lambda _: "line: 1 disconnect")

    def group(name: str, bad: int, periods: list[float]) -> Any:
        seen = SimpleNamespace(cycles=9, missed=2, good=4, late=3, stale=2, bad=bad, achieved=0.0205)
        return SimpleNamespace(name=name, statistics=lambda: seen, recent_periods=periods)

    def node(label: str, ok: int) -> Any:
        latency, learned = (
            SimpleNamespace(p50=0.0031, p99=0.0042),
            [SimpleNamespace(kind="Read", packet=False, window=0.005, trusted=True)],
        )
        seen = SimpleNamespace(attempts=7, fruitless=3, ok=ok, latency=latency, learned=learned)
        return SimpleNamespace(label=label, statistics=lambda: seen)

    bus: Any = SimpleNamespace(
        now=lambda: 0.0, events=lambda: None, state=LineState.READY, nodes=[node("node 1", 4), node("node 2", 0)]
    )
    authorisation: Any = SimpleNamespace()
    watch = Watch(bus, "test", View(), authorisation=authorisation)
    watch.groups = [group("fast", 1, [0.02, 0.021]), group("slow", 0, [])]
    levels: list[Level] = []
    with monkeypatch.context() as patched:
        patched.setattr(watching, "note", lambda text, level=Level.INFO: levels.append(level))
        watch.summarise()
    assert levels == [Level.WARNING, *[Level.INFO] * 6]  # a loss of the line is no matter of course
    watch.summarise()
    fast = "9 cycles, 2 missed, 1 of 10 values not read, period 20.50 ms mean, 21.00 ms p99, line 42.1% busy"
    assert capfd.readouterr().err.splitlines() == [
        "busmaster: line: 1 disconnect",
        f"busmaster: fast: {fast}",
        "busmaster: slow: 9 cycles, 2 missed, line 42.1% busy",
        "busmaster: node 1: 7 requests, 3 failed, p50 3.10 ms, p99 4.20 ms",
        "busmaster: node 2: 7 requests, 3 failed",
        "busmaster: node 1: learned windows: Read 5.00 ms",
        "busmaster: node 2: learned windows: Read 5.00 ms",
    ]


# the groups that are shown


def test_groups_are_replaced_in_the_order_of_the_new_ones_and_those_that_stay_go_on() -> None:
    bus: Any = SimpleNamespace(now=lambda: 0.0, events=lambda: None)
    authorisation: Any = SimpleNamespace()
    begun: list[Any] = []
    watch = Watch(bus, "test", View(plain=True), authorisation=authorisation)
    tasks: Any = SimpleNamespace(start_soon=lambda _, watch, group: begun.append(group))
    a, b, c, d = groups = [cast("Any", SimpleNamespace(name=name)) for name in "abcd"]
    watch.add(a)
    watch.add(b)
    assert begun == []
    watch.show_groups(tasks)
    watch.add(c)
    assert begun == [a, b, c]
    watch.replace_groups([d, c, a])
    assert watch.groups == [d, c, a]
    assert begun == groups
    silent = Watch(bus, "test", View(silent=True), authorisation=authorisation)
    silent.add(a)
    silent.show_groups(tasks)
    assert begun == groups


@pytest.mark.parametrize("read_only", [False, True])
def test_the_keys_of_a_view_that_is_read_only_write_nothing(read_only: bool) -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line, [])))
    assert Watch(bus, "test", View(read_only=read_only)).authorisation.read_only is read_only
