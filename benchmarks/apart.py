"""A program of this package in a process of its own, so that what it costs is not counted as the master's."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
CORES = sorted(os.sched_getaffinity(0))


class Apart:
    """`python -m MODULE`, which answers each line of JSON with another, and ends when its input does.

    `paced`: it keeps time. It has the descriptors `pass_fds` too.
    """

    def __init__(self, module: str, *, paced: bool, pass_fds: Sequence[int] = ()) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=pass_fds,
            cwd=ROOT,
        )
        part_from(self._process.pid, paced)

    def ask(self, order: object) -> Any:
        """Give it an order, and return its answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(order).encode() + b"\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        """End it, and take back the core that it had."""
        with self._process as process:
            process.communicate(timeout=10)
        os.sched_setaffinity(0, CORES)


def part_from(responder: int, paced: bool) -> None:
    """Give the responder a core of its own; where it keeps time, let nobody else interrupt it there, if we may.

    It stands for the wire and the devices, which take no time of the master's and wait for no other program. One that
    answers at once is a process like any other: waking each other up is part of what a ping-pong costs.
    """
    if len(CORES) == 1:
        return
    os.sched_setaffinity(responder, CORES[-1:])
    os.sched_setaffinity(0, CORES[:-1])
    if paced:
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(responder, os.SCHED_FIFO, os.sched_param(1))
