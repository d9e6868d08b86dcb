"""The other end of the screen: starts its process, feeds it frames, and hears what the person presses."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
from collections.abc import Callable

import anyio

from busmaster.cli.app import FAILED, INTERRUPTED, OK
from busmaster.cli.messages import Action, Frame, decode_action, encode

INTERVAL = 0.2
"""Seconds between frames: values that move, at a cost of well under 1 % of a processor here."""
ENDINGS = {"quit": OK, "interrupt": INTERRUPTED}
FAREWELL = 3.0
"""Seconds in which the screen gives the terminal back."""


async def draw(picture: Callable[[], Frame], act: Callable[[Action], object]) -> int:
    """Show `picture()` until the person quits (0), presses Ctrl-C (130), or the screen's process fails (1).

    Cancelling it gives the terminal back.
    """
    ours, theirs = socket.socketpair()
    with theirs:
        command = [sys.executable, "-m", "busmaster.cli.live", str(theirs.fileno())]
        process = await anyio.to_thread.run_sync(
            lambda: subprocess.Popen(command, pass_fds=[theirs.fileno()]), abandon_on_cancel=False
        )
    ours.setblocking(False)
    reader, writer = await asyncio.open_connection(sock=ours)
    try:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(feed, writer, picture)
            status = await hear(reader, act)
            tasks.cancel_scope.cancel()
    finally:
        writer.close()
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(see_off, process)
    return status


async def feed(writer: asyncio.StreamWriter, picture: Callable[[], Frame]) -> None:
    """A frame at each interval, but none while the screen has not taken the one before."""
    while not writer.is_closing():
        if writer.transport.get_write_buffer_size() == 0:
            writer.write(encode(picture()))
        await anyio.sleep(INTERVAL)


async def hear(reader: asyncio.StreamReader, act: Callable[[Action], object]) -> int:
    """Pass on what the person asks for, until it is to end: the exit status."""
    try:
        while line := await reader.readline():
            action = decode_action(line)
            if action.kind in ENDINGS:
                return ENDINGS[action.kind]
            act(action)
    except ConnectionError:
        pass
    return FAILED


def see_off(process: subprocess.Popen[bytes]) -> None:
    """The screen ends by itself when its socket does."""
    try:
        process.wait(FAREWELL)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
