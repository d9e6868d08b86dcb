"""A real program as a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO

from tests.patience import PATIENCE
from tests.printed import Line, Printed

ROOT = Path(__file__).parents[3]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "", "MALLOC_ARENA_MAX": "2"}
LOOK = 0.01
"""Seconds between two looks at a fact that nobody tells."""


def until(fact: Callable[[], bool], what: str, seen: Callable[[], object] = str) -> float:
    """Wait for a fact, and return the time of the machine's steady clock at which it was so.

    `seen` returns what there was in its place, for the error.
    """
    deadline = time.monotonic() + PATIENCE
    while not fact():
        if time.monotonic() > deadline:
            raise AssertionError(f"it never came that {what}; what was: {seen()}")
        time.sleep(LOOK)
    return time.monotonic()


class Program:
    """A process with pipes, in a session of its own: signals for us do not reach it."""

    def __init__(
        self,
        *arguments: str,
        cwd: Path = ROOT,
        environment: Mapping[str, str] | None = None,
        out: int | IO[str] | None = None,
        terminal: bool = False,
        nice: int = 0,
    ) -> None:
        """Start it. `out` is a `terminal`, perhaps, which is then that of its session, and its input too."""
        self.popen = subprocess.Popen(
            [
                *(["nice", "--adjustment", str(nice)] if nice else []),
                *(["setsid", "--ctty"] if terminal else []),
                *(sys.executable, "-m", *arguments),
            ],
            cwd=cwd,
            env={**ENVIRONMENT, **(environment or {})},
            stdin=out if terminal else subprocess.PIPE,
            stdout=subprocess.PIPE if out is None else out,
            stderr=subprocess.PIPE,
            text=True,
            errors="backslashreplace",
            start_new_session=not terminal,
        )
        assert self.popen.stderr is not None
        self.err = Printed(self.popen.stderr)
        self.out = Printed(self.popen.stdout) if self.popen.stdout is not None else None

    @property
    def runs(self) -> bool:
        return self.popen.poll() is None

    @property
    def told(self) -> list[str]:
        return self.err.texts()

    def order(self, text: str) -> None:
        assert self.popen.stdin is not None
        self.popen.stdin.write(f"{text}\n")
        self.popen.stdin.flush()

    def heard(self, what: str, since: float = 0.0) -> Line:
        """Wait until a line that holds this has come to standard error, and return it."""
        found: list[Line] = []

        def told() -> bool:
            found[:] = [line for line in self.err.since(since) if what in line.text][:1]
            return bool(found) or not self.runs

        until(told, f"{what!r} is told", lambda: self.told[-5:])
        assert found, f"it ended without a word of {what!r}: {self.told[-5:]}"
        return found[0]

    def printed(self, since: float = 0.0) -> list[Line]:
        assert self.out is not None
        return self.out.since(since)

    def send(self, number: signal.Signals) -> None:
        self.popen.send_signal(number)

    def stop(self) -> None:
        """Have it stand still, and return when it does."""
        self.send(signal.SIGSTOP)
        until(self._stands_still, "it stands still")

    def go_on(self) -> None:
        self.send(signal.SIGCONT)

    def _stands_still(self) -> bool:
        return Path(f"/proc/{self.popen.pid}/stat").read_text().rpartition(") ")[2][0] in "Tt"

    def wait(self) -> int:
        """Wait for its end, and for all that it said."""
        status = self.popen.wait(PATIENCE)
        self.err.join()
        if self.out is not None:
            self.out.join()
        return status

    def kill(self) -> None:
        """End it where it stands. It may have ended already."""
        if self.runs:
            self.popen.kill()
        self.wait()
        if self.popen.stdin is not None:
            try:
                self.popen.stdin.close()
            except BrokenPipeError:
                pass
