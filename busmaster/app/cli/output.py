"""How values and results are printed: plain lines, or one JSON object a line, each flushed."""

from __future__ import annotations

import enum
import io
import os
import sys
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from typing import TextIO

from busmaster.app.cli.terminal import printable
from busmaster.app.service.values import json_line, json_value, name_fields, number_text, value_text, word_text

__all__ = [
    "Level",
    "SteadyOutput",
    "columns",
    "emit",
    "emit_all",
    "json_line",
    "json_value",
    "name_fields",
    "note",
    "number_text",
    "value_text",
    "word_text",
]


def emit(*lines: str) -> None:
    """Print to standard output and flush. Raises BrokenPipeError if the reader has closed it."""
    emit_all(lines)


def emit_all(lines: Iterable[str]) -> None:
    """Print the lines to standard output and flush. Raises BrokenPipeError if the reader has closed it."""
    sys.stdout.write("".join(f"{printable(line)}\n" for line in lines))
    sys.stdout.flush()


def columns(rows: Sequence[Sequence[str]], right: Container[int] = ()) -> Iterator[str]:
    """Yield the lines of a table: each column as wide as its widest cell; those numbered in `right` flush right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for cells in rows:
        padded = (
            cell.rjust(width) if number in right else cell.ljust(width)
            for number, (cell, width) in enumerate(zip(cells, widths, strict=True))
        )
        yield "  ".join(padded).rstrip()


class Level(enum.IntEnum):
    """How much a line on standard error matters, as syslog numbers it."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


def note(line: str, level: Level = Level.INFO) -> None:
    """Print a line for the user on standard error, with its level if that is systemd's journal.

    A failure of standard error (terminal closed, disk full) is ignored.
    """
    text = f"busmaster: {printable(line)}\n"
    if is_journal(sys.stderr, os.environ.get("JOURNAL_STREAM", "")):
        text = f"<{level:d}>{text}"
    try:
        sys.stderr.flush()
        os.write(sys.stderr.fileno(), text.encode(errors="backslashreplace"))  # past the buffer, where it would stay
    except io.UnsupportedOperation:
        sys.stderr.write(text)  # a program of ours runs within another, which has put a stream of its own there
    except OSError:
        pass


def is_journal(stream: TextIO, device_and_inode: str) -> bool:
    """Return whether the stream is the one that systemd has connected to its journal, named by JOURNAL_STREAM."""
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    # the variable is inherited, and stays set if standard error is redirected
    return device_and_inode == f"{status.st_dev}:{status.st_ino}"


class SteadyOutput:
    """Standard output for programs that must continue if it fails: disk full, terminal closed.

    Lost lines are counted. `report` is called on the caller's thread when a failure begins and ends.
    """

    def __init__(self, report: Callable[[str, Level], object]) -> None:
        self.lost = 0
        """Lines that could not be printed."""
        self._report = report
        self._error = ""
        self._torn = False

    def print(self, lines: Iterable[str]) -> None:
        """Print and flush, past the stream's buffer, in which what failed would stay. Raises BrokenPipeError."""
        texts = list(lines)
        # a line that a full disk has cut off stays so: a line end keeps the next one apart from it
        data = ("\n" * self._torn + "".join(f"{printable(line)}\n" for line in texts)).encode(errors="backslashreplace")
        written = 0
        try:
            while written < len(data):
                written += os.write(sys.stdout.fileno(), data[written:])
        except BrokenPipeError:
            raise  # a reader that has left ends the command, here as everywhere
        except OSError as error:
            self._failed(error.strerror or str(error), data[:written], len(texts))
        else:
            self._torn = False
            if self._error:
                self._error = ""
                self._report(f"standard output works again; {self.lost} lines were lost", Level.NOTICE)

    def _failed(self, error: str, written: bytes, lines: int) -> None:
        self._torn = bool(self._torn and not written) or not (written or b"\n").endswith(b"\n")
        self.lost += lines - written.count(b"\n")
        if error != self._error:
            self._error = error
            self._report(f"standard output failed: {error}; polling continues, these lines are lost", Level.WARNING)
