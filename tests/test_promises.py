"""Each promise to users has its section in docs/promises.md, and is cited where it is shown; no other is cited."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TESTS = Path(__file__).parent
PAGE = (ROOT / "docs" / "promises.md").read_text()
SECTIONS = {
    int(number): text for number, text in re.findall(r"^## R(\d+): (.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL)
}
CITATION = re.compile(r"(?<![A-Za-z0-9])[Rr](\d+)(?![A-Za-z0-9])")
SEVERAL = re.compile(r"(?<![A-Za-z0-9])[Rr](\d+)(?: to |_to_|-|\.\.)[Rr](\d+)(?![A-Za-z0-9])")
PARTS = ("Assumes", "Costs", "Tested by")
READ = ("busmaster", "tests", "benchmarks", "examples", "docs")


def cited_in(text: str) -> set[int]:
    """The rules that a text names, one by one or as R1-R4."""
    alone = {int(number) for number in CITATION.findall(text)}
    return alone.union(*(range(int(first), int(last) + 1) for first, last in SEVERAL.findall(text)))


def explanations(path: Path) -> Iterator[str]:
    """Names of tests, and docstrings of tests, classes and modules: what pytest prints, and what explains it."""
    text = path.read_text()
    if not cited_in(text):  # parsing every file takes seconds
        return
    tree = ast.parse(text)
    yield ast.get_docstring(tree) or ""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
            yield ast.get_docstring(node) or ""


@cache
def cited_by_tests() -> dict[int, set[str]]:
    """The files that show each rule."""
    found: dict[int, set[str]] = defaultdict(set)
    for path in TESTS.rglob("test_*.py"):
        if path.name != Path(__file__).name:
            for number in cited_in("\n".join(explanations(path))):
                found[number].add(path.relative_to(ROOT).as_posix())
    return found


def comments(path: Path) -> Iterator[tuple[int, str]]:
    """Lines that may cite a rule: of Python what is not code, and names of tests; of anything else all."""
    text = path.read_text()
    if cited_in(text) <= SECTIONS.keys():
        return
    if path.suffix != ".py":
        yield from enumerate(text.splitlines(), 1)
        return
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.lineno, node.name
    for number, line in enumerate(text.splitlines(), 1):
        yield number, line.partition("#")[2]


def test_the_page_has_fifteen_rules_in_order() -> None:
    assert list(SECTIONS) == list(range(1, 16))


@pytest.mark.parametrize("number", SECTIONS, ids="R{}".format)
def test_rule_has_promise_assumptions_costs_and_tests(number: int) -> None:
    assert re.match(r"[^\n]+\n\n\*\*\S", SECTIONS[number]), f"R{number} does not begin with its promise in bold"
    assert re.findall(r"^\*([A-Z][\w ]+)\*:\s", SECTIONS[number], re.MULTILINE) == list(PARTS)


@pytest.mark.parametrize("number", SECTIONS, ids="R{}".format)
def test_a_rule_is_cited_by_tests_that_show_it(number: int) -> None:
    assert cited_by_tests()[number]


@pytest.mark.parametrize("number", SECTIONS, ids="R{}".format)
def test_the_tests_that_a_rule_names_cite_it(number: int) -> None:
    _, _, tested_by = SECTIONS[number].partition("\n*Tested by*: ")
    named = set(re.findall(r"`(tests/[\w/]+\.py)`", tested_by))
    assert named, f"R{number} names no test"
    assert named <= cited_by_tests()[number], f"R{number}: {sorted(named - cited_by_tests()[number])} do not cite it"


def test_every_rule_that_is_cited_is_on_the_page() -> None:
    unknown = [
        f"{path.relative_to(ROOT)}:{line}: R{number}"
        for room in READ
        for path in sorted((ROOT / room).rglob("*"))
        if path.suffix in (".py", ".md", ".toml", ".lua")
        for line, text in comments(path)
        for number in cited_in(text)
        if number not in SECTIONS
    ]
    assert unknown == []
