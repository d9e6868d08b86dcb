"""One mutant in a copy of the tree: do the tests notice it?"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.work_item import MutationSpec, TestOutcome, WorkerOutcome

from tests.mutation.places import Mutant

FIRST: dict[str, tuple[str, ...]] = {
    "arbiter": ("tests/arbiter", "tests/campaigns", "tests/bus", "tests/planning", "tests/transport"),
    "contract": ("tests/arbiter", "tests/protocols", "tests/testing", "tests/test_mistyped_arguments.py"),
    "wire": ("tests/wire", "tests/protocols", "tests/emulator"),
    "codecs": ("tests/protocols", "tests/handles", "tests/emulator", "tests/test_mistyped_arguments.py"),
    "pump": ("tests/transport", "tests/bus"),
}
"""Where a room's mutants are likeliest to be noticed: asked first, the rest of the tests behind them."""
LONGEST = 1800.0
"""Seconds after which a trial is over. A mutant that makes the tests hang is noticed."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of a mutant: `killed`, `survived`, or `impossible` where the operator changed nothing."""

    outcome: str
    seconds: float
    diff: str


def copied(root: Path, folder: Path) -> Path:
    """A copy of what is committed, where files may be changed."""
    subprocess.run(["git", "clone", "--quiet", "--shared", str(root), str(folder)], check=True)
    return folder


def order_of_tests(room: str, root: Path) -> list[str]:
    """The tests' folders, those of the room first."""
    first = [path for path in FIRST[room] if (root / path).exists()]
    rest = [str(path.relative_to(root)) for path in sorted((root / "tests").iterdir()) if holds_tests(path)]
    return first + [path for path in rest if path not in first and not any(one.startswith(path) for one in first)]


def holds_tests(path: Path) -> bool:
    """Whether pytest finds anything there."""
    return path.name.startswith("test_") if path.is_file() else any(path.rglob("test_*.py"))


def tried(mutant: Mutant, copy: Path, near: bool) -> Verdict:
    """Change the copy, run its tests (`near`: only the room's) to the first failure, and change it back."""
    os.chdir(copy)
    os.environ["PYTHONPATH"] = str(copy)
    os.environ["CI"] = "true"
    start = time.monotonic()
    spec = MutationSpec(mutant.module, mutant.operator, mutant.occurrence, (mutant.line, 0), (mutant.line, 1))
    paths = shlex.join(FIRST[mutant.room] if near else order_of_tests(mutant.room, copy))
    command = f"{shlex.quote(sys.executable)} -m pytest -q -x -p no:cacheprovider {paths}"
    result = mutate_and_test([spec], command, LONGEST)
    if result.worker_outcome is not WorkerOutcome.NORMAL:
        outcome = "impossible"
    else:
        outcome = "survived" if result.test_outcome is TestOutcome.SURVIVED else "killed"
    return Verdict(outcome, round(time.monotonic() - start, 1), result.diff or "")
