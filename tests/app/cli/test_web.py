"""`busmaster web` as a process: it opens, waits, is killed and comes back, beside a line that goes on."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2 as httpx
import pytest

from tests.app.cli.conftest import Command, owner, started
from tests.patience import PATIENCE

HERE = ("--bind", "127.0.0.1:0")


def until_said(process: subprocess.Popen[str], text: str) -> str:
    """Read what it says on standard error up to the line that has this text, and return that."""
    assert process.stderr is not None
    while text not in (line := process.stderr.readline()):
        assert line, "it ended"
    return line


@contextlib.contextmanager
def web(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], httpx.Client]]:
    """A process with its page, and what asks it."""
    with started("web", *HERE, *arguments) as process:
        try:
            url = until_said(process, "the page is at").partition("the page is at ")[2].strip()
            with httpx.Client(base_url=url, timeout=PATIENCE, trust_env=False) as client:
                yield process, client
        finally:
            process.kill()
            process.communicate(timeout=PATIENCE)


def points(client: httpx.Client) -> Any:
    return client.get("/api/points").json()


@pytest.mark.slow
def test_it_is_killed_and_started_again_and_the_line_goes_on(file: Path) -> None:
    with owner("serve", str(file)) as (process, address):
        for _ in range(3):
            with web(address) as (interface, client):
                until_said(interface, "connected to line")
                said = client.get("/api/line").json()
                assert (said["connected"], said["read_only"]) == (True, False)
        assert process.poll() is None


@pytest.mark.slow
def test_it_opens_before_its_line_is_there_and_goes_on_when_that_is_killed(file: Path) -> None:
    with web(str(file)) as (interface, client):
        assert not client.get("/api/line").json()["connected"]
        for _ in range(2):
            with owner("serve", str(file)) as (process, _):
                until_said(interface, "connected to line")
                assert client.get("/api/line").json()["connected"]
                process.kill()
                until_said(interface, "was lost")


@pytest.mark.slow
def test_sigterm_ends_it_while_a_page_looks(file: Path) -> None:
    with owner("serve", str(file)) as (_, address), web(address) as (interface, client):
        until_said(interface, "connected to line")
        port = client.base_url.port
        assert port is not None
        request = (
            f"GET /api/stream HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
        )
        with socket.create_connection(("127.0.0.1", port)) as page:
            page.sendall(request.encode())
            assert page.recv(100).startswith(b"HTTP/1.1 101")
            interface.send_signal(signal.SIGTERM)
            assert interface.wait(PATIENCE) == 128 + signal.SIGTERM


def test_what_is_mistyped_is_one_line(busmaster: Command, tmp_path: Path) -> None:
    ran = busmaster("web", "slitter", "--bind", "8420")
    assert (ran.status, "HOST:PORT" in ran.err) == (2, True)
    tokens = tmp_path / "tokens"
    tokens.write_text("hmi 0123456789abcdef\n")
    tokens.chmod(0o644)
    ran = busmaster("web", "slitter", "--token-file", str(tokens))
    assert (ran.status, "other users can read" in ran.err) == (2, True)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        ran = busmaster("web", "slitter", "--bind", f"127.0.0.1:{taken.getsockname()[1]}")
        assert (ran.status, "is in use by another program" in ran.err) == (2, True)
