"""A mutant's functions do what its file says, without anything being imported anew."""

from __future__ import annotations

import gc
import importlib.util
import io
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from tests.verification.mutation.warm import answer, functions_by_file, replaced

SOURCE = """\
from functools import lru_cache

LIMIT = 3


class Thing:
    @property
    def size(self):
        return 1

    @size.setter
    def size(self, value):
        self.set_to = value + 1


@lru_cache
def cached(one):
    return [one + more for more in (1, 2)]


def within(limit):
    def below(value):
        return value < limit

    return below


below = within(LIMIT)
"""


@pytest.fixture
def module(tmp_path: Path) -> Iterator[ModuleType]:
    file = tmp_path / "mutated_here.py"
    file.write_text(SOURCE)
    spec = importlib.util.spec_from_file_location("mutated_here", file)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["mutated_here"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules["mutated_here"]


def change(module: ModuleType, old: str, new: str) -> bool:
    file = Path(str(module.__file__))
    assert old in SOURCE
    file.write_text(SOURCE.replace(old, new))
    return replaced(functions_by_file()[str(file)], file)


@pytest.mark.slow
def test_functions_that_are_frozen_are_found_and_none_is_not_taken_for_all(module: ModuleType) -> None:
    gc.freeze()
    assert change(module, "value + 1", "value - 1")
    assert not replaced([], Path(str(module.__file__)))


@pytest.mark.slow
def test_methods_are_replaced_and_what_is_cached_and_what_a_function_has_made(module: ModuleType) -> None:
    assert change(module, "value + 1", "value - 1")
    thing = module.Thing()
    thing.size = 5
    assert (thing.size, thing.set_to) == (1, 4)
    assert change(module, "one + more", "one * more")
    assert module.cached(3) == [3, 6]
    assert change(module, "value < limit", "value > limit")
    assert (module.below(4), module.below(2)) == (True, False)


def test_what_is_on_other_lines_or_needs_other_variables_is_not_replaced(module: ModuleType) -> None:
    assert not change(module, "LIMIT = 3\n", "LIMIT = (\n    3)\n")
    assert not change(module, "value < limit", "value < 3")


def test_a_pty_that_a_mutants_test_opens_and_closes_does_not_end_it() -> None:
    def judged(*request: object) -> int:
        controller, terminal = os.openpty()
        os.close(os.open(os.ttyname(terminal), os.O_RDWR))
        os.close(terminal)
        os.close(controller)
        return 0

    answers = io.StringIO()
    answer({"tests": {}}, answers, judged)
    assert json.loads(answers.getvalue()) == {"status": 0, "test": ""}
