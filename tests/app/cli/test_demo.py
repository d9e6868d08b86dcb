"""`busmaster demo`: its options, what it polls and commands, and the process of its line."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import anyio
import click
import pytest

from busmaster.app.cli import demo, demo_line
from busmaster.app.cli.arguments import View
from busmaster.app.cli.demo import (
    COMMAND_EVERY,
    MOST_TAKEN,
    PERIOD,
    SPEEDS,
    attempt,
    command_drives,
    devices,
    emulated_line,
)
from busmaster.app.cli.demo_line import DRIVES, LOSES_ITS_WIRE, SETTINGS, input_ended, make_line, plug_in, unplug
from busmaster.app.cli.watching import Watch
from busmaster.bus.bus import Bus
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import LineDown, NoReply
from busmaster.protocols.hcp2.microflex_handle import MicroFlexDrive
from busmaster.testing.virtual_time import run_in_virtual_time
from tests.app.cli.conftest import Command


@pytest.mark.parametrize(
    ("options", "view"),
    [
        ((), View()),
        (("--seconds", "2.5"), View(seconds=2.5)),
        (("--plain",), View(plain=True)),
    ],
)
def test_options_of_the_view_reach_it(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], view: View
) -> None:
    seen: list[tuple[str, View]] = []

    async def shown(path: str, view: View) -> int:
        seen.append((path, view))
        return 0

    @contextmanager
    def line() -> Iterator[str]:
        yield "/dev/pts/9"

    monkeypatch.setattr(demo, "demo", shown)
    monkeypatch.setattr(demo, "emulated_line", line)
    assert busmaster("demo", *options).status == 0
    assert seen == [("/dev/pts/9", view)]


def test_where_all_terminals_are_taken_it_ends_with_the_error(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    open_lines: list[int] = []

    async def taken(path: str, view: View) -> int:
        raise LineDown(f"{path} is in use", hint="stop it")

    @contextmanager
    def line() -> Iterator[str]:
        open_lines.append(len(open_lines))
        yield f"/dev/pts/{len(open_lines)}"
        open_lines.pop()

    monkeypatch.setattr(demo, "demo", taken)
    monkeypatch.setattr(demo, "emulated_line", line)
    ran = busmaster("demo")
    assert (ran.status, ran.err) == (1, f"busmaster: /dev/pts/{MOST_TAKEN} is in use; stop it\n")


class Process:
    """The process of the line, which prints this path."""

    def __init__(self, path: str) -> None:
        self.stdin, self.stdout = io.StringIO(), io.StringIO(path)
        self.done: list[str] = []

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        self.done.append("left")

    def wait(self) -> None:
        assert self.stdin.closed, "else it would never end"
        self.done.append("waited")


@pytest.mark.parametrize("path", ["/dev/pts/9\n", ""])
def test_the_process_of_the_line_is_ended_and_waited_for_and_survives_ctrl_c_of_the_terminal(
    monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    process, started = Process(path), list[dict[str, Any]]()

    def start(command: list[str], **options: Any) -> Process:
        started.append({"command": command, **options})
        return process

    monkeypatch.setattr(subprocess, "Popen", start)
    if path:
        with emulated_line() as found:
            assert found == "/dev/pts/9"
            assert process.done == []
    else:
        with pytest.raises(click.ClickException, match="the emulated line did not start"), emulated_line():
            pass
    assert process.done == ["waited", "left"]
    assert started == [
        {
            "command": [sys.executable, "-m", "busmaster.app.cli.demo_line"],
            "stdin": subprocess.PIPE,
            "stdout": subprocess.PIPE,
            "start_new_session": True,
            "text": True,
        }
    ]


def test_position_velocity_speed_and_torque_are_polled() -> None:
    bus = Bus(MemoryPort(make_line()))
    drives, points = devices(bus)
    assert [drive.node.address for drive in drives] == [4, 5, 6, 7, 8]
    assert [point.key for point in points] == [
        *(f"{node}/axis0.{item}" for node in (1, 2, 3) for item in ("position", "velocity")),
        *(f"{node}/{item}" for node in (4, 5, 6, 7, 8) for item in ("speed_measured", "torque_demand")),
    ]


def test_the_line_is_polled_under_the_name_of_the_demo_while_its_drives_are_commanded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ports: list[tuple[str, int]] = []
    commanded: list[tuple[object, list[int]]] = []

    def port(path: str, *, baudrate: int) -> MemoryPort:
        ports.append((path, baudrate))
        return MemoryPort(make_line())

    async def command(watch: Watch, drives: list[MicroFlexDrive]) -> None:
        commanded.append((watch, [drive.node.address for drive in drives]))

    async def follow(watch: Watch, beside: Any) -> int:
        await beside()
        [group] = watch.groups
        assert (watch.title, watch.view, group.name, group.period) == ("busmaster demo", view, "drives", PERIOD)
        assert len(group.points) == 16
        assert commanded == [(watch, list(DRIVES))]
        return 7

    monkeypatch.setattr(demo, "SerialPort", port)
    monkeypatch.setattr(demo, "follow", follow)
    monkeypatch.setattr(demo, "command_drives", command)
    view = View(seconds=2.5, plain=True)
    assert run_in_virtual_time(demo.demo("/dev/pts/9", view)) == 7
    assert ports == [("/dev/pts/9", SETTINGS.baudrate)]


def test_the_first_terminal_that_is_not_taken_is_used(busmaster: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    paths: list[str] = []
    given_back: list[str] = []

    async def shown(path: str, view: View) -> int:
        if path != "/dev/pts/3":
            raise LineDown(f"{path} is in use")
        assert given_back == [], "else the next one would be the same"
        return 0

    @contextmanager
    def line() -> Iterator[str]:
        paths.append(f"/dev/pts/{len(paths) + 1}")
        path = paths[-1]
        yield path
        given_back.append(path)

    monkeypatch.setattr(demo, "demo", shown)
    monkeypatch.setattr(demo, "emulated_line", line)
    ran = busmaster("demo")
    assert (ran.status, ran.err) == (0, "")
    assert sorted(given_back) == paths == ["/dev/pts/1", "/dev/pts/2", "/dev/pts/3"]


class Watched:
    """The calls of the view."""

    def __init__(self) -> None:
        self.shown: list[str] = []

    def show(self, text: str) -> None:
        self.shown.append(text)


def test_drives_are_enabled_with_a_speed_and_get_others_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    orders: list[Any] = []
    waited: list[float] = []

    class Enough(Exception):
        """So many commands."""

    def drive(number: int) -> Any:
        async def enable() -> None:
            orders.append((number, "enable"))

        async def set_speed_reference(percent: float) -> None:
            if (number, len(waited)) == (7, 4):
                raise NoReply("no reply within 100 ms")
            orders.append((number, percent))

        node = SimpleNamespace(label=f"node {number}")
        return SimpleNamespace(enable=enable, set_speed_reference=set_speed_reference, node=node)

    async def sleep(seconds: float) -> None:
        waited.append(seconds)
        if len(waited) > 6:
            raise Enough

    monkeypatch.setattr(anyio, "sleep", sleep)
    watch: Any = Watched()
    with pytest.raises(Enough):
        anyio.run(command_drives, watch, [drive(number) for number in DRIVES])
    first = [(number, order) for number, speed in zip(DRIVES, SPEEDS, strict=False) for order in ("enable", speed)]
    assert orders == [*first, (4, -15.0), (5, 40.0), (6, 25.0), (8, 60.0), (4, 0.0)]
    assert waited == [COMMAND_EVERY] * 7
    assert watch.shown == [
        "node 4: speed reference -15 %",
        "node 5: speed reference 40 %",
        "node 6: speed reference 25 %",
        "node 7: no reply within 100 ms",
        "node 8: speed reference 60 %",
        "node 4: speed reference 0 %",
    ]


def test_a_command_that_fails_is_shown_and_known_to_have_failed() -> None:
    watch: Any = Watched()

    async def order(*values: float) -> None:
        if values != (5.0, 6.0):
            raise NoReply("no reply within 100 ms")

    drive: Any = SimpleNamespace(node=SimpleNamespace(label="node 4"))
    assert anyio.run(attempt, watch, drive, order, 5.0, 6.0) is True
    assert anyio.run(attempt, watch, drive, order, 5.0) is False
    assert watch.shown == ["node 4: no reply within 100 ms"]


# the process of the line


def test_only_the_end_of_the_input_ends_the_line(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = os.pipe()
    with open(reader, encoding="utf-8") as file:
        monkeypatch.setattr(sys, "stdin", file)
        assert not input_ended(0.001), "nothing came"
        os.write(writer, b"x")
        assert not input_ended(0.001)
        os.close(writer)
        assert input_ended(0.001)


def test_one_drive_loses_its_wire_and_gets_it_back() -> None:
    """Only that one."""
    line = make_line()

    async def story() -> None:
        bus = Bus(MemoryPort(line), seed=1)
        server: Any = SimpleNamespace(call=lambda function: function(line, bus.now()))
        drives, _ = devices(bus)

        async def silent() -> list[int]:
            found = []
            for drive in drives:
                try:
                    await drive.speed_measured.read()
                except NoReply:
                    found.append(drive.node.address)
            return found

        async with bus:
            assert await silent() == []
            unplug(server, LOSES_ITS_WIRE)
            assert await silent() == [LOSES_ITS_WIRE]
            plug_in(server)
            assert await silent() == []

    run_in_virtual_time(story())


def test_the_line_ends_while_a_wire_is_cut_without_fixing_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    done: list[str] = []

    @contextmanager
    def serve(_: object) -> Iterator[Any]:
        yield SimpleNamespace(path="/dev/pts/9")
        done.append("closed")

    ends = iter((False, True))
    monkeypatch.setattr(demo_line, "serve_pty", serve)
    monkeypatch.setattr(demo_line, "input_ended", lambda within: next(ends))
    monkeypatch.setattr(demo_line, "unplug", lambda server, address: done.append("cut"))
    monkeypatch.setattr(demo_line, "plug_in", lambda server: done.append("fixed"))
    demo_line.main()
    assert done == ["cut", "closed"]
    assert capsys.readouterr().out == "/dev/pts/9\n"


def test_drives_move_a_little_and_reply_after_some_milliseconds() -> None:
    first, second = make_line(), make_line()
    assert first.chance.random() == second.chance.random(), "the same each time"
    assert {(device.delay.low, device.delay.high) for device in first.devices} == {(0.001, 0.004)}
