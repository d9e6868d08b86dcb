"""What a process prints, kept as it comes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import IO, NamedTuple

from tests.patience import PATIENCE


class Line(NamedTuple):
    """`when` it came is by the machine's steady clock, which all processes share."""

    when: float
    text: str


class Printed:
    """The lines of one stream. A thread keeps them until the stream ends, and closes it then."""

    def __init__(self, stream: IO[str]) -> None:
        self._lines: list[Line] = []
        self._stream = stream
        self._ended = False
        self._more = threading.Condition()
        self._thread = threading.Thread(target=self._collect, daemon=True)
        self._thread.start()

    def _collect(self) -> None:
        try:
            with self._stream:
                for text in self._stream:
                    with self._more:
                        self._lines.append(Line(time.monotonic(), text.rstrip("\n")))
                        self._more.notify_all()
        finally:
            with self._more:
                self._ended = True
                self._more.notify_all()

    def __len__(self) -> int:
        """How many lines there are."""
        return len(self._lines)

    def texts(self, first: int = 0) -> list[str]:
        """The lines, from that with this number on."""
        return [line.text for line in self._lines[first:]]

    def since(self, moment: float) -> list[Line]:
        """The lines that came from this moment on."""
        return [line for line in self._lines[:] if line.when >= moment]

    def wait_for(self, fact: Callable[[], bool]) -> bool:
        """Wait until a fact about the lines is one, or can be one no more, and return whether it is."""
        with self._more:
            self._more.wait_for(lambda: self._ended or fact(), PATIENCE)
            return fact()

    def join(self) -> None:
        """Wait until the stream has ended, and all of it is here."""
        self._thread.join(PATIENCE)
