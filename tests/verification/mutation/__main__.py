"""`python -m tests.verification.mutation`: are the tests able to notice a change?

    python -m tests.verification.mutation --count 500 --seed 1 --jobs 2

draws mutants of the arbiter, the contract, the wire, the codecs and the pump, or of other `--rooms`. With `--slips`,
they are what programmers forget: a case, an argument, a step. It asks the tests
about each of them in a copy of what is committed, and writes each verdict into the session's file, from which the same
command goes on after an interruption. `--report` only prints what the file holds. What is measured of the tests first,
once for a commit, is kept beside it. It wants the extra `mutation`.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

from tests.verification.mutation.asked import Measured
from tests.verification.mutation.places import CORE, OUTSIDE, ROOMS, Mutant, drawn
from tests.verification.mutation.trial import Copy, Verdict

ROOT = Path(__file__).parents[3]
EQUIVALENT = Path(__file__).with_name("equivalent.json")
"""Survivors that change nothing anybody can see, or tune what is no promise: each with its reason. Where it is said
only what is replaced, that holds of whatever replaces it and is not noticed."""


def main() -> None:
    """Draw, try what has no verdict yet, and report."""
    about = "Do the tests notice a change?"
    parser = argparse.ArgumentParser(prog="python -m tests.verification.mutation", description=about)
    parser.add_argument("--count", type=int, default=500, help="how many mutants are drawn (500)")
    parser.add_argument("--seed", type=int, default=1, help="which ones (1)")
    parser.add_argument("--jobs", type=int, default=1, help="how many are tried at once (1)")
    parser.add_argument(
        "--rooms", default=",".join(CORE), help=f"of which rooms, of {', '.join(ROOMS)} (those of the core)"
    )
    parser.add_argument(
        "--session", type=Path, help="the file of verdicts (mutation-SEED.jsonl, not in the repository)"
    )
    parser.add_argument(
        "--near", action="store_true", help="ask only the tests nearest to each room: quick, a lower bound"
    )
    parser.add_argument(
        "--limit",
        type=float,
        default=inf,
        metavar="SECONDS",
        help="of the tests that are not near, ask the quickest until so many seconds: a lower bound too (no limit)",
    )
    parser.add_argument(
        "--slips", action="store_true", help="draw slips of programmers (slips.py), not cosmic-ray's operators"
    )
    parser.add_argument("--report", action="store_true", help="only print what the session's file holds")
    options = parser.parse_args()
    session = options.session or ROOT / f"mutation-{options.seed}.jsonl"
    if not options.report:
        rooms = frozenset(options.rooms.split(","))
        if unknown := rooms - set(ROOMS):
            parser.error(f"no such room: {', '.join(sorted(unknown))}; use {', '.join(ROOMS)}")
        mutants = drawn(ROOT, options.count, options.seed, rooms, options.slips)
        known = {key_of(verdict) for verdict in read(session)}
        left = [mutant for mutant in mutants if key_of(mutant.as_fields()) not in known]
        try_all(left, session, options, sorted(rooms))
    report(read(session))


def try_all(mutants: list[Mutant], session: Path, options: argparse.Namespace, rooms: Sequence[str]) -> None:
    """Try them, some at once, each process in a copy of its own, and write each verdict as it comes."""
    with tempfile.TemporaryDirectory() as folder:
        known = measured(Path(folder), options.near, rooms)
        more = (Path(folder), options.near, options.limit, known, rooms)
        with multiprocessing.Pool(options.jobs, start_in_a_copy, more) as pool:
            for number, (mutant, verdict) in enumerate(pool.imap_unordered(judged, mutants), 1):
                with session.open("a") as file:
                    file.write(json.dumps(mutant.as_fields() | asdict(verdict)) + "\n")
                where = f"{mutant.module}:{mutant.line}"
                say(f"{number}/{len(mutants)} {verdict.outcome:8} {verdict.seconds:6.1f} s  {where}  {verdict.test}")


def measured(folder: Path, near: bool, rooms: Sequence[str]) -> Path:
    """Return the file with what is known of the tests of the commit that is checked out; measure them if it is not."""
    command = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    outside = "-outside" if OUTSIDE.keys() & rooms else ""
    file = ROOT / f"mutation-{commit}{'-near' if near else ''}{outside}.json"
    if not file.exists():
        Copy(ROOT, folder / "measured", rooms).measure(near, file)
    return file


COPY: list[Callable[[Mutant], Verdict]] = []
"""How a mutant is tried in the copy of this process."""


def start_in_a_copy(folder: Path, near: bool, limit: float, known: Path, rooms: Sequence[str]) -> None:
    """Make a process its copy."""
    copy = Copy(ROOT, folder / multiprocessing.current_process().name, rooms)
    excuses = excused_changes()

    def excused(mutant: Mutant, diff: str) -> bool:
        return is_excused(mutant.as_fields() | {"diff": diff}, excuses)

    COPY.append(partial(copy.tried, near=near, measured=Measured.read(known), limit=limit, excused=excused))


def judged(mutant: Mutant) -> tuple[Mutant, Verdict]:
    """Try it in this process's copy."""
    return mutant, COPY[0](mutant)


def excused_changes() -> dict[str, str]:
    """Return the reasons of excuses, by what they excuse."""
    found: dict[str, str] = json.loads(EQUIVALENT.read_text()) if EQUIVALENT.exists() else {}
    return found


def is_excused(verdict: dict[str, Any], excuses: Mapping[str, str]) -> bool:
    """Return whether a mutant is excused: it changes nothing that a user could see, or what is only tuned."""
    return changed(verdict) in excuses or replaced_in(verdict) in excuses


def read(session: Path) -> list[dict[str, Any]]:
    """The verdicts so far."""
    return [json.loads(line) for line in session.read_text().splitlines()] if session.exists() else []


def say(text: str) -> None:
    """Print it at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def key_of(fields: dict[str, Any]) -> tuple[Any, ...]:
    """What tells one mutant from another."""
    return tuple(fields[name] for name in ("module", "operator", "occurrence"))


def report(verdicts: Iterable[dict[str, Any]]) -> None:
    """Print each room's score, and the survivors that are not known to be equivalent."""
    excuses = excused_changes()
    counts: Counter[tuple[str, str]] = Counter()
    survivors = []
    for verdict in verdicts:
        outcome = verdict["outcome"]
        if outcome == "survived" and is_excused(verdict, excuses):
            outcome = "excused"
        if outcome == "survived":
            survivors.append(verdict)
        counts[verdict["room"], outcome] += 1
    for verdict in survivors:
        say(f"\n{verdict['operator']} in line {verdict['line']} of {changed(verdict)}")
    say(f"\n{'room':10} {'killed':>7} {'excused':>8} {'survived':>9} {'score':>7}")
    for room in [*ROOMS, "all"]:
        killed, excused_ones, survived = (
            sum(count for (where, what), count in counts.items() if what == outcome and room in (where, "all"))
            for outcome in ("killed", "excused", "survived")
        )
        judged_ones = killed + survived
        if judged_ones:
            say(f"{room:10} {killed:7} {excused_ones:8} {survived:9} {killed / judged_ones:7.1%}")


def changed(verdict: dict[str, Any]) -> str:
    """A survivor's module, its changed lines and the one before, without numbers: an excuse outlives their moving."""
    lines = [line for line in verdict["diff"].splitlines() if line[:3] not in ("---", "+++") and line[:2] != "@@"]
    first = next(number for number, line in enumerate(lines) if line[:1] in "+-")
    shown = lines[max(first - 1, 0) : first] + [line for line in lines if line[:1] in "+-"]
    return "\n".join([verdict["module"], *(line[:1] + " " + line[1:].strip() for line in shown)])


def replaced_in(verdict: dict[str, Any]) -> str:
    """Return what `changed` does, but for what it was changed to."""
    return "\n".join(line for line in changed(verdict).splitlines() if line[:1] != "+")


if __name__ == "__main__":
    main()
