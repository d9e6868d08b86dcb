"""`--capture FILE`, the same on every command: the line recorded while the command runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import click

from busmaster.capture.recorder import Recorder
from busmaster.cli.output import note

capture_option = click.option(
    "--capture",
    type=click.Path(dir_okay=False, writable=True),
    metavar="FILE",
    help="Record the line: a pcapng file for Wireshark, or for busmaster replay.",
)


@contextmanager
def capturing(path: str | None, *, port: str, protocol: str = "", echo: bool = False) -> Iterator[Recorder | None]:
    """A recorder to be the bus's tap, or None without a path. Enter it outside the loop: leaving waits for the disk.

    What could not be recorded is said on standard error. Raises UsageError if the file cannot be written at all.
    """
    if path is None:
        yield None
        return
    try:
        recorder = Recorder(path, port=port, protocol=protocol, echo=echo)
    except OSError as error:
        raise click.UsageError(f"--capture {path}: {error.strerror}") from None
    with recorder:
        yield recorder
    if recorder.error is not None:
        note(f"the capture ends early: {path}: {recorder.error.strerror}")
    if recorder.dropped:
        note(f"the capture lacks {recorder.dropped} events, which came faster than they could be written")
