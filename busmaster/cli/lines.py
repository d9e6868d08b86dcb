"""What the commands that take a LINE.toml have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

from busmaster.config import LineFile, line_settings, load
from busmaster.transport.endpoints import endpoint
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort

F = TypeVar("F", bound=Callable[..., Any])


def file_argument(required: bool = True) -> Callable[[F], F]:
    """Give a command LINE.toml, as `path`. A file that is not there is wrong usage."""
    return click.argument(
        "path",
        required=required,
        type=click.Path(exists=True, dir_okay=False),
        metavar="LINE.toml" if required else "[LINE.toml]",
    )


port_option = click.option("--port", metavar="PORT", help="Use this port in place of the file's.")


def other_port(file: LineFile, port: str | None) -> SerialPort | TcpPort | None:
    """Return the port of --port. Raises InvalidCommand.

    What it leaves open of a serial line is as the file's line is. None without a --port.
    """
    return None if port is None else endpoint(port, defaults=line_settings(file))


__all__ = ["file_argument", "load", "other_port", "port_option"]
