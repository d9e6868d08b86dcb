"""`--capture FILE`, the same on every command: the line recorded while the command runs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import click

from busmaster.app.cli.output import note
from busmaster.app.cli.parsing import Whole
from busmaster.capture import COUNT, SIZE, Recorder

F = TypeVar("F", bound=Callable[..., Any])
MEGABYTE = 1_000_000
LIMITS = "busmaster.capture"
"""Key of the capture's further options in the command's context."""


def _limit(name: str, metavar: str, default: int, text: str) -> Callable[[F], F]:
    """Return an option whose value goes to the command's context, and not to the command itself."""
    return click.option(
        name,
        type=Whole(min=1),
        default=default,
        show_default=True,
        metavar=metavar,
        expose_value=False,
        callback=_keep,
        help=text,
    )


def _keep(context: click.Context, option: click.Parameter, value: int) -> None:
    context.meta[f"{LIMITS}.{option.name}"] = value


def capture_option(command: F) -> F:
    """Give a command `capture`, the path or None; its limits reach `capturing` by the command's context."""
    options = (
        _limit("--capture-files", "N", COUNT, "Keep only this many files of the capture, the newest."),
        _limit(
            "--capture-mb",
            "MB",
            SIZE // MEGABYTE,
            "Begin the next file of the capture (FILE-2 and so on) after this many megabytes.",
        ),
        click.option(
            "--capture",
            type=click.Path(dir_okay=False),
            metavar="FILE",
            help="Record the line to a pcapng file, for Wireshark or busmaster replay. Existing files are kept.",
        ),
    )
    for option in options:
        command = option(command)
    return command


@contextmanager
def capturing(path: str | None, *, port: str, protocol: str = "", echo: bool = False) -> Iterator[Recorder | None]:
    """Yield a recorder to be the bus's tap, or None without a path.

    Enter it outside the loop: leaving waits for the disk. The file's name and the number of lost events are printed on
    standard error: at once, or at the end if a live view may be drawn. Raises UsageError if the file cannot be written.
    """
    if path is None:
        yield None
        return
    context = click.get_current_context(silent=True)
    limits = context.meta if context is not None else {}
    held: list[str] = []
    report = held.append if sys.stdout.isatty() and sys.stdin.isatty() else note
    try:
        recorder = Recorder(
            path,
            port=port,
            protocol=protocol,
            echo=echo,
            size=limits.get(f"{LIMITS}.capture_mb", SIZE // MEGABYTE) * MEGABYTE,
            count=limits.get(f"{LIMITS}.capture_files", COUNT),
            report=report,
        )
    except OSError as error:
        raise click.UsageError(f"--capture {path}: {error.strerror}") from None
    if recorder.path != path:
        note(f"{path} exists; the capture goes to {recorder.path}")
    try:
        with recorder:
            yield recorder
    finally:
        for text in held:
            note(text)
    if recorder.error is not None:
        note(f"capture stopped: {recorder.path}: {recorder.error.strerror}")
    if recorder.dropped:
        events = "1 event" if recorder.dropped == 1 else f"{recorder.dropped} events"
        note(f"the capture lacks {events} that could not be written in time")
