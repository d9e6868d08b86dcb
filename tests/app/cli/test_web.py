"""`busmaster web` as a process: it opens, waits, is killed and comes back, beside a line that goes on."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx2 as httpx
import pytest

from busmaster.app.outputs.history import HistoryFile
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


@pytest.fixture
def served_with(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the page is served with, instead of serving it."""
    found: dict[str, Any] = {}

    async def serve(followed: Any, listen: Any, secrets: Any, hosts: Any, ready: Any, *rest: Any) -> None:
        found.update(read_only=followed.read_only, listen=listen, secrets=secrets, hosts=hosts, history=rest[1])
        ready("http://here")
        rest[0]("connected to line")

    def following(line: str | None, *, read_only: bool) -> Any:
        found["line"] = line
        return SimpleNamespace(read_only=read_only)

    monkeypatch.setattr("busmaster.app.interfaces.web.serve", serve)
    monkeypatch.setattr("busmaster.app.cli.web.following", following)
    return found


def test_without_options_the_page_is_for_this_machine_and_may_write(
    busmaster: Command, served_with: dict[str, Any]
) -> None:
    ran = busmaster("web")
    assert (ran.status, ran.out) == (0, "")
    assert ran.err == "busmaster: the page is at http://here\nbusmaster: connected to line\n"
    assert served_with == {
        "line": None,
        "read_only": False,
        "listen": ("127.0.0.1", 8420),
        "secrets": {},
        "hosts": (),
        "history": None,
    }


def test_each_option_of_the_page_has_its_effect(
    busmaster: Command, served_with: dict[str, Any], tmp_path: Path
) -> None:
    tokens, history = tmp_path / "tokens", tmp_path / "line.sqlite"
    tokens.write_text("hmi 0123456789abcdef\nscada fedcba9876543210\n")
    tokens.chmod(0o600)
    options = ("--bind", "[::1]:9000", "--read-only", "--token-file", str(tokens), "--history", str(history))
    ran = busmaster("web", "slitter", *options, "--host", "plant.example", "--host", "other.example")
    assert ran.status == 0
    assert f"--history: there is no file {history} yet" in ran.err
    assert served_with["line"] == "slitter"
    assert served_with["read_only"] is True
    assert served_with["listen"] == ("::1", 9000)
    assert set(served_with["secrets"]) == {"hmi", "scada"}
    assert served_with["hosts"] == ("plant.example", "other.example")
    assert isinstance(served_with["history"], HistoryFile)
    history.touch()
    assert "there is no file" not in busmaster("web", "slitter", "--history", str(history)).err


@pytest.mark.parametrize("names", [("plant:8420",), ("plant.example", "http://plant"), ("-plant",), ("",)])
def test_each_host_has_to_be_a_name(busmaster: Command, served_with: dict[str, Any], names: tuple[str, ...]) -> None:
    options = [word for name in names for word in ("--host", name)]
    ran = busmaster("web", "slitter", *options)
    assert (ran.status, served_with) == (2, {})
    assert f"--host: {names[-1]!r} is not a host name; write it like plant.example" in ran.err


@pytest.mark.parametrize("missing", ["msgspec", "starlette", "uvicorn", "websockets"])
def test_a_missing_package_of_the_page_is_reported(
    busmaster: Command, served_with: dict[str, Any], monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    monkeypatch.setattr("busmaster.app.cli.web.find_spec", lambda name: None if name == missing else name)
    ran = busmaster("web", "slitter")
    assert (ran.status, served_with) == (2, {})
    assert "pip install 'busmaster[web]'" in ran.err


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
