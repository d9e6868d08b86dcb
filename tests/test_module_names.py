"""No module hides a name of the standard library."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PUBLIC = {ROOT / "busmaster" / "statistics.py"}
"""A public module that users import as `busmaster.statistics`; nothing in the package imports it."""


@pytest.mark.parametrize("folder", ["busmaster", "tests"])
def test_no_module_takes_the_name_of_a_standard_module(folder: str) -> None:
    taken = {"queue", "trace", "serial", "statistics", "types", "typing", "logging", "random", "time", "signal"}
    names = {path.stem for path in (ROOT / folder).rglob("*.py") if path not in PUBLIC}
    assert not names & taken


def test_no_limit_is_assigned_twice() -> None:
    """The second would silently replace the first, for all who use it."""
    files = (ROOT / "busmaster" / "contract" / "bounds.py", ROOT / "busmaster" / "app" / "bounds.py")
    statements = [node for file in files for node in ast.parse(file.read_text()).body]
    targets = [target for node in statements if isinstance(node, ast.Assign) for target in node.targets]
    names = [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
    assert [name for name, count in Counter(names).items() if count > 1] == ["__all__"]
