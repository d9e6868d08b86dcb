"""Runs tests on one mutant after the other, in children of a process that has imported what does not change.

    python -m tests.verification.mutation.warm measure SAID FILE PATH...

runs the tests of these paths without a mutant, and writes into FILE what each takes and which lines it runs.

    python -m tests.verification.mutation.warm answer SAID PATH...

answers requests, each a line of JSON: the module that is changed and the tests that are asked, each with the seconds
that it usually takes. The answer is a line of JSON too: how the child ended, and the last test that it began. It
replaces the code of the module's functions by that of the changed file: so nothing is imported or collected for a
mutant. A change of what happens when the module is imported cannot be seen so:

    python -m tests.verification.mutation.warm import SAID

answers requests that name paths too, in children that import and collect everything anew.

SAID is the file that pytest speaks into.
"""

from __future__ import annotations

import gc
import importlib
import json
import mmap
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import pytest
from coverage import Coverage

from tests.verification.mutation.asked import Measured
from tests.verification.mutation.places import ROOMS

LIBRARIES = ("anyio", "click", "hypothesis", "pytest_asyncio", "pytest_timeout", "rich", "serial")
LOOKS = 0.01
"""Seconds between two looks at a child."""
PATIENCE = 5.0
"""Times its usual seconds, after which a test is over: that a mutant makes it hang is noticed."""
SHORTEST, SHORTEST_COMPUTED = 10.0, 2.0
"""Seconds that every test may take, because others compute too; and that it may compute itself."""
COLLECTING = 60.0
"""Seconds that all tests may take to be imported and collected."""
UNLIKE = 99
"""How a child ends that could not replace the code of the functions."""
NAME = 1000
"""The longest name of a test, in bytes."""


def main() -> None:
    """Do what the command line says."""
    what, said, *rest = sys.argv[1:]
    answers = os.fdopen(os.dup(1), "w")
    speak_into(Path(said))
    sys.dont_write_bytecode = what != "measure"  # what is compiled of a mutant would be taken for the original's
    if what == "measure":
        sys.exit(status_of(rest[1:], Measuring(Path(rest[0]))))
    if what == "answer":
        sys.exit(status_of(rest, Answering(answers)))
    for name in LIBRARIES:
        importlib.import_module(name)
    for request in map(json.loads, sys.stdin):
        answer(request, answers, judged_anew)


def judged_anew(request: Any, begun: mmap.mmap) -> int:
    """Import and collect what the request names, and return how its tests end."""
    signal.setitimer(signal.ITIMER_VIRTUAL, COLLECTING)
    return status_of(request["paths"], Once(request["tests"], begun))


def speak_into(file: Path) -> None:
    """Have everything that this process prints go into a file."""
    said = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(said, stream)


def status_of(paths: Sequence[str], plugin: object) -> int:
    """Run pytest on these paths, and return how it ended."""
    quiet = ["-q", "-s", "-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
    return int(pytest.main([*quiet, *paths], [plugin]))


class Measuring:
    """Measures each test, as a plugin of pytest."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._seconds: dict[str, float] = {}
        self._coverage = Coverage(
            data_file=None, config_file=False, include=[path for paths in ROOMS.values() for path in paths]
        )
        self._coverage.start()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Note what one test takes and runs."""
        self._coverage.switch_context(item.nodeid)
        start = time.monotonic()
        result = yield
        self._seconds[item.nodeid] = time.monotonic() - start
        return result

    def pytest_sessionfinish(self) -> None:
        """Write it all down."""
        self._coverage.stop()
        data = self._coverage.get_data()
        lines = {os.path.relpath(file): data.contexts_by_lineno(file) for file in data.measured_files()}
        Measured(self._seconds, lines).write(self._file)


class Once:
    """Runs tests to the first that fails, as a plugin of pytest: those whose seconds are known as quickest first."""

    def __init__(self, seconds: Mapping[str, float], begun: mmap.mmap) -> None:
        self._seconds = seconds
        self._begun = begun

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Run them, if they could be collected."""
        if not session.testsfailed:
            number = {test: number for number, test in enumerate(self._seconds)}
            items = sorted(session.items, key=lambda item: number.get(item.nodeid, -1))
            run_until_one_fails(session, items, self._seconds, self._begun)
        return True


class Answering:
    """Answers requests out of tests that are collected, as a plugin of pytest."""

    def __init__(self, answers: Any) -> None:
        self._answers = answers

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Answer until there are no more requests."""
        items = {item.nodeid: item for item in session.items}
        functions = functions_by_file()
        gc.freeze()  # what is there now stays in memory that the children share

        def judged(request: Any, begun: mmap.mmap) -> int:
            file = Path(request["module"]).absolute()
            if not replaced(functions.get(str(file), []), file):
                return UNLIKE
            run_until_one_fails(session, [items[test] for test in request["tests"]], request["tests"], begun)
            return 1 if session.testsfailed else 0

        for request in map(json.loads, sys.stdin):
            answer(request, self._answers, judged)
        return True


def answer(request: Any, answers: Any, judged: Callable[[Any, mmap.mmap], int]) -> None:
    """Have a child judge a mutant, and answer how it ended and which test it began last."""
    begun = mmap.mmap(-1, NAME)
    with tempfile.TemporaryDirectory(prefix="m-") as folder:
        child = os.fork()
        if child == 0:
            os.setpgid(0, 0)  # not setsid: a pty that a test opens would become its terminal, and end it by a hangup
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            tempfile.tempdir = os.environ["TMPDIR"] = os.environ["XDG_RUNTIME_DIR"] = folder
            try:
                os._exit(judged(request, begun))
            finally:
                os._exit(1)  # no child goes on as its parent, whatever it raises
        status = end_of(child, 2 * COLLECTING + PATIENCE * sum(request["tests"].values()))
    last = begun[:].rstrip(b"\0").decode()
    answers.write(json.dumps({"status": status, "test": last}) + "\n")
    answers.flush()


def end_of(child: int, limit: float) -> int:
    """Return how a child ended; below 0 for a signal. It is killed if it takes longer than the limit, in seconds."""
    deadline = time.monotonic() + limit
    while time.monotonic() < deadline:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(LOOKS)
    os.killpg(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def run_until_one_fails(
    session: pytest.Session, items: Sequence[pytest.Item], usual: Mapping[str, float], begun: mmap.mmap
) -> None:
    """Run tests to the first that fails. One that computes much longer than usual ends the process, by a signal."""
    for item, following in zip(items, [*items, None][1:], strict=True):
        begun[:] = item.nodeid.encode()[:NAME].ljust(NAME, b"\0")
        seconds = PATIENCE * usual.get(item.nodeid, 1.0)
        item.add_marker(pytest.mark.timeout(SHORTEST + seconds), append=False)
        signal.setitimer(signal.ITIMER_VIRTUAL, SHORTEST_COMPUTED + seconds)
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if session.testsfailed:
            return
    signal.setitimer(signal.ITIMER_VIRTUAL, 0)


def functions_by_file() -> dict[str, list[FunctionType]]:
    """Return all functions that there are in this process, by the file that they are of."""
    found: dict[str, list[FunctionType]] = {}
    gc.unfreeze()  # tests/conftest.py has frozen them: `get_objects` leaves out what is frozen
    for one in gc.get_objects():
        if type(one) is FunctionType:  # isinstance asks a weak proxy for its class, which raises if its object is gone
            found.setdefault(one.__code__.co_filename, []).append(one)
    return found


def replaced(functions: Sequence[FunctionType], file: Path) -> bool:
    """Give functions the code that the file has for them now. Returns False if it has none that would fit, or if there
    are no functions: then nothing would be mutated."""
    if not functions:
        return False
    codes = dict(codes_in(compile(file.read_text(), str(file), "exec", dont_inherit=True)))
    try:
        for function in functions:
            function.__code__ = codes[place_of(function.__code__)]
    except (KeyError, ValueError):  # on other lines, or with other variables of the function around it
        return False
    return True


def codes_in(code: CodeType) -> Iterator[tuple[tuple[str, int], CodeType]]:
    """Yield all code in this code, by its place."""
    for one in code.co_consts:
        if isinstance(one, CodeType):
            yield place_of(one), one
            yield from codes_in(one)


def place_of(code: CodeType) -> tuple[str, int]:
    """Return what tells it from other code of its file."""
    return code.co_qualname, code.co_firstlineno


if __name__ == "__main__":
    main()
