"""What systemd wants of a service, as its environment says it."""

from __future__ import annotations

import asyncio
import os
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from busmaster import Health, LineState
from busmaster.app.cli.systemd import Movement, ServiceManager
from busmaster.testing.virtual_time import run_in_virtual_time
from tests.patience import PATIENCE


@pytest.mark.parametrize(
    ("environment", "interval"),
    [
        ({"NOTIFY_SOCKET": "@nobody", "WATCHDOG_USEC": "400000"}, 0.4),
        ({"NOTIFY_SOCKET": "@nobody", "WATCHDOG_USEC": "400000", "WATCHDOG_PID": str(os.getpid())}, 0.4),
        ({"NOTIFY_SOCKET": "@nobody", "WATCHDOG_USEC": "400000", "WATCHDOG_PID": str(os.getppid())}, 0.0),
        ({"NOTIFY_SOCKET": "@nobody", "WATCHDOG_USEC": "soon"}, 0.0),
        ({"NOTIFY_SOCKET": "@nobody"}, 0.0),
        ({"WATCHDOG_USEC": "400000"}, 0.0),
    ],
)
def test_a_sign_of_life_is_wanted_of_the_process_that_is_named(environment: dict[str, str], interval: float) -> None:
    manager = ServiceManager(environment)
    manager.ready()  # nobody listens, which is no error
    manager.close()
    assert manager.interval == interval


# whether the line works


class Line:
    """A line with its exchanges so far, its poll groups, its nodes and its state."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.time = 100.0
        self.exchanges = 0
        self.state = LineState.READY
        self.groups = [group(1.0)]
        self.nodes = [node(Health.UP)]
        statistics = "busmaster.app.cli.systemd.ext.line_statistics"
        monkeypatch.setattr(statistics, lambda bus: SimpleNamespace(exchanges=bus.exchanges))

    def now(self) -> float:
        return self.time


def group(period: float, *, points: int = 1, paused: bool = False) -> SimpleNamespace:
    return SimpleNamespace(period=period, points=(None,) * points, paused=paused)


def node(health: Health, *, suspended: bool = False) -> SimpleNamespace:
    return SimpleNamespace(health=health, suspended=suspended)


@pytest.fixture
def line(monkeypatch: pytest.MonkeyPatch) -> Any:
    return Line(monkeypatch)


def goes_on_after(movement: Movement, line: Any, seconds: float, patience: float = 3.0) -> bool:
    line.time += seconds
    return movement.goes_on(patience)


def test_a_line_that_stands_still_is_noticed_after_the_time_of_the_manager(line: Any) -> None:
    movement = Movement(line)
    assert goes_on_after(movement, line, 10.0)  # the time counts from the first look
    assert goes_on_after(movement, line, 2.9)
    assert not goes_on_after(movement, line, 0.2)
    line.exchanges += 1
    assert goes_on_after(movement, line, 10.0)
    assert goes_on_after(movement, line, 2.9)
    assert not goes_on_after(movement, line, 0.2)


def test_a_line_with_long_periods_may_stand_still_for_two_of_the_shortest(line: Any) -> None:
    line.groups = [group(60.0), group(5.0)]
    movement = Movement(line)
    assert goes_on_after(movement, line, 0.0)
    assert goes_on_after(movement, line, 9.9)
    assert not goes_on_after(movement, line, 0.2)


@pytest.mark.parametrize(
    ("groups", "nodes", "state", "expected"),
    [
        ([group(1.0)], [node(Health.UP)], LineState.READY, False),
        ([group(1.0), group(1.0, paused=True)], [node(Health.UP)], LineState.READY, False),
        ([group(1.0)], [node(Health.DOWN), node(Health.UP)], LineState.READY, False),
        ([], [node(Health.UP)], LineState.READY, True),
        ([group(1.0, points=0)], [node(Health.UP)], LineState.READY, True),
        ([group(1.0, paused=True)], [node(Health.UP)], LineState.READY, True),
        ([group(1.0)], [node(Health.DOWN)], LineState.READY, True),
        ([group(1.0)], [node(Health.UP, suspended=True), node(Health.DOWN)], LineState.READY, True),
        ([group(1.0)], [], LineState.READY, True),
        ([group(1.0)], [node(Health.UP)], LineState.OFFLINE, True),
    ],
)
def test_a_line_on_which_nothing_is_due_may_stand_still(
    line: Any, groups: list[Any], nodes: list[Any], state: LineState, expected: bool
) -> None:
    movement = Movement(line)
    movement.goes_on(3.0)
    line.groups, line.nodes, line.state = groups, nodes, state
    assert goes_on_after(movement, line, 10.0) is expected
    # the time counts anew once something is due again
    line.groups, line.nodes, line.state = [group(1.0)], [node(Health.UP)], LineState.READY
    assert goes_on_after(movement, line, 1.0) is expected


# messages


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(PATIENCE)
        yield manager


def test_each_state_is_one_message_and_nothing_is_sent_after_the_end(manager: socket.socket) -> None:
    service = ServiceManager({"NOTIFY_SOCKET": manager.getsockname()})
    before = time.monotonic_ns() // 1000
    service.reloading()
    service.ready()
    service.stopping()
    reloading, moment = manager.recv(100).decode().split("\nMONOTONIC_USEC=")
    assert reloading == "RELOADING=1"
    assert before <= int(moment) <= time.monotonic_ns() // 1000
    assert [manager.recv(100) for _ in range(2)] == [b"READY=1", b"STOPPING=1"]
    service.close()
    service.ready()
    service.close()
    manager.setblocking(False)
    with pytest.raises(BlockingIOError):
        manager.recv(100)


def test_an_abstract_address_is_reached() -> None:
    name = f"busmaster-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(f"\0{name}")
        manager.settimeout(PATIENCE)
        service = ServiceManager({"NOTIFY_SOCKET": f"@{name}"})
        service.ready()
        assert manager.recv(100) == b"READY=1"
        service.close()


def test_a_manager_that_does_not_read_holds_up_nothing(manager: socket.socket) -> None:
    service = ServiceManager({"NOTIFY_SOCKET": manager.getsockname()})
    assert service._socket is not None
    assert not service._socket.getblocking()
    for _ in range(2000):  # far more than fit into the queue of a socket
        service.ready()
    service.close()


def show_life(manager: socket.socket, line: Any, micros: int, seconds: float) -> int:
    """How many signs of life are sent in some seconds of virtual time."""
    service = ServiceManager({"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": str(micros)})
    manager.setblocking(False)
    received = 0

    async def run() -> None:
        nonlocal received
        loop = asyncio.get_running_loop()
        line.now = loop.time
        with anyio.move_on_after(seconds):
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(service.show_life, line)
                while True:
                    with suppress(BlockingIOError):
                        while manager.recv(100) == b"WATCHDOG=1":
                            received += 1
                    await anyio.sleep(0.05)

    run_in_virtual_time(run())
    service.close()
    return received


def test_a_sign_of_life_is_given_twice_an_interval_while_the_line_works(manager: socket.socket, line: Any) -> None:
    line.groups = []
    assert 10 <= show_life(manager, line, 2_000_000, 10.0) <= 11


def test_very_short_intervals_cost_ten_signs_of_life_a_second(manager: socket.socket, line: Any) -> None:
    line.groups = []
    assert 90 <= show_life(manager, line, 1000, 10.0) <= 101


def test_no_sign_of_life_is_given_when_the_line_stands_still(manager: socket.socket, line: Any) -> None:
    assert 2 <= show_life(manager, line, 2_000_000, 10.0) <= 3
    assert show_life(manager, line, 0, 10.0) == 0
