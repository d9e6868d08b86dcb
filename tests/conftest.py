"""What all tests share: which of them run by default, hypothesis without a deadline, and cached bytecode."""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import os
import shutil
import signal
import tempfile
from pathlib import Path

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


GARBAGE_THRESHOLD = 10_000
"""New objects after which Python looks for garbage."""

SLOW = "slow and not exhaustive"
NOT_BY_DEFAULT = ("slow", "exhaustive")
MAKES_SLOW_CASES = "_by_default("
"""Tests use functions of tests/tiers.py with such names."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return how many workers `-n auto` starts: five for two cores, because many tests wait for processes."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return 5 * cores // 2


def pytest_configure(config: pytest.Config) -> None:
    """Leave the slow tests out where neither `-m` nor a path selects tests; CONTRIBUTING.md describes the tiers.

    A path selects what is below it, but for the exhaustive tests, and the name of a test selects that test. A slow test
    can have exhaustive cases.
    """
    if config.option.markexpr == "slow":
        config.option.markexpr = SLOW
    if config.option.markexpr:
        return
    if config.args_source is not pytest.Config.ArgsSource.ARGS:
        config.option.markexpr = "not slow and not exhaustive"
    elif not any("::" in argument for argument in config.args):
        config.option.markexpr = "not exhaustive"


def has_tier(path: Path, tier: str) -> bool:
    """Return True if the file can have tests of this tier: it names the tier, or has `tests/tiers.py` mark them."""
    text = path.read_text()
    return tier in text or MAKES_SLOW_CASES in text


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out the files without a test of the one tier that is run: more than half have no slow test."""
    tier = "slow" if config.option.markexpr == SLOW else config.option.markexpr
    if tier in NOT_BY_DEFAULT and collection_path.match("test_*.py") and not has_tier(collection_path, tier):
        return True
    return None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Refuse a test whose tier its file does not name: `-m slow` would leave it out."""
    files = {(item.path, mark.name) for item in items for mark in item.iter_markers() if mark.name in NOT_BY_DEFAULT}
    if wrong := sorted(f"{path}: {tier}" for path, tier in files if not has_tier(path, tier)):
        raise pytest.UsageError(f"the tier of a test is not named in its file: {', '.join(wrong)}")


def pytest_collection_finish() -> None:
    """Have Python look for garbage in what the tests make, not in all modules and tests again and again.

    What has been imported and collected remains to the end. To visit it took a tenth of the processor time.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(GARBAGE_THRESHOLD, *gc.get_threshold()[1:])


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> None:
    """Have each worker import another part of the test files first.

    Each worker imports all of them. In a new clone, all would compile the same file at the same time, which is a third
    of the processor time of the default tier.
    """
    worker = getattr(session.config, "workerinput", None)
    if worker is None or session.config.args_source is pytest.Config.ArgsSource.ARGS:
        return
    files = sorted(path for path in Path(__file__).parent.rglob("test_*.py"))
    files = [path for path in files if not pytest_ignore_collect(path, session.config)]
    first = len(files) * int(worker["workerid"].removeprefix("gw")) // worker["workercount"]
    for path in files[first:] + files[:first]:
        with contextlib.suppress(Exception, pytest.skip.Exception):  # reported when the file is collected
            importlib.import_module(".".join(path.relative_to(session.config.rootpath).with_suffix("").parts))
