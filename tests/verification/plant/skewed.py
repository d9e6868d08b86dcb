"""busmaster with a clock that somebody sets: `python -m tests.verification.plant.skewed FILE ARGUMENTS...`.

FILE holds the seconds by which the time of day is ahead, and is looked at whenever that is asked for; the clock that
only goes forward is left alone, as by `date --set`, which would set it for everything else on this machine too.
"""

from __future__ import annotations

import os
import sys
import time

TRUE_TIME, TRUE_STRFTIME = time.time, time.strftime


def skew(path: str) -> float:
    try:
        with open(path, encoding="utf-8") as file:
            return float(file.read() or 0)
    except FileNotFoundError:
        return 0.0


def main(path: str, *arguments: str) -> int:
    time.time = lambda: TRUE_TIME() + skew(path)
    time.strftime = lambda pattern: TRUE_STRFTIME(pattern, time.localtime(time.time()))  # type: ignore[assignment,misc]  # the jump
    from busmaster.app.cli import main as busmaster

    return busmaster(arguments)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONWARNINGS", "default")
    sys.exit(main(*sys.argv[1:]))
