"""`busmaster top`: the live view of a line that another program owns."""

from __future__ import annotations

import asyncio
import os
import sys
from importlib.util import find_spec
from typing import TYPE_CHECKING

import click

from busmaster import LineDown, LineSettings, endpoint
from busmaster.app.cli.app import FAILED
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.lines import is_line_file, load
from busmaster.app.cli.reaching import owner_of, token_for
from busmaster.app.cli.terminal import made_printable
from busmaster.app.interfaces.following import Following, Lost
from busmaster.app.service.folder import find_owner, line_name, owners
from busmaster.ext import is_served

if TYPE_CHECKING:
    from busmaster.app.cli.live import Screen

ANY_RATE = LineSettings(9600)
"""Of a port whose owner is looked for: which rate it has is nothing to that."""
TERMINAL_LOOKED_AT = 1.0
"""Seconds between two looks at whether the terminal is still there."""


@click.command()
@click.argument("line", required=False, metavar="[LINE|unix:PATH|PORT]")
@click.option("--read-only", is_flag=True, help="Reject writes from keys.")
@click.option("--of-owner", is_flag=True, hidden=True, help="Run as the view of the program that owns the line.")
def command(line: str | None, read_only: bool, of_owner: bool) -> int:
    """Show the points, groups and nodes of a line as they change, until q or Ctrl-C. The line goes on.

    LINE is the name that `busmaster status` lists, its LINE.toml or its port; without it, the one line that runs.
    Several may look at once. Keys pause a group, suspend a node and write a value: the key ? lists them.
    """
    if missing := what_is_missing():
        raise click.UsageError(f"the live view needs {missing}")
    return until_ended(top, address_of(line), read_only, of_owner)


def what_is_missing() -> str:
    """Return the missing package of the live view as text, "" if there is none."""
    extras = {"textual": "tui", "msgspec": "service", "websockets": "service"}
    missing = dict.fromkeys(extra for module, extra in extras.items() if find_spec(module) is None)
    return f"an extra: pip install 'busmaster[{','.join(missing)}]'" if missing else ""


def address_of(line: str | None) -> str:
    """Return the address of the line that is meant. Raises LineDown if none runs, UsageError if it is not clear."""
    if line is None:
        running = [owner for owner in owners() if os.access(owner.socket, os.W_OK)]
        if not running:
            raise LineDown("no running line of this user", hint="start one with: busmaster run LINE.toml")
        if len(running) > 1:
            names = ", ".join(owner.name for owner in running)
            raise click.UsageError(f"several lines are running; name one of {names}")
        return running[0].address
    if is_served(line):
        return line
    if not is_line_file(line):
        owner = find_owner(line) or owner_of(endpoint(line, defaults=ANY_RATE))
        return line if owner is None else owner.address  # for the error message about an unknown name
    owner = find_owner(line_name(os.path.basename(line).removesuffix(".toml"))) or owner_of(load(line).port)
    if owner is None:
        raise LineDown(f"no running line of {line}", hint=f"start it with: busmaster run {line}")
    return owner.address


async def top(address: str, read_only: bool = False, of_owner: bool = False) -> int:
    """Show a line until the person leaves, and return the exit status. While its owner is away that is shown.

    Raises LineDown where its owner is not there at first, or, of the owner's own view, when it is gone; and UsageError
    where the line is there, and no terminal.
    """
    from busmaster.app.cli.live import Screen

    token = token_for(address)
    following = Following(lambda: address, token=token, read_only=read_only, clean=made_printable)
    connected = asyncio.Event()
    unwatch = following.on_state(connected.set)
    tasks = [asyncio.ensure_future(following.follow(patient=False)), asyncio.ensure_future(connected.wait())]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        unwatch()
        if tasks[0].done():
            await tasks[0]
        if not (sys.stdin.isatty() and sys.stdout.isatty()):
            raise click.UsageError("top needs a terminal; for values in a file or a pipe use busmaster poll or read")
        screen = Screen(following.picture, following, leave="end the run" if of_owner else "leave")

        def show_state() -> None:
            if of_owner and screen.away:
                return  # the first reason counts: what a retry finds while the screen leaves would hide it
            screen.away = following.state.why if isinstance(following.state, Lost) else ""
            screen.picture, screen.read_only = following.picture, following.read_only
            screen.take_picture()
            if of_owner and screen.away:
                screen.exit(FAILED)  # the terminal is restored before the reason is printed

        following.on_state(show_state)
        following.on_picture(lambda method, _: screen.take_picture() if method == "frame" else None)
        show_state()
        tasks.append(asyncio.ensure_future(hang_up(screen)))
        tasks[0].add_done_callback(lambda _: screen.exit(FAILED))
        status = None if of_owner and screen.away else await screen.run_async()
        if tasks[0].done():
            await tasks[0]
        if of_owner and screen.away:
            raise LineDown(screen.away, hint="")
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    return FAILED if status is None else status


async def hang_up(screen: Screen) -> None:
    """End the screen when its terminal is closed: reads do not report that."""
    while os.isatty(sys.stdin.fileno()):  # noqa: ASYNC110  there is no event for it
        await asyncio.sleep(TERMINAL_LOOKED_AT)
    screen.exit(FAILED)
