"""What the commands that open an interface share: which line, where it listens, and that it is followed for good."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

from busmaster.app.cli.output import Level, note
from busmaster.app.cli.reaching import token_for
from busmaster.app.cli.top import address_of
from busmaster.app.interfaces.following import Connected, Following
from busmaster.errors import InvalidCommand, LineDown
from busmaster.ext import host_and_port

Decorated = TypeVar("Decorated", bound=Callable[..., Any])


def interface_options(bind: str) -> Callable[[Decorated], Decorated]:
    """Add what every interface is told: the line, where to listen (by default at `bind`), and that nothing is
    written."""

    def add(function: Decorated) -> Decorated:
        for option in (
            click.option("--read-only", is_flag=True, help="Nobody writes through this interface."),
            click.option("--bind", default=bind, show_default=True, metavar="HOST:PORT", help="Where it listens."),
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
    """Return what follows the line that is meant, and tells on standard error when it comes and goes, and when it may
    only be read.

    Raises UsageError where it is not clear which is meant. That it is not served yet is no error.
    """
    token = None
    try:
        token = token_for(address_of(line))
    except LineDown as error:
        note(f"{error}; the interface opens, and waits for it", Level.WARNING)
    followed = Following(_Meant(line), token=token, read_only=read_only)

    def tell() -> None:
        if isinstance(followed.state, Connected):
            note(f"{followed.state.about['line']} is followed{', and may only be read' if followed.read_only else ''}")
        else:
            note(followed.state.why, Level.WARNING)

    followed.on_state(tell)
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
