"""What the commands that take a LINE.toml have in common."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import anyio
import click

from busmaster import SerialPort, TcpPort, endpoint
from busmaster.app.cli.output import Level, note
from busmaster.app.config import LineFile, line_settings, load
from busmaster.app.outputs.distributor import Distributor
from busmaster.app.service.record import WriteRecord

PATIENCE = 5.0
"""Seconds for the outputs to store the audit log and the data queued before it."""
LOOK = 0.02

F = TypeVar("F", bound=Callable[..., Any])


def file_argument(required: bool = True) -> Callable[[F], F]:
    """Give a command LINE.toml, as `path`. A file that is not there is wrong usage."""
    return click.argument(
        "path",
        required=required,
        type=click.Path(exists=True, dir_okay=False),
        metavar="LINE.toml" if required else "[LINE.toml]",
    )


port_option = click.option("--port", metavar="PORT", help="Use this port instead of the file's.")


def other_port(file: LineFile, port: str | None) -> SerialPort | TcpPort | None:
    """Return the port of --port. Raises InvalidCommand.

    Line settings that it does not contain are those of the file. None without a --port.
    """
    return None if port is None else endpoint(port, defaults=line_settings(file))


def is_line_file(port: str) -> bool:
    """Return whether PORT is an existing LINE.toml."""
    return port.endswith(".toml") and os.path.isfile(port)


async def keep(audit: Distributor, records: Iterable[WriteRecord]) -> None:
    """Store these audit entries in the outputs of a line. Reports an output that failed."""
    audit.start(())
    for record in records:
        audit.record(record)
    with anyio.move_on_after(PATIENCE):
        # what waits on disk goes first, and would keep these there too if the outputs were closed at once
        while any(counts.waiting and not counts.error for counts in audit.statistics()):  # noqa: ASYNC110  # by threads
            await anyio.sleep(LOOK)
    await audit.close()
    for counts in audit.statistics():
        if counts.dropped:
            why = counts.error or f"not written within {PATIENCE:g} s"
            note(f"{counts.kind}: the audit log is incomplete: {why}", Level.WARNING)


__all__ = ["file_argument", "is_line_file", "keep", "load", "other_port", "port_option"]
