"""Which tests begin, where several processes run them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.tiers import LONGEST, longest_first


@pytest.mark.parametrize(("others", "long", "workers"), [(100, 7, 4), (100, 3, 4), (0, 5, 2), (3, 9, 4), (10, 0, 3)])
def test_each_worker_begins_with_the_longest_tests_and_no_test_is_lost(others: int, long: int, workers: int) -> None:
    items: list[Any] = [SimpleNamespace(nodeid=f"other {n}") for n in range(others)]
    items += [SimpleNamespace(nodeid=f"{LONGEST[n % len(LONGEST)]} {n}") for n in range(long)]
    ordered = longest_first(items, workers)
    assert sorted(map(id, ordered)) == sorted(map(id, items))
    begin = 0
    for worker in range(min(workers, long) if others > long else 0):
        assert not ordered[begin].nodeid.startswith("other")
        begin += (len(items) - begin) // (workers - worker)  # as xdist shares them out
    assert [item.nodeid for item in ordered if item.nodeid.startswith("other")] == [f"other {n}" for n in range(others)]


@pytest.mark.parametrize("name", LONGEST)
def test_the_longest_tests_exist(name: str) -> None:
    path, _, test = name.partition("::")
    [file] = [file for file in Path(__file__).parent.rglob("test_*.py") if str(file).endswith(f"/{path}")]
    assert f"def {test.partition('[')[0]}(" in file.read_text()
