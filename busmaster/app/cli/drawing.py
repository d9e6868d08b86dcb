"""The live view of the line that this process owns: `busmaster top` in a process of its own, so that drawing never
disturbs the line."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import termios
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio

from busmaster import Service
from busmaster.app.cli.app import FAILED
from busmaster.app.service.authorisation import Authorisation

LEAVE_SCREEN = b"\x1b[?1000l\x1b[?1003l\x1b[?1006l\x1b[?2004l\x1b[?1004l\x1b[<u\x1b[?25h\x1b[?1049l"
"""No mouse, no bracketed paste, no reports of focus, the usual keyboard, a cursor, and the page of before."""
CLOSE_WITHIN = 3.0
"""Seconds in which the screen gives the terminal back."""
ENDED_BY_A_PERSON = (0, 130)


async def draw(address: str) -> int:
    """Show the line at an address until the person quits (0) or presses Ctrl-C (130), or the view ends itself (1).

    Cancelling it gives the terminal back.
    """
    before = terminal_state()
    command = [sys.executable, "-m", "busmaster", "top", address, "--of-owner"]
    process = await anyio.to_thread.run_sync(lambda: subprocess.Popen(command), abandon_on_cancel=False)
    try:
        await anyio.to_thread.run_sync(process.wait, abandon_on_cancel=True)
    finally:
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(end_view, process)
        if process.returncode < 0:  # one that was killed has left the terminal as it was drawing on it
            restore_terminal(before)
    return process.returncode if process.returncode in ENDED_BY_A_PERSON else FAILED


@asynccontextmanager
async def served_here(authorisation: Authorisation, title: str) -> AsyncIterator[Service]:
    """Serve a line only to this process's own view, because other programs must not or cannot use it."""
    with tempfile.TemporaryDirectory(prefix="busmaster-") as folder:
        async with Service(
            authorisation.bus, authorisation=authorisation, path=Path(folder) / "view.sock", title=title
        ) as service:
            yield service


def terminal_state() -> list[Any] | None:
    """Return how the terminal is set, None without one."""
    try:
        return termios.tcgetattr(sys.stdin.fileno())
    except (termios.error, OSError, ValueError):
        return None


def restore_terminal(before: list[Any] | None) -> None:
    """Give back a terminal that a screen left as it was drawing on it: Ctrl-C means something again."""
    if before is not None:
        try:
            termios.tcsetattr(sys.stdin.fileno(), termios.TCSANOW, before)
            os.write(sys.stdout.fileno(), LEAVE_SCREEN)
        except (termios.error, OSError):
            pass  # the terminal is gone, too


def end_view(process: subprocess.Popen[bytes]) -> None:
    """End the view, which gives the terminal back; kill it after CLOSE_WITHIN seconds."""
    process.terminate()
    try:
        process.wait(CLOSE_WITHIN)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
