"""The command line: one module for each command, and shared modules. `main` is the console script."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence

WRONG_USAGE, INTERRUPTED = 2, 130
NEEDED = ("click", "rich")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status. `arguments` are those of the process by default."""
    try:
        missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
        if not missing:
            from busmaster.app.cli.app import run
    except KeyboardInterrupt:  # importing takes a moment; afterwards `run` handles Ctrl-C
        return INTERRUPTED
    if missing:
        print(
            f"busmaster: the command line needs {', '.join(missing)}; install the extra cli: "
            "pip install 'busmaster[cli]'",
            file=sys.stderr,
        )
        return WRONG_USAGE
    return run(arguments)
