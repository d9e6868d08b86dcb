"""One mutant in a copy of the tree: do the tests notice it?

They are asked in stages, the nearest first, each to its first failure: most mutants die in the first second.
"""

from __future__ import annotations

import difflib
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

from tests.mutation.places import Mutant
from tests.mutation.stages import stages_of

PATIENCE = 5.0
"""Times the usual run, after which a trial is over: a mutant that makes the tests hang is noticed."""
LONGEST = 1800.0
"""Seconds of the usual run: it is not known yet."""
SHORTEST = 10.0
"""Seconds that every trial may take: others compute too."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of a mutant: `killed`, `survived`, or `impossible` where the operator changed nothing."""

    outcome: str
    seconds: float
    diff: str


class Copy:
    """A copy of what is committed, where files may be changed, and a warm process that runs its tests."""

    def __init__(self, root: Path, folder: Path) -> None:
        subprocess.run(["git", "clone", "--quiet", "--shared", str(root), str(folder)], check=True)
        self.folder = folder
        self._said = folder.with_name(f"{folder.name}.txt")
        self._usual: dict[tuple[str, ...], float] = {}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.mutation.warm", str(self._said)],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(folder), "CI": "true"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def tried(self, mutant: Mutant, near: bool) -> Verdict:
        """Change the copy, run its tests (`near`: only the room's) to the first failure, and change it back."""
        stages = stages_of(mutant.room, mutant.module, near, self.folder)
        for stage in stages_of(mutant.room, mutant.module, True, self.folder):
            self.usual(stage)
        start = time.monotonic()
        path = self.folder / mutant.module
        source = path.read_text()
        mutated = mutate_code(source, get_operator(mutant.operator)(), mutant.occurrence)
        if mutated is None or mutated == source:
            return Verdict("impossible", 0.0, "")
        before = path.stat()
        path.write_text(mutated)
        try:
            passes = all(self.passes(stage, self._usual.get(stage, LONGEST)) for stage in stages)
        finally:
            path.write_text(source)
            os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))  # the compiled original is valid again
        diff = difflib.unified_diff(source.splitlines(), mutated.splitlines(), lineterm="")
        return Verdict("survived" if passes else "killed", round(time.monotonic() - start, 1), "\n".join(diff))

    def usual(self, stage: tuple[str, ...]) -> float:
        """Return the seconds that a stage takes without a mutant. Raises RuntimeError if it fails then already."""
        if stage not in self._usual:
            start = time.monotonic()
            if not self.passes(stage, LONGEST, keeps=True):
                raise RuntimeError(f"the tests fail without a mutant:\n{self._said.read_text()[-2000:]}")
            self._usual[stage] = time.monotonic() - start
        return self._usual[stage]

    def passes(self, stage: tuple[str, ...], usual: float, keeps: bool = False) -> bool:
        """Run tests, and return whether all passed in time; `keeps` what is compiled for the next run."""
        request: IO[str] | None = self._process.stdin
        answer: IO[str] | None = self._process.stdout
        assert request is not None
        assert answer is not None
        limit = SHORTEST + PATIENCE * usual
        request.write(json.dumps([limit, keeps, "-q", "-x", "-p", "no:cacheprovider", *stage]) + "\n")
        request.flush()
        return int(answer.readline()) == 0
