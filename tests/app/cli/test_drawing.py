"""The view of a line that this process owns: how its end is understood, and the terminal given back."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from typing import Any

import anyio
import pytest

from busmaster import Bus, Hcp2Controller, MemoryPort
from busmaster.app.cli import drawing
from busmaster.app.cli.drawing import LEAVE_SCREEN, draw, end_view, restore_terminal, served_here, terminal_state
from busmaster.app.service.authorisation import Authorisation
from busmaster.emulator.line import Line
from tests.patience import PATIENCE


class Process:
    """A view that ends with this status, when it is waited for or terminated."""

    def __init__(self, status: int, *, deaf: bool = False) -> None:
        self.status, self.deaf = status, deaf
        self.returncode: int | None = None
        self.done: list[str] = []

    def wait(self, timeout: float | None = None) -> int:
        if self.deaf and "kill" not in self.done:
            assert timeout is not None, "it would wait for ever"
            raise subprocess.TimeoutExpired("top", timeout)
        self.returncode = self.status
        return self.status

    def terminate(self) -> None:
        self.done.append("terminate")

    def kill(self) -> None:
        self.done.append("kill")


@pytest.mark.parametrize(
    ("status", "result", "restored"),
    [(0, 0, False), (130, 130, False), (1, 1, False), (2, 1, False), (-signal.SIGKILL, 1, True)],
)
def test_only_a_person_ends_it_well_and_a_view_that_was_killed_does_not_keep_the_terminal(
    monkeypatch: pytest.MonkeyPatch, status: int, result: int, restored: bool
) -> None:
    commands: list[list[str]] = []
    given_back: list[object] = []

    def start(command: list[str]) -> Process:
        commands.append(command)
        return Process(status)

    monkeypatch.setattr(subprocess, "Popen", start)
    monkeypatch.setattr(drawing, "terminal_state", lambda: ["as before"])
    monkeypatch.setattr(drawing, "restore_terminal", given_back.append)
    assert anyio.run(draw, "unix:/a") == result
    assert given_back == [["as before"]] * restored
    assert commands == [[sys.executable, "-m", "busmaster", "top", "unix:/a", "--of-owner"]]


def test_a_view_that_does_not_end_is_killed() -> None:
    prompt, deaf = Process(0), Process(-9, deaf=True)
    end_view(prompt)  # type: ignore[arg-type]  # a stand-in
    end_view(deaf)  # type: ignore[arg-type]  # a stand-in
    assert prompt.done == ["terminate"]
    assert deaf.done == ["terminate", "kill"]
    assert deaf.returncode == -9


@pytest.mark.asyncio
async def test_a_view_that_is_cancelled_is_ended_before_the_terminal_is_given_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Running(Process):
        """A view that runs until it is terminated."""

        def __init__(self) -> None:
            super().__init__(-signal.SIGTERM)
            self.ended = threading.Event()

        def wait(self, timeout: float | None = None) -> int:
            self.ended.wait(PATIENCE)
            return super().wait()

        def terminate(self) -> None:
            super().terminate()
            self.ended.set()

    view = Running()
    given_back: list[object] = []
    monkeypatch.setattr(subprocess, "Popen", lambda command: view)
    monkeypatch.setattr(drawing, "terminal_state", lambda: ["as before"])
    monkeypatch.setattr(drawing, "restore_terminal", lambda before: given_back.append((before, view.done.copy())))
    async with anyio.create_task_group() as group:
        group.start_soon(draw, "unix:/a")
        await anyio.wait_all_tasks_blocked()
        group.cancel_scope.cancel()
    assert given_back == [(["as before"], ["terminate"])]


@pytest.mark.asyncio
async def test_a_view_of_a_line_that_is_not_shared_has_the_title_of_the_file() -> None:
    line = Line(Hcp2Controller.profile.line, [], paced=False)
    async with Bus(MemoryPort(line)) as bus:
        authorisation = Authorisation(bus)
        async with served_here(authorisation, "Slitter 2") as service:
            assert service.line.title == "Slitter 2"
            assert service.line.authorisation is authorisation


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, Any]]:
    """A pseudo-terminal as standard input: its other end, and its file."""
    master, slave = pty.openpty()
    with open(slave, "r+b", buffering=0) as file:
        monkeypatch.setattr(sys, "stdin", file)
        yield master, file
    os.close(master)


def test_a_terminal_gets_its_settings_and_its_page_back(
    terminal: tuple[int, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    master, file = terminal
    monkeypatch.setattr(sys, "stdout", file)  # not in the fixture: pytest sets it again before the test
    before = terminal_state()
    assert before is not None
    changed = termios.tcgetattr(file.fileno())
    changed[3] &= ~(termios.ECHO | termios.ICANON | termios.ISIG)
    termios.tcsetattr(file.fileno(), termios.TCSANOW, changed)
    restore_terminal(before)
    assert termios.tcgetattr(file.fileno()) == before
    os.set_blocking(master, False)
    assert os.read(master, 1000) == LEAVE_SCREEN


def test_a_terminal_that_takes_no_text_gets_its_settings_back_all_the_same(
    terminal: tuple[int, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = terminal_state()
    changed = termios.tcgetattr(terminal[1].fileno())
    changed[3] &= ~(termios.ECHO | termios.ICANON | termios.ISIG)
    termios.tcsetattr(terminal[1].fileno(), termios.TCSANOW, changed)
    with open("/dev/full", "wb", buffering=0) as full:
        monkeypatch.setattr(sys, "stdout", full)
        restore_terminal(before)
        monkeypatch.undo()
    assert termios.tcgetattr(terminal[1].fileno()) == before


def test_without_a_terminal_there_is_no_state_and_nothing_to_give_back(
    terminal: tuple[int, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = terminal_state()
    with open(os.devnull, "r+b", buffering=0) as nowhere:
        monkeypatch.setattr(sys, "stdin", nowhere)
        monkeypatch.setattr(sys, "stdout", nowhere)
        assert terminal_state() is None
        restore_terminal(before)  # it is gone meanwhile: no error
        restore_terminal(None)
    assert terminal_state() is None, "a stream that is closed"
