"""The bar: on a terminal at standard error, and nowhere else."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from contextlib import suppress

import pytest
from rich.console import Console
from rich.progress import Progress

from busmaster.app.cli.progress import Bar
from busmaster.emulator.serve import TcpServer
from tests.app.cli.conftest import ENVIRONMENT, ROOT
from tests.patience import PATIENCE

SCAN = ("scan", "--protocol", "hcp2", "--nodes", "6-9", "--timeout", "300")


def scan_on_a_terminal(port: str, *, results_too: bool) -> tuple[bytes, bytes]:
    """Standard output, and what the terminal got: standard error, or both."""
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "busmaster", *SCAN, port],
        cwd=ROOT,
        env=ENVIRONMENT | {"TERM": "xterm-256color", "COLUMNS": "80"},
        stdin=subprocess.DEVNULL,
        stdout=slave if results_too else subprocess.PIPE,
        stderr=slave,
    )
    os.close(slave)
    drawn = b""
    with suppress(OSError):  # EIO: the last who had it open is gone
        while data := os.read(master, 65536):
            drawn += data
    os.close(master)
    out, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0
    return out or b"", drawn


def test_the_bar_counts_as_many_as_it_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Console, "is_terminal", True)
    with Bar("reading", 10) as bar:
        bar.advance(6)
        bar.advance()
    assert "7/10" in capsys.readouterr().err


@pytest.mark.slow
def test_the_bar_is_drawn_on_the_terminal_and_standard_output_has_the_results_alone(controllers: TcpServer) -> None:
    out, drawn = scan_on_a_terminal(controllers.path, results_too=False)
    assert out == b"6 read element 1: 0\n7 read element 1: 0\n8 read element 1: 0\n"
    assert b"scanning" in drawn
    assert b"4/4" in drawn
    assert b"element" not in drawn


@pytest.mark.slow
def test_a_result_on_the_same_terminal_has_a_line_of_its_own(controllers: TcpServer) -> None:
    _, drawn = scan_on_a_terminal(controllers.path, results_too=True)
    for node in b"678":
        assert b"\x1b[2K" + bytes([node]) + b" read element 1: 0\r\n" in drawn
    assert drawn.endswith(b"\x1b[2K")


@pytest.mark.parametrize("terminal", [False, True])
def test_the_bar_is_on_a_terminal_alone_away_while_a_result_is_printed_and_gone_at_the_end(
    monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    done: list[str] = []
    monkeypatch.setattr(Console, "is_terminal", terminal)
    for name in ("start", "stop", "update"):
        monkeypatch.setattr(Progress, name, lambda *_, name=name, **__: done.append(name))

    def read() -> None:
        with Bar("reading", 3) as bar:
            assert done == ["start"] * terminal
            with bar.hidden():
                assert done == ["start", "stop"] * terminal
            assert done == ["start", "stop", "start"] * terminal
            bar.advance()
            with bar.hidden():
                raise OSError("lost")

    with pytest.raises(OSError, match="lost"):
        read()
    assert done == ["start", "stop", "start", "update", "stop", "start", "stop"] * terminal


def test_the_bar_is_drawn_on_standard_error_with_its_total(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Console, "is_terminal", True)
    with Bar("reading", 5) as bar:
        bar.advance(5)
    drawn = capsys.readouterr()
    assert "5/5" in drawn.err
    assert drawn.out == ""
