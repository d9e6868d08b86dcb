"""The other end of the screen: starts its process, feeds it frames, and hears what the person presses."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
import termios
from collections.abc import Callable
from typing import Any

import anyio

from busmaster.cli.app import FAILED, INTERRUPTED, OK
from busmaster.cli.messages import Action, Frame, decode_action, encode

INTERVAL = 0.2
"""Seconds between frames: values that move, at a cost of well under 1 % of a processor here."""
ENDINGS = {"quit": OK, "interrupt": INTERRUPTED}
LEAVE_SCREEN = b"\x1b[?1000l\x1b[?1003l\x1b[?1006l\x1b[?2004l\x1b[?25h\x1b[?1049l"
"""No mouse, no bracketed paste, a cursor, and the page of before."""
FAREWELL = 3.0
"""Seconds in which the screen gives the terminal back."""


async def draw(picture: Callable[[], Frame], act: Callable[[Action], object]) -> int:
    """Show `picture()` until the person quits (0), presses Ctrl-C (130), or the screen's process fails (1).

    Cancelling it gives the terminal back.
    """
    before = terminal_state()
    ours, theirs = socket.socketpair()
    with theirs:
        command = [sys.executable, "-m", "busmaster.cli.live", str(theirs.fileno())]
        process = await anyio.to_thread.run_sync(
            lambda: subprocess.Popen(command, pass_fds=[theirs.fileno()]), abandon_on_cancel=False
        )
    ours.setblocking(False)
    reader, writer = await asyncio.open_connection(sock=ours)
    status = FAILED
    try:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(feed, writer, picture)
            status = await hear(reader, act)
            tasks.cancel_scope.cancel()
    finally:
        writer.close()
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(see_off, process)
        if process.returncode:
            restore_terminal(before)
    return status


async def feed(writer: asyncio.StreamWriter, picture: Callable[[], Frame]) -> None:
    """Send a frame at each interval, but none while the screen has not taken the one before."""
    while not writer.is_closing():
        if writer.transport.get_write_buffer_size() == 0:
            writer.write(encode(picture()))
        await anyio.sleep(INTERVAL)


async def hear(reader: asyncio.StreamReader, act: Callable[[Action], object]) -> int:
    """Pass on what the person asks for, until it is to end, and return the exit status."""
    try:
        while line := await reader.readline():
            action = decode_action(line)
            if action.kind in ENDINGS:
                return ENDINGS[action.kind]
            act(action)
    except ConnectionError:
        pass
    return FAILED


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


def see_off(process: subprocess.Popen[bytes]) -> None:
    """Wait for the screen, which ends by itself when its socket does; kill it after FAREWELL seconds."""
    try:
        process.wait(FAREWELL)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
