"""`python -m tests.verification.mutation.planted`: do the tests notice the bugs that were planted by hand?

    python -m tests.verification.mutation.planted                    # all of them, some minutes
    python -m tests.verification.mutation.planted --only config/ safe  # those with one of these words in file or text
    python -m tests.verification.mutation.planted --page             # write the tables of docs/planted-bugs.md

Each file `planted_*.json` beside this one has the bugs of some rooms: the `file`, the `old` text, which must occur
exactly once in it, the `new` text, what the `bug` is in words, the `tests` that must notice it, how it was `chosen`,
and whether the tests `noticed` or `missed` it at `first`. The tests run in a copy of the working tree, first without a
bug, when they must pass, and then once for each bug, when one of them must fail.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.verification.mutation.places import WITHOUT_BYTECODE

ROOT = Path(__file__).parents[3]
LISTS = sorted(Path(__file__).parent.glob("planted_*.json"))
PAGE = ROOT / "docs" / "planted-bugs.md"
SECTION = "\n## "
"""From the first of these on, the page is made of the lists."""
LONGEST = 120
"""Seconds for one test: a bug may keep it from ending."""
PASSED, FAILED = 0, 1
"""What pytest exits with; everything else says that the tests did not run."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bug:
    """One bug and the tests that must notice it."""

    file: str
    old: str
    new: str
    bug: str
    tests: Sequence[str]
    chosen: str
    first: str
    groups: Sequence[str] = ()
    """The long checks that notice it too, as `groups.py` found."""


def main() -> None:
    """Plant the bugs that were chosen, report each, and exit with 1 unless all are noticed."""
    about = "Are planted bugs noticed?"
    parser = argparse.ArgumentParser(prog="python -m tests.verification.mutation.planted", description=about)
    parser.add_argument("--only", nargs="+", default=[""], help="words, one of which the file or the bug contains")
    parser.add_argument("--page", action="store_true", help="write the tables of the page, and plant nothing")
    parser.add_argument("lists", nargs="*", type=Path, default=LISTS, help="files of bugs (planted_*.json)")
    options = parser.parse_args()
    if options.page:
        PAGE.write_text(page_text())
        return
    bugs = [bug for bug in read(options.lists) if any(word in f"{bug.file} {bug.bug}" for word in options.only)]
    if not bugs:
        parser.error("no bug has one of these words")
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "copy")
        copy_tree(ROOT, copy)
        missed = try_all(copy, bugs)
    say(f"{len(bugs) - missed} of {len(bugs)} noticed")
    sys.exit(missed > 0)


def read(lists: Iterable[Path]) -> list[Bug]:
    """Return the bugs of these files."""
    return [Bug(**fields) for file in lists for fields in json.loads(file.read_text())["bugs"]]


def page_text() -> str:
    """Return the page with its tables as the lists have them now."""
    return PAGE.read_text().partition(SECTION)[0] + "".join(map(section, LISTS))


def section(file: Path) -> str:
    """Return the page's section of one list: how many were missed at first, and each bug with what notices it."""
    lines = [f"{SECTION}{json.loads(file.read_text())['rooms']}\n"]
    bugs = read([file])
    for chosen in dict.fromkeys(bug.chosen for bug in bugs):
        those = [bug for bug in bugs if bug.chosen == chosen]
        missed = sum(bug.first == "missed" for bug in those)
        lines.append(f"Chosen {chosen}: {len(those)}, {missed} of them missed at first.\n")
        also = any(bug.groups for bug in those)
        lines.append(f"| bug | file | at first | noticed by |{' also by |' * also}\n|---|---|---|---|{'---|' * also}")
        for bug in those:
            groups = f" {', '.join(bug.groups) or 'none'} |" * also
            tests = "<br>".join(f"`{test}`" for test in bug.tests)
            lines.append(f"| {bug.bug} | `{bug.file.removeprefix('busmaster/')}` | {bug.first} | {tests} |{groups}")
        lines.append("")
    return "\n".join(lines)


def copy_tree(root: Path, folder: Path) -> None:
    """Copy what git knows of the working tree, or would add."""
    command = ["git", "-C", str(root), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(command, check=True, capture_output=True, text=True).stdout.split("\0"):
        if name and (root / name).is_file():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes((root / name).read_bytes())
            target.chmod((root / name).stat().st_mode)


def try_all(folder: Path, bugs: Sequence[Bug]) -> int:
    """Run each bug's tests with it in the copy, print whether they notice it, and return how many were missed."""
    for bug in bugs:  # a list that no longer fits the code is reported before anything takes long
        planted_text((folder / bug.file).read_text(), bug)
    tests = sorted({test for bug in bugs for test in bug.tests})
    status, output = run_tests(folder, tests)
    if status != PASSED:
        raise SystemExit(f"the tests fail without a bug, or do not run:\n{output[-4000:]}")
    missed = 0
    for bug in bugs:
        with planted(folder, bug):
            status, output = run_tests(folder, bug.tests)
        if status not in (PASSED, FAILED):
            raise SystemExit(f"{bug.file}: {bug.bug}: the tests did not run:\n{output[-4000:]}")
        missed += status == PASSED
        say(f"{'missed ' if status == PASSED else 'noticed'} {bug.file}: {bug.bug}")
    return missed


@contextmanager
def planted(folder: Path, bug: Bug) -> Iterator[None]:
    """Have a bug in the copy."""
    file = folder / bug.file
    text = file.read_text()
    file.write_text(planted_text(text, bug))
    try:
        yield
    finally:
        file.write_text(text)


def planted_text(text: str, bug: Bug) -> str:
    """Return a file's text with the bug in it.

    Raises SystemExit unless the old text occurs exactly once, and the new text is Python: any test notices the rest.
    """
    count = text.count(bug.old)
    if count != 1 or bug.old == bug.new:
        raise SystemExit(f"{bug.file}: {bug.bug}: the old text must occur once, and occurs {count} times: {bug.old!r}")
    changed = text.replace(bug.old, bug.new)
    try:
        compile(changed, bug.file, "exec", dont_inherit=True)
    except SyntaxError as error:
        raise SystemExit(f"{bug.file}: {bug.bug}: it is no Python then: {error}") from None
    return changed


def run_tests(folder: Path, tests: Sequence[str]) -> tuple[int, str]:
    """Run these tests of the copy to the first that fails. Return what pytest exits with, and what it printed."""
    run = subprocess.run(
        [sys.executable, "-B", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", f"--timeout={LONGEST}", *tests],
        cwd=folder,
        env=os.environ | WITHOUT_BYTECODE | {"PYTHONPATH": str(folder), "CI": "true"},
        capture_output=True,
        text=True,
        check=False,
    )
    return run.returncode, run.stdout + run.stderr


def say(text: str) -> None:
    """Print it at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
