"""Explore the worlds: `python -m tests.verification.proof`.

What has been found is written to a file, a line a world, so that a run that was broken off goes on where it was: a
world is explored again only when the code of the core, or of the proof, has changed since, or when it was not closed
and has more time now.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from tests.verification.proof.runs import fingerprint, known, run, table
from tests.verification.proof.worlds import GROUPS, worlds


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.verification.proof", description=__doc__)
    parser.add_argument("--worlds", default=",".join(GROUPS), help=f"groups, of {', '.join(GROUPS)}; or part of a name")
    parser.add_argument("--minutes", type=float, default=30.0, help="for all of them")
    parser.add_argument("--each", type=float, default=60.0, help="seconds of a core for one world")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--file", type=Path, default=Path("proof.jsonl"), help="what was found; read on the next run")
    parser.add_argument("--table", action="store_true", help="print what is known as a table")
    arguments = parser.parse_args()
    groups = [group for group in arguments.worlds.split(",") if group in GROUPS]
    setups = worlds(groups or list(GROUPS))
    if not groups:
        setups = [setup for setup in setups if arguments.worlds in setup.name]
    say = partial(print, flush=True)
    if arguments.table:
        results = known(arguments.file, fingerprint())
        say("\n".join(table(results[setup.name] for setup in setups if setup.name in results)))
        return 0
    results_found = run(setups, arguments.jobs, arguments.minutes, arguments.each, arguments.file, say)
    violations = [violation for result in results_found for violation in result["violations"]]
    for violation in violations:
        say(f"\n{violation['problem']}\n{violation['history']}\n\n{violation['test']}")
    unclosed = sum(not result["closed"] for result in results_found)
    missing = len(setups) - len(results_found)
    say(f"{len(results_found)} worlds, {unclosed} not closed, {missing} not begun, {len(violations)} violations")
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(main())
