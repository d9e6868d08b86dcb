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

NEAR: dict[str, tuple[str, ...]] = {
    "arbiter": ("tests/arbiter",),
    "contract": ("tests/contract", "tests/protocols", "tests/testing", "tests/test_mistyped_arguments.py"),
    "wire": ("tests/wire", "tests/protocols"),
    "codecs": ("tests/contract", "tests/protocols", "tests/test_mistyped_arguments.py"),
    "pump": ("tests/transport", "tests/bus"),
}
"""The tests of a room: `--near` asks no others."""
FURTHER: dict[str, tuple[str, ...]] = {
    "arbiter": ("tests/bus", "tests/campaigns", "tests/planning", "tests/transport"),
    "contract": ("tests/arbiter", "tests/config", "tests/planning"),
    "wire": ("tests/emulator",),
    "codecs": ("tests/handles", "tests/capture", "tests/emulator"),
    "pump": ("tests/real_wire", "tests/doctor"),
}
"""Where a room's mutants are likeliest to be noticed next; the rest of the tests comes behind."""
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
        stages = stages_of(mutant, near, self.folder)
        for stage in stages[:2]:
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
        """Return the seconds that a stage takes without a mutant. Raises RuntimeError if it fails: it could not judge."""
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


def stages_of(mutant: Mutant, near: bool, root: Path) -> list[tuple[str, ...]]:
    """The tests in the order in which they are asked: those named after the module, the room's, and all others."""
    own = [path for path in NEAR[mutant.room] if (root / path).exists()]
    named = [
        str(path.relative_to(root))
        for folder in own
        for path in sorted((root / folder).glob("test_*.py"))
        if set(path.stem.split("_")) & words_of(mutant.module)
    ]
    stages = [tuple(named), tuple(own)]
    if not near:
        further = [path for path in FURTHER[mutant.room] if (root / path).exists()]
        tests = [str(path.relative_to(root)) for path in sorted((root / "tests").iterdir()) if holds_tests(path)]
        stages += [tuple(further), tuple(path for path in tests if path not in own + further)]
    return [stage for stage in stages if stage]


def words_of(module: str) -> set[str]:
    """What the tests of a module may be named after: the module itself, or the protocol whose codec it is."""
    path = Path(module)
    name = path.parent.name.removeprefix("_") if path.parts[1] == "protocols" else path.stem
    return {name, name.removesuffix("s"), *name.split("_")} | ({"hcp", "hcp2"} if name == "comms" else set())


def holds_tests(path: Path) -> bool:
    """Whether pytest finds anything there."""
    return path.name.startswith("test_") if path.is_file() else any(path.rglob("test_*.py"))
