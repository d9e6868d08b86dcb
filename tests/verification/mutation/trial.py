"""One mutant in a copy of the tree: do the tests notice it?

Those that run what is changed are asked, to the first failure: most mutants die in the first second.
"""

from __future__ import annotations

import difflib
import json
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

from tests.verification.mutation.asked import NEAR, Measured, asked, changed_lines
from tests.verification.mutation.places import WITHOUT_BYTECODE, Mutant
from tests.verification.mutation.slips import PREFIX, slipped
from tests.verification.mutation.warm import UNLIKE


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of a mutant: `killed`, `survived`, or `impossible` where the operator changed nothing."""

    outcome: str
    seconds: float
    test: str
    """The test that noticed it."""
    diff: str


def is_python(code: str) -> bool:
    """Whether it can be compiled: an operator may put `not` before an assignment expression. What Python itself warns
    of, as `is` with a literal, fails in every test run, and in few of those that are asked about a mutant."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            compile(code, "mutant", "exec")
    except SyntaxError:  # a warning becomes one
        return False
    return True


class Copy:
    """A copy of what is committed, where files may be changed, and warm processes that run its tests."""

    def __init__(self, root: Path, folder: Path, rooms: Collection[str]) -> None:
        subprocess.run(["git", "clone", "--quiet", "--shared", str(root), str(folder)], check=True)
        self.folder = folder
        self._rooms = rooms
        self._warm: dict[str, subprocess.Popen[str]] = {}

    def measure(self, near: bool, file: Path) -> None:
        """Write what is known of the tests into a file. Raises RuntimeError if they fail already."""
        process = self._start("measure", str(file), *asked(near, self._rooms))
        if process.wait() != 0:
            raise RuntimeError(f"the tests fail without a mutant:\n{self._said('measure').read_text()[-2000:]}")

    def tried(
        self, mutant: Mutant, near: bool, measured: Measured, limit: float, excused: Callable[[Mutant, str], bool]
    ) -> Verdict:
        """Change the copy, ask its tests (`near`: only the room's) to the first failure, and change it back.

        Of the other tests, the quickest are asked, until `limit` seconds. A mutant that is excused is not tried.
        """
        start = time.monotonic()
        path = self.folder / mutant.module
        source = path.read_text()
        mutated: str | None
        if mutant.operator.startswith(PREFIX):
            mutated = slipped(source, mutant.operator, mutant.occurrence)
        else:
            mutated = mutate_code(source, get_operator(mutant.operator)(), mutant.occurrence)
        if mutated is None or mutated == source or not is_python(mutated):
            return Verdict("impossible", 0.0, "", "")
        diff = "\n".join(difflib.unified_diff(source.splitlines(), mutated.splitlines(), lineterm=""))
        if excused(mutant, diff):
            return Verdict("survived", 0.0, "", diff)
        before = path.stat()
        path.write_text(mutated)
        try:
            test = self._noticed_by(mutant, changed_lines(source, mutated), near, measured, limit)
        finally:
            path.write_text(source)
            os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))  # the compiled original is valid again
        seconds = round(time.monotonic() - start, 1)
        return Verdict("killed" if test else "survived", seconds, test or "", diff)

    def _noticed_by(self, mutant: Mutant, lines: set[int], near: bool, measured: Measured, limit: float) -> str | None:
        """Return the test that notices what is changed now, or None."""
        paths = list(NEAR[mutant.room]) if near else asked(near, self._rooms)
        running = measured.running(mutant.module, lines)
        if "" not in running:
            tests = measured.nearest(running, NEAR[mutant.room], () if near else paths, limit)
            if not tests:
                return None
            answer = self._answer("answer", asked(near, self._rooms), module=mutant.module, tests=tests)
            if answer["status"] != UNLIKE:
                return answer["test"] if answer["status"] else None
        # The near tests first: they are collected anew for each mutant, which takes a tenth of the time of all.
        of_room = measured.quickest(measured.seconds, NEAR[mutant.room])
        tests = measured.nearest(measured.seconds, NEAR[mutant.room], () if near else paths, limit)
        further = {test: seconds for test, seconds in tests.items() if test not in of_room}
        for collected, chosen in ((list(NEAR[mutant.room]), of_room), (paths, further)):
            if chosen:
                answer = self._answer("import", [], paths=collected, tests=chosen)
                if answer["status"]:
                    return answer["test"] or "while they are collected"
        return None

    def _answer(self, what: str, collected: Iterable[str], **request: Any) -> Any:
        """Return what a warm process says to a request. It is started with what it has collected."""
        if what not in self._warm:
            self._warm[what] = self._start(what, *collected)
        process = self._warm[what]
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps(request) + "\n")
        process.stdin.flush()
        line = process.stdout.readline()
        if not line:
            raise RuntimeError(f"the tests have ended:\n{self._said(what).read_text()[-2000:]}")
        return json.loads(line)

    def _start(self, what: str, *arguments: str) -> subprocess.Popen[str]:
        """Start a warm process."""
        return subprocess.Popen(
            [sys.executable, "-m", "tests.verification.mutation.warm", what, str(self._said(what)), *arguments],
            cwd=self.folder,
            env=os.environ | WITHOUT_BYTECODE | {"PYTHONPATH": str(self.folder), "CI": "true"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def _said(self, what: str) -> Path:
        """Return the file that a warm process speaks into."""
        return self.folder.with_name(f"{self.folder.name}-{what}.txt")
