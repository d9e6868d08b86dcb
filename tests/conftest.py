"""What all tests share: which of them run by default, hypothesis without a deadline, and cached bytecode."""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import tempfile

import pytest
from hypothesis import settings

pytest_plugins = ["tests.transport.usb"]

settings.register_profile("busmaster", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
# Lines that tests serve are nobody else's, nor are those that others serve on this machine theirs.
os.environ["XDG_RUNTIME_DIR"] = tempfile.mkdtemp(prefix="busmaster-")
os.environ.pop("RUNTIME_DIRECTORY", None)
atexit.register(shutil.rmtree, os.environ["XDG_RUNTIME_DIR"], ignore_errors=True)

settings.load_profile("ci" if os.environ.get("CI") else "busmaster")

# Tests start some hundred interpreters. Where the environment forbids cached bytecode, each of them would compile all
# that it imports, a third of the processor time of a short command: bytecode is cached for this run. Programs that
# change code between two runs (tests.verification.mutation) set PYTHONPYCACHEPREFIX too: then the environment is left
# as it is.
if "PYTHONPYCACHEPREFIX" not in os.environ and os.environ.pop("PYTHONDONTWRITEBYTECODE", ""):
    os.environ["PYTHONPYCACHEPREFIX"] = tempfile.mkdtemp(prefix="busmaster-bytecode-")
    atexit.register(shutil.rmtree, os.environ["PYTHONPYCACHEPREFIX"], ignore_errors=True)

# A shell that starts a job in the background has it ignore these, and so would every command that the tests start and
# end by Ctrl-C. What a process handles is back at its default in those that it starts.
for number, handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGQUIT, signal.SIG_DFL),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return how many workers `-n auto` starts: two for each core, because many tests wait for processes."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return 2 * cores


def pytest_configure(config: pytest.Config) -> None:
    """Leave the slow tests out where neither `-m` nor a path selects tests; CONTRIBUTING.md describes the tiers.

    A path selects what is below it, but for the exhaustive tests, and the name of a test selects that test.
    """
    if config.option.markexpr:
        return
    if config.args_source is not pytest.Config.ArgsSource.ARGS:
        config.option.markexpr = "not slow and not exhaustive"
    elif not any("::" in argument for argument in config.args):
        config.option.markexpr = "not exhaustive"
