"""Which tests are asked about a mutant: those that run what it changes, the quickest first."""

from __future__ import annotations

import ast
import difflib
import json
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from tests.verification.mutation.places import CORE, OUTSIDE

NEAR: dict[str, tuple[str, ...]] = {
    "arbiter": ("tests/arbiter",),
    "contract": ("tests/contract", "tests/protocols", "tests/testing", "tests/test_mistyped_arguments.py"),
    "wire": ("tests/wire", "tests/protocols"),
    "codecs": ("tests/contract", "tests/protocols", "tests/handles", "tests/test_mistyped_arguments.py"),
    "pump": ("tests/transport", "tests/bus"),
    "service": ("tests/app/service", "tests/app/authorisation", "tests/docs/test_reference.py"),
    "outputs": ("tests/app/outputs", "tests/app/config"),
    "config": ("tests/app/config", "tests/app/line", "tests/docs/test_reference.py"),
    "line": ("tests/app/line", "tests/app/config"),
    "interfaces": ("tests/app/interfaces",),
    "cli": ("tests/app/cli",),
    "diagnostics": ("tests/app/diagnostics",),
    "bus": ("tests/bus",),
    "handles": ("tests/handles", "tests/protocols"),
    "transport": ("tests/transport",),
    "capture": ("tests/capture",),
    "emulator": ("tests/emulator", "tests/protocols"),
    "planning": ("tests/planning",),
    "testing": ("tests/testing",),
}
"""The tests of a room: `--near` asks no others."""
FURTHER = (
    "tests/capture",
    "tests/app/config",
    "tests/emulator",
    "tests/planning",
    "tests/app/service",
    "tests/verification/campaigns",
    "tests/verification/proof",
)
"""Those that may notice what a room's own tests do not: with them it is the suite and the proof that are asked."""
FURTHER_OUTSIDE = (
    "tests/app/authorisation",
    "tests/app/config",
    "tests/app/line",
    "tests/app/outputs",
    "tests/app/service",
    "tests/protocols",
)
"""The same for rooms outside the core. Most tests of commands and interfaces run processes, where no line is seen."""


def asked(near: bool, rooms: Collection[str] = tuple(CORE)) -> list[str]:
    """Return the files and folders of all tests that are asked about any mutant of these rooms."""
    further = {*(FURTHER if CORE.keys() & rooms else ()), *(FURTHER_OUTSIDE if OUTSIDE.keys() & rooms else ())}
    paths = {path for room in rooms for path in NEAR[room]} | (set() if near else further)
    return sorted(path for path in paths if not any(Path(path).is_relative_to(other) for other in paths - {path}))


@dataclass(frozen=True, slots=True)
class Measured:
    """What each test takes without a mutant, and which lines it runs."""

    seconds: dict[str, float]
    """By test, as pytest names them."""
    lines: dict[str, dict[int, list[str]]]
    """The tests that run a line, by module and line. The test "" is what runs before the first: the imports."""

    @classmethod
    def read(cls, file: Path) -> Measured:
        """Return what a file says."""
        said = json.loads(file.read_text())
        tests = said["tests"]
        return cls(
            said["seconds"],
            {
                module: {int(line): [tests[number] for number in numbers] for line, numbers in lines.items()}
                for module, lines in said["lines"].items()
            },
        )

    def write(self, file: Path) -> None:
        """Write a file that `read` understands."""
        tests = ["", *self.seconds]
        numbers = {test: number for number, test in enumerate(tests)}
        lines = {
            module: {line: [numbers[test] for test in those] for line, those in lines.items()}
            for module, lines in self.lines.items()
        }
        file.write_text(json.dumps({"seconds": self.seconds, "tests": tests, "lines": lines}))

    def running(self, module: str, lines: Iterable[int]) -> set[str]:
        """Return the tests that run one of these lines; with "" if an import does."""
        known = self.lines.get(module, {})
        return {test for line in lines for test in known.get(line, ())}

    def quickest(self, tests: Iterable[str], paths: Iterable[str]) -> dict[str, float]:
        """Return those of the tests that are of these paths, and their seconds, the quickest first."""
        there = [test for test in tests if any(Path(test.partition("::")[0]).is_relative_to(path) for path in paths)]
        return {test: self.seconds[test] for test in sorted(there, key=self.seconds.__getitem__)}

    def nearest(
        self, tests: Collection[str], near: Iterable[str], further: Iterable[str], limit: float
    ) -> dict[str, float]:
        """Return those of the tests near to the room, then those further away until `limit` seconds, each quickest
        first."""
        found = self.quickest(tests, near)
        beyond = 0.0
        for test, seconds in self.quickest(set(tests) - found.keys(), further).items():
            beyond += seconds
            if beyond > limit:
                break
            found[test] = seconds
        return found


def changed_lines(source: str, mutated: str) -> set[int]:
    """Return the lines of the source that are other ones in what was made of it, with all of their statements."""
    matcher = difflib.SequenceMatcher(None, source.splitlines(), mutated.splitlines(), autojunk=False)
    changed = {
        line
        for what, first, behind, *_ in matcher.get_opcodes()
        for line in range(first + 1, behind + 1)
        if what != "equal"
    }
    return statements_at(source, changed) or changed


def statements_at(source: str, lines: Iterable[int]) -> set[int]:
    """Return all lines of the innermost statements that these lines belong to; of a block, its head."""
    spans = [
        span_of(node) for node in ast.walk(ast.parse(source)) if hasattr(node, "body") or isinstance(node, ast.stmt)
    ]
    found: set[int] = set()
    for line in lines:
        around = [(last - first, first, last) for first, last in spans if first <= line <= last]
        if around:
            _, first, last = min(around)
            found |= set(range(first, last + 1))
    return found


def span_of(node: ast.AST) -> tuple[int, int]:
    """Return the first and the last line of a statement; of a block, of its head."""
    body = getattr(node, "body", None)
    match node:
        case ast.match_case():
            first = node.pattern.lineno
        case ast.stmt() | ast.ExceptHandler():
            first = min([node.lineno, *(one.lineno for one in getattr(node, "decorator_list", ()))])
        case _:
            return (0, 0)
    if isinstance(body, list):
        return first, max(first, body[0].lineno - 1)
    return first, getattr(node, "end_lineno", None) or first
