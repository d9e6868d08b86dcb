"""An interface that an installed package brings is a command like any other; docs/adding-an-interface.md shows it."""

from __future__ import annotations

import asyncio
import importlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from busmaster import connect
from tests.app.cli.conftest import ENVIRONMENT, owner, serve
from tests.app.interfaces.test_following import Remote, connected, row, shown_frame
from tests.docs.pages import ROOT
from tests.patience import PATIENCE

INSTALLED = Path(__file__).parent / "installed"
TEXT = """
title = "Slitter"
port = "PORT?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 1
points.force = { item = "10", unit = "N", minimum = -50, maximum = 50 }
[groups.fast]
period = 0.05
points = ["winder/force"]
"""


def run(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "busmaster", *arguments],
        cwd=ROOT,
        env={**ENVIRONMENT, "PYTHONPATH": str(INSTALLED)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@contextmanager
def interface(*arguments: str) -> Iterator[int]:
    """The interface as a process of its own, and the TCP port at which it listens."""
    process = run("lines", *arguments, "--bind", "127.0.0.1:0")
    assert process.stderr is not None
    try:
        said = ""
        while not (found := re.search(r"listening at (\d+)", said)):
            said = process.stderr.readline()
            assert said, "it ended"
        yield int(found[1])
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE)
        assert process.returncode == 130
    finally:
        process.kill()
        process.communicate()


def requested(port: int, *requests: str) -> list[str]:
    """The replies to requests of one client."""
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as client, client.makefile("rw") as lines:
        replies = []
        for request in requests:
            lines.write(f"{request}\n")
            lines.flush()
            replies.append(lines.readline().rstrip())
        return replies


def test_the_page_shows_the_module_that_is_tested() -> None:
    module = (INSTALLED / "busmaster_lines.py").read_text()
    assert f"```python\n{module}```" in (ROOT / "docs" / "adding-an-interface.md").read_text()


@pytest.mark.asyncio
async def test_no_point_is_unknown_before_the_first_picture_is_complete(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(INSTALLED))
    reply = importlib.import_module("busmaster_lines").reply
    line = connected(Remote())
    assert await reply(line, "winder/10") == "error: the points are not known yet"
    line.picture.frame = shown_frame(points=1)
    assert await reply(line, "winder/10") == "error: the points are not known yet"
    line.picture._rows[0] = [row(value=1.5)]
    assert await reply(line, "winder/10") == "1.5"
    assert await reply(line, "winder/11") == "error: no point 'winder/11'"
    sys.modules.pop("busmaster_lines")


@pytest.fixture
def file(tmp_path: Path) -> Iterator[Path]:
    with serve("hcp2", 1) as server:
        path = tmp_path / "slitter.toml"
        path.write_text(TEXT.replace("PORT", server.path))
        yield path


def eventually(port: int, request: str, expected: str) -> None:
    """Repeat a request until its reply is the expected one. Until then there may be errors, but no other value."""
    while (reply := requested(port, request)[0]) != expected:
        assert reply.startswith("error: "), reply
        time.sleep(0.02)


def test_it_reads_and_writes_a_line_and_outlives_its_owner(file: Path) -> None:
    with owner("serve", str(file)), interface(str(file)) as port:
        eventually(port, "winder/force", "0.0")
        assert requested(port, "winder/force=12.5", "winder/force=60", "winder/farce") == [
            "ok",
            "error: winder: force = 60 N is above its maximum of 50 N",
            "error: no point 'winder/farce'",
        ]
        while requested(port, "winder/force") == [
            "error: there is no current value"
        ]:  # until the next cycle has read what was written
            time.sleep(0.02)
        assert requested(port, "winder/force") == ["12.5"]


def test_a_value_of_a_line_whose_owner_is_gone_is_not_sent(file: Path) -> None:
    with owner("serve", str(file)) as (process, _), interface(str(file)) as port:
        eventually(port, "winder/force", "0.0")
        os.kill(process.pid, signal.SIGKILL)
        process.wait(PATIENCE)
        while not requested(port, "winder/force")[0].startswith("error: "):
            pass


@pytest.mark.slow
def test_a_value_of_a_stopped_owner_or_of_a_paused_group_is_not_sent(file: Path) -> None:
    with owner("serve", str(file)) as (process, address), interface(str(file)) as port:
        eventually(port, "winder/force", "0.0")
        os.kill(process.pid, signal.SIGSTOP)
        while requested(port, "winder/force") != ["error: there is no current value"]:
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGCONT)
        eventually(port, "winder/force", "0.0")
        asyncio.run(paused(address))
        while requested(port, "winder/force") != ["error: there is no current value"]:
            time.sleep(0.02)


async def paused(address: str) -> None:
    async with connect(address) as remote:
        overview = await remote.overview(lambda *_: None)
        await overview.pause("fast", True)


def test_the_help_lists_it_and_says_which_package_is_broken() -> None:
    listed, _ = run("--help").communicate(timeout=PATIENCE)
    assert "Serve a line that another program owns as lines of text." in " ".join(listed.split())
    process = run("absent")
    _, why = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2
    assert "the interface 'absent' of busmaster-lines cannot be used: No module named 'busmaster_absent'" in why


def test_a_command_of_this_package_cannot_be_replaced() -> None:
    shown, _ = run("read", "--help").communicate(timeout=PATIENCE)
    assert "ITEM" in shown
