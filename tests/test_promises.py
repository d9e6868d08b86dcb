"""Each promise to users, R1 to R15, is cited where it is shown."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).parent


def citations() -> Iterator[str]:
    """Names of tests, and docstrings of tests, classes and modules: what pytest prints, and what explains it."""
    for path in TESTS.rglob("test_*.py"):
        if path.name == Path(__file__).name:
            continue
        tree = ast.parse(path.read_text())
        yield ast.get_docstring(tree) or ""
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                yield node.name
                yield ast.get_docstring(node) or ""


CITED = {
    int(number) for text in citations() for number in re.findall(r"(?<![A-Za-z0-9])[Rr](\d+)(?![A-Za-z0-9])", text)
}
CITED |= {
    number
    for text in citations()
    for first, last in re.findall(r"\bR(\d+)(?: to |-|\.\.)R(\d+)\b", text)
    for number in range(int(first), int(last) + 1)
}


@pytest.mark.parametrize("number", range(1, 16), ids="R{}".format)
def test_a_promise_is_cited_by_a_test_that_shows_it(number: int) -> None:
    assert number in CITED
