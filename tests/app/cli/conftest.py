"""Commands run in this process, on lines served by threads of it; and, where it matters, as processes."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import random
import re
import signal
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from busmaster import Service
from busmaster.app.cli import main
from busmaster.app.cli.run import secrets_of, served, service_of
from busmaster.app.config import load
from busmaster.app.line import ConfiguredLine
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer, serve_tcp
from busmaster.registry import find, make_device
from tests.patience import PATIENCE

ROOT = Path(__file__).parents[3]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error", "PYTHONUNBUFFERED": ""}


@dataclass(frozen=True, slots=True)
class Outcome:
    status: int
    out: str
    err: str

    @property
    def lines(self) -> list[str]:
        return self.out.splitlines()


Command = Callable[..., Outcome]


@pytest.fixture
def busmaster(capfd: pytest.CaptureFixture[str]) -> Iterator[Command]:
    """Run a command line in this process: what it printed, and its exit status."""
    handlers, show = list(logging.getLogger().handlers), warnings.showwarning

    def run(*arguments: str) -> Outcome:
        status = main(arguments)
        return Outcome(status, *capfd.readouterr())

    yield run
    logging.getLogger().handlers[:] = handlers
    warnings.showwarning = show


def without_time(line: str) -> dict[str, Any]:
    """A line of JSON, but for the time that it carries, which is one of today's in UTC."""
    fields: dict[str, Any] = json.loads(line)
    assert abs(datetime.now(UTC) - datetime.fromisoformat(fields.pop("time"))).days == 0
    return fields


def serve(protocol: str, *addresses: int) -> TcpServer:
    devices = [make_device(protocol, address) for address in addresses]
    return serve_tcp(Line(find(protocol).profile.line, devices, chance=random.Random(1), paced=False))


@pytest.fixture(scope="module")
def controllers() -> Iterator[TcpServer]:
    """Mint controllers 1 to 8."""
    with serve("hcp2", *range(1, 9)) as server:
        yield server


def ended_once(seen: Callable[[list[str]], bool], *arguments: str, cwd: Path = ROOT) -> Outcome:
    """What a command printed as a process of its own that Ctrl-C ended, once `seen` was satisfied with its lines."""
    with started(*arguments, cwd=cwd) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        lines: list[str] = []
        for line in process.stdout:
            lines.append(line)
            if seen(lines):
                break
        process.send_signal(signal.SIGINT)
        out, err = "".join(lines) + process.stdout.read(), process.stderr.read()
    return Outcome(process.returncode, out, err)


def started(*arguments: str, cwd: Path = ROOT) -> subprocess.Popen[str]:
    """A command as a process of its own, in a session of its own: Ctrl-C reaches it alone."""
    return subprocess.Popen(
        [sys.executable, "-m", "busmaster", *arguments],
        cwd=cwd,
        env=ENVIRONMENT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


# a line that one process owns and others use

SLITTER = """
title = "Slitter"
port = "PORT?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 1
timing = { window = 0.3 }
points.force = { item = "10", unit = "N", factor = 0.1, maximum = 50 }
[groups.fast]
period = 0.02
points = ["winder/force"]
[outputs.sqlite]
path = "FOLDER/line.sqlite"
"""
"""The window is for a busy machine: the emulated controllers answer from a thread of the test's own process."""


@pytest.fixture
def three_controllers() -> Iterator[TcpServer]:
    """Mint controllers 1 to 3, for one test alone: its process is the only one that is to connect."""
    with serve("hcp2", 1, 2, 3) as server:
        yield server


@pytest.fixture
def file(tmp_path: Path, three_controllers: TcpServer) -> Path:
    """The file of their line, SLITTER."""
    path = tmp_path / "slitter.toml"
    path.write_text(SLITTER.replace("PORT", three_controllers.path).replace("FOLDER", str(tmp_path)))
    return path


@contextmanager
def owner(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A process that serves a line, and its address; ended as a service is."""
    with started(*arguments) as process:
        assert process.stderr is not None
        try:
            said = ""
            while not (found := re.search(r"is served at (unix:\S+)", said)):
                said = process.stderr.readline()
                assert said, "it ended"
                assert "no other program can use this line" not in said, said
            yield process, found[1]
        finally:
            process.terminate()
            process.communicate(timeout=PATIENCE)


@contextmanager
def owner_here(path: Path, **options: Any) -> Iterator[Service]:
    """Serve the line of a file from a thread of this process, and yield its service: quicker than `owner`."""
    ready: Future[tuple[Service, asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def serve_line() -> None:
        try:
            line = ConfiguredLine(load(path), **options)
            line.authorisation.take_secrets(secrets_of(line.file))
            ended = asyncio.Event()
            async with line, served(service_of(line), announce=False) as service:
                assert service is not None
                ready.set_result((service, asyncio.get_running_loop(), ended))
                await ended.wait()
                for _ in range(10):  # a connection that was only accepted so far is taken, and closed
                    await asyncio.sleep(0)
        except BaseException as error:
            if ready.done():
                raise
            ready.set_exception(error)

    thread = threading.Thread(target=lambda: asyncio.run(serve_line()))
    thread.start()
    try:
        service, loop, ended = ready.result(PATIENCE)
        try:
            yield service
        finally:
            loop.call_soon_threadsafe(ended.set)
    finally:
        thread.join()
