"""`busmaster serve`: run a file's line without a screen, for other programs."""

from __future__ import annotations

import click

from busmaster.app.cli.arguments import View, seconds_option
from busmaster.app.cli.capturing import capture_option
from busmaster.app.cli.hangups import Hangups
from busmaster.app.cli.lines import file_argument, port_option
from busmaster.app.cli.run import run


@click.command()
@file_argument()
@port_option
@capture_option
@seconds_option
@click.option("--read-only", is_flag=True, help="Reject writes from MQTT commands and programs.")
def command(path: str, port: str | None, capture: str | None, seconds: float | None, read_only: bool) -> int:
    """Do what `busmaster run` does with LINE.toml, and print nothing but what happens, on standard error.

    Other programs read and write by its socket, which is named there: `connect` in Python, `busmaster read` and
    `busmaster write` with its PORT, and whatever speaks JSON-RPC over WebSocket. `busmaster status` lists it.
    """
    with Hangups() as hangups:  # first of all: by default SIGHUP ends a process
        return run(path, port, capture, View(seconds, read_only=read_only, silent=True), hangups)
