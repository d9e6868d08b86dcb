"""Nothing grows past what can be read at one sitting."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("busmaster", "tests", "benchmarks", "examples")
MODULE_LINES = 500
FUNCTION_LINES = 60

sources = pytest.mark.parametrize(
    "path",
    [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))],
    ids=lambda path: str(path.relative_to(ROOT)),
)


@sources
def test_a_module_has_at_most_500_lines(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= MODULE_LINES


@sources
def test_a_function_has_at_most_60_lines(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno is not None:
            lines = node.end_lineno - node.lineno + 1
            assert lines <= FUNCTION_LINES, f"{node.name}, line {node.lineno}, has {lines} lines"


@pytest.mark.parametrize("folder", ["busmaster", "tests"])
def test_no_module_takes_the_name_of_one_that_others_import(folder: str) -> None:
    taken = {"queue", "trace", "serial", "statistics", "types", "typing", "logging", "random", "time", "signal"}
    names = {path.stem for path in (ROOT / folder).rglob("*.py")}
    assert not names & taken
