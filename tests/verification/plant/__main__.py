"""Faults of a plant, as real processes: `python -m tests.verification.plant`, `--only NAME`, `--minutes 10`.

Without `--minutes`, each fault is made in a plant of its own, and a table says what was lost, counted and told, and
how long it took to recover. With it, the example's line runs for so long with everything on, a fault a minute. Exit
status 1 if anything was lost that was not counted, or wrong.
"""

from __future__ import annotations

import argparse
import sys
import traceback

import pytest

from tests.verification.plant.faults import FAULTS
from tests.verification.plant.long_run import long_run
from tests.verification.plant.report import HEAD, long_report, row
from tests.verification.plant.trial import trial


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.verification.plant", description=__doc__)
    parser.add_argument("--only", action="append", choices=list(FAULTS), metavar="NAME", help="again for several")
    parser.add_argument("--minutes", type=float, metavar="N", help="the long run, for so long")
    parser.add_argument("--list", action="store_true", help="name the faults")
    arguments = parser.parse_args()
    if arguments.list:
        width = max(map(len, FAULTS))
        _say("\n".join(f"{name:{width}}  {fault.name}" for name, fault in FAULTS.items()))
        return 0
    if arguments.minutes:
        run = long_run(arguments.minutes, _tell)
        _say(long_report(run))
        return 1 if run.problems else 0
    bad = 0
    _say(HEAD)
    for name in arguments.only or FAULTS:
        try:
            found = trial(FAULTS[name])
        except pytest.skip.Exception as skipped:
            _say(f"| {FAULTS[name].name} | not tried here: {skipped} |")
        except Exception:
            bad += 1
            _say(f"| {FAULTS[name].name} | **{name} failed** |")
            traceback.print_exc()
        else:
            _say(row(found))
            for problem in found.problems:
                bad += 1
                _tell(f"{name}: {problem}")
    return 1 if bad else 0


def _tell(text: str) -> None:
    sys.stderr.write(f"{text}\n")


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
