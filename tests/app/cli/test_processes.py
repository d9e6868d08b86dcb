"""Commands as processes of their own: what they print when, how they end, and what a terminal shows."""

from __future__ import annotations

import json
import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from fcntl import ioctl
from pathlib import Path
from struct import pack
from termios import TIOCSWINSZ, tcgetattr

import pytest
import serial

from busmaster.app.cli import demo
from busmaster.app.cli.demo_line import make_line
from busmaster.emulator.serve import TcpServer, serve_pty
from tests.app.cli.conftest import ENVIRONMENT, ROOT, Command, ended_once, started
from tests.patience import PATIENCE

HCP2 = ("--protocol", "hcp2")


@contextmanager
def emulated(*options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`busmaster emulate` as a process, and where it says that it listens."""
    with started("emulate", *HCP2, *options) as process:
        assert process.stdout is not None
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    process = started(*arguments)
    out, err = process.communicate(timeout=PATIENCE)
    return subprocess.CompletedProcess(arguments, process.returncode, out, err)


@pytest.mark.slow
def test_a_value_goes_there_and_back_over_an_emulated_pty_by_its_link(tmp_path: Path) -> None:
    link = str(tmp_path / "line")
    with emulated("--nodes", "1-8", "--pty", link, "--paced") as (process, path):
        assert path == link
        assert run("write", path, *HCP2, "--node", "5", "1=123.456").stdout == "1 ok\n"
        assert run("read", path, *HCP2, "--node", "5", "1").stdout == "1 123.456\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 130
        assert process.stderr is not None
        assert process.stderr.read() == ""
    assert not os.path.lexists(link)


def test_emulate_takes_its_link_away_when_it_is_terminated(tmp_path: Path) -> None:
    link = str(tmp_path / "line")
    with emulated("--pty", link) as (process, _):
        process.terminate()
        assert process.wait(PATIENCE) == 128 + signal.SIGTERM
    assert not os.path.lexists(link)


def test_emulate_ends_by_itself_after_its_seconds() -> None:
    done = run("emulate", *HCP2, "--tcp", "127.0.0.1:0", "--seconds", "0.1")
    assert done.returncode == 0
    assert done.stdout.startswith("socket://127.0.0.1:")
    assert done.stderr == ""


def test_ctrl_c_ends_a_poll_with_its_summary_and_status_130(controllers: TcpServer) -> None:
    options = ("--nodes", "1", "--items", "1", "--period", "0.02")
    with started("poll", controllers.path, *HCP2, *options) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=PATIENCE)
    assert first.split()[1:] == ["1/1", "0"]
    assert process.returncode == 130
    assert "cycles" in err
    assert "Traceback" not in err


def test_a_reader_that_goes_away_ends_a_poll_quietly(controllers: TcpServer) -> None:
    options = ("--nodes", "1", "--items", "1", "--period", "0.02", "--json")
    with started("poll", controllers.path, *HCP2, *options) as process:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["cycle"] == 1
        process.stdout.close()
        assert process.stderr is not None
        err = process.stderr.read()
        assert process.wait(PATIENCE) == 0
    assert all(line.startswith("busmaster: ") for line in err.splitlines())
    assert "internal" not in err


@pytest.mark.slow
def test_the_demo_without_a_terminal_prints_plain_lines() -> None:
    done = ended_once(lambda lines: "8/speed_measured" in lines[-1], "demo")
    assert done.status == 130
    assert any("1/axis0.position" in line for line in done.lines)
    assert "Traceback" not in done.err
    assert "node 8: " in done.err


def test_the_demo_ends_by_itself_after_its_seconds() -> None:
    done = run("demo", "--seconds", "0.1")
    assert (done.returncode, "Traceback" in done.stderr) == (0, False)


def test_the_demo_takes_another_terminal_where_one_is_taken(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serve_pty(make_line()) as taken, serve_pty(make_line()) as free, serial.Serial(taken.path, exclusive=True):
        paths = [taken.path, free.path]
        monkeypatch.setattr(demo, "emulated_line", lambda: nullcontext(paths.pop(0)))
        ran = busmaster("demo", "--seconds", "0.1", "--plain")
    assert (ran.status, paths) == (0, [])
    assert "in use" not in ran.err


class Terminal:
    """A real pseudo-terminal of 80 by 24, and what was drawn on it."""

    def __init__(self, *arguments: str, program: tuple[str, ...] = ("-m", "busmaster")) -> None:
        self.master, slave = pty.openpty()
        ioctl(slave, TIOCSWINSZ, pack("HHHH", 24, 80, 0, 0))
        self.before = tcgetattr(slave)
        self.process = subprocess.Popen(
            [sys.executable, *program, *arguments],
            cwd=ROOT,
            env=ENVIRONMENT | {"TERM": "xterm-256color", "PYTHONWARNINGS": ""},
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
        )
        self.slave = slave
        self.drawn = b""

    def until(self, seen: Callable[[bytes], bool]) -> None:
        """Read until `seen` is satisfied with all that was drawn so far."""
        deadline = time.monotonic() + PATIENCE
        while not seen(self.drawn):
            assert time.monotonic() < deadline, self.drawn[-2000:]
            if select.select([self.master], [], [], 0.05)[0]:
                self.drawn += os.read(self.master, 65536)

    def status(self) -> int:
        """How the process ended, which it cannot while nobody reads what it draws."""
        self.until(lambda _: self.process.poll() is not None)
        return self.process.returncode

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self.master)
        os.close(self.slave)


@pytest.mark.slow
@pytest.mark.parametrize(("key", "status"), [(b"\x03", 130), (b"q", 0)])
def test_the_demo_on_a_terminal_draws_and_gives_the_terminal_back(key: bytes, status: int) -> None:
    terminal = Terminal("demo")
    try:
        terminal.until(lambda drawn: b"busmaster demo" in drawn and b"axis0.position" in drawn and b"speed" in drawn)
        os.write(terminal.master, key)
        assert terminal.status() == status
        terminal.until(lambda drawn: b"cycles" in drawn)
        assert b"Traceback" not in terminal.drawn
        assert tcgetattr(terminal.slave) == terminal.before
        assert b"\x1b[?1049l" in terminal.drawn
    finally:
        terminal.close()
