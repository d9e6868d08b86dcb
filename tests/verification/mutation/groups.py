"""Which long checks notice the bugs planted in the core? `python -m tests.verification.mutation.groups --jobs 2`.

The tests named in `planted_core.json` notice each of them. These checks know nothing of the bugs: the group `quick` of
the proof, hunts in every mix of faults, and sweeps of a standstill. Each runs in a copy of the working tree with one
bug in it, to the first problem. Then the list gets the names of those that found one; it takes an hour of two cores.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from queue import SimpleQueue
from random import Random

from tests.verification.campaigns.hunt import Hunt
from tests.verification.campaigns.kinds import KINDS
from tests.verification.campaigns.mixes import WITHIN
from tests.verification.campaigns.stalls import LENGTHS, cases, run
from tests.verification.mutation.places import WITHOUT_BYTECODE
from tests.verification.mutation.planted import ROOT, Bug, copy_tree, planted, read, say
from tests.verification.proof.explore import Explorer
from tests.verification.proof.worlds import quick

LIST = Path(__file__).with_name("planted_core.json")
SEED = 20261129
TRANSACTIONS = 600
"""Of each hunt: one for every protocol and mix, half of them with learned windows."""
EVERY = 30
"""Of the 298 lengths of a standstill, one in so many."""
EACH = 15.0
"""Seconds of a core for one world."""
LONGEST = 1200
"""Seconds for one group. A bug may keep it from ending, and is noticed then."""


def main() -> None:
    """Ask all groups about all bugs, or one of them about the code as it is."""
    parser = argparse.ArgumentParser(prog="python -m tests.verification.mutation.groups", description=__doc__)
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="bugs at a time")
    parser.add_argument("--ask", choices=list(GROUPS), help="one group, about the code as it is")
    options = parser.parse_args()
    if options.ask:
        problem = next(GROUPS[options.ask](), None)
        say(problem or "no problem")
        sys.exit(problem is not None)
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(options.jobs) as pool:
        copies: SimpleQueue[Path] = SimpleQueue()
        for number in range(options.jobs):
            copy = Path(folder, str(number))
            copy_tree(ROOT, copy)
            copies.put(copy)
        # Otherwise a check that fails, or does not run at all, would seem to notice every bug.
        if failing := [group for group in GROUPS if _notices(copy, group)]:
            raise SystemExit(f"without a bug, these checks find a problem or do not run: {', '.join(failing)}")
        found = pool.map(lambda bug: _noticing(copies, bug), read([LIST]))
        fields = json.loads(LIST.read_text())
        for bug, groups in zip(fields["bugs"], found, strict=True):
            bug["groups"] = groups
            LIST.write_text(json.dumps(fields, indent=1, ensure_ascii=False) + "\n")


def _noticing(copies: SimpleQueue[Path], bug: Bug) -> list[str]:
    copy = copies.get()
    try:
        with planted(copy, bug):
            groups = [group for group in GROUPS if _notices(copy, group)]
    finally:
        copies.put(copy)
    say(f"{', '.join(groups) or 'none':24} {bug.file}: {bug.bug}")
    return groups


def _notices(copy: Path, group: str) -> bool:
    command = [sys.executable, "-B", "-m", "tests.verification.mutation.groups", "--ask", group]
    environment = os.environ | WITHOUT_BYTECODE | {"PYTHONPATH": str(copy)}
    try:
        done = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, check=False, timeout=LONGEST
        )
    except subprocess.TimeoutExpired:
        return True
    return done.returncode != 0


def _of_worlds() -> Iterator[str]:
    """Violations in the worlds of `quick`."""
    for setup in quick():
        for problem in Explorer(setup).run(EACH).violations:
            yield f"{setup.name}: {problem}"


def _of_hunts() -> Iterator[str]:
    """Broken rules in hunts."""
    hunts = list(product(KINDS, [mix.name for mix in WITHIN]))
    Random(SEED).shuffle(hunts)
    for number, (protocol, mix) in enumerate(hunts):
        for problem in Hunt(protocol, mix, SEED, learned=number % 2 == 0).run(TRANSACTIONS).problems:
            yield f"{protocol}/{mix}/{SEED}: {problem}"


def _of_stalls() -> Iterator[str]:
    """Wrong outcomes of standstills."""
    for case in cases(list(KINDS), LENGTHS[::EVERY]):
        _, outcome = run(case)
        for problem in outcome.wrong:
            yield f"{case}: {problem}"


GROUPS: dict[str, Callable[[], Iterator[str]]] = {"quick": _of_worlds, "hunts": _of_hunts, "stalls": _of_stalls}

if __name__ == "__main__":
    main()
