"""Runs pytest for one mutant after the other, in children that find the libraries imported and the project not.

Each line on standard input is a JSON list: the seconds that a run may take, whether it keeps what it compiles, and
pytest's arguments. Each is answered by one line, the exit status of that run. A child that takes longer is killed: by
then it hangs.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import time

LIBRARIES = ("anyio", "click", "hypothesis", "pytest", "pytest_asyncio", "pytest_timeout", "rich", "serial")
LOOKS = 0.05
"""Seconds between two looks at a child."""


def main() -> None:
    """Import what every run needs, then answer lines until there are no more."""
    for name in LIBRARIES:
        importlib.import_module(name)
    for line in sys.stdin:
        limit, keeps, *arguments = json.loads(line)
        sys.dont_write_bytecode = not keeps  # what is compiled of a mutant would be taken for the original's
        sys.stdout.write(f"{status_of(arguments, limit)}\n")
        sys.stdout.flush()


def status_of(arguments: list[str], limit: float) -> int:
    """Run pytest in a child with a session of its own, and return how it ended; below 0 for a signal."""
    child = os.fork()
    if child == 0:
        run(arguments)
    deadline = time.monotonic() + limit
    while time.monotonic() < deadline:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(LOOKS)
    os.killpg(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def run(arguments: list[str]) -> None:
    """Become a run of pytest that hears nothing, and speaks into the file that the command line names."""
    os.setsid()
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    said = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(said, stream)
    import pytest

    os._exit(pytest.main([*arguments, "-W", "ignore::pytest.PytestAssertRewriteWarning"]))  # of plugins imported here


if __name__ == "__main__":
    main()
