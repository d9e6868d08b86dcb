"""No module hides a name of the standard library."""

from __future__ import annotations

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
