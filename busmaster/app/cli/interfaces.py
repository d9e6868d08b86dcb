"""What the commands that open an interface share: which line, where it listens, and that it is followed for good."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

from busmaster import InvalidCommand, LineDown
from busmaster.app.cli.output import Level, note
from busmaster.app.cli.reaching import token_for
from busmaster.app.cli.top import address_of
from busmaster.app.interfaces.following import Connected, Following
from busmaster.ext import host_and_port

Decorated = TypeVar("Decorated", bound=Callable[..., Any])


def interface_options(bind: str) -> Callable[[Decorated], Decorated]:
    """Add the options of every interface: the line, the address to listen on (by default `bind`), and --read-only."""

    def add(function: Decorated) -> Decorated:
        for option in (
            click.option("--read-only", is_flag=True, help="Reject all writes through this interface."),
            click.option(
                "--bind", default=bind, show_default=True, metavar="HOST:PORT", help="Address and port to listen on."
            ),
            click.argument("line", required=False, metavar="[LINE|unix:PATH|PORT]"),
        ):
            function = option(function)
        return function

    return add


def place_of(bind: str) -> tuple[str, int]:
    """Return the host and the port of --bind. Raises UsageError."""
    try:
        return host_and_port(bind)
    except InvalidCommand as error:
        raise click.UsageError(f"--bind: {error}") from None


def following(line: str | None, *, read_only: bool) -> Following:
    """Return a follower of the named line. It reports on standard error when the line connects and disconnects, and
    whether it is read-only.

    Raises UsageError if the name is ambiguous. A line that is not served yet is not an error.
    """
    token = None
    try:
        token = token_for(address_of(line))
    except LineDown as error:
        note(f"{error}; the interface starts, and waits for the line", Level.WARNING)
    followed = Following(_Meant(line), token=token, read_only=read_only)

    def report() -> None:
        if isinstance(followed.state, Connected):
            note(f"connected to line {followed.state.about['line']}{' (read-only)' if followed.read_only else ''}")
        else:
            note(followed.state.why, Level.WARNING)

    followed.on_state(report)
    return followed


class _Meant:
    """The address of the line that is meant. One that was not named is the same for good, once there is one."""

    def __init__(self, line: str | None) -> None:
        self._line = line

    def __call__(self) -> str:
        try:
            address = address_of(self._line)
        except click.UsageError as error:
            raise InvalidCommand(error.format_message()) from None
        if self._line is None:
            self._line = address
        return address


__all__ = [
    "following",
    "interface_options",
    "place_of",
]
