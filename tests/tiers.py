"""Parametrisations of which a part runs by default and the rest with `-m slow`: what each shows is shown in both. The
order of the tests where several processes run them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import islice
from typing import Any

import pytest

LONGEST = (
    "docs/test_blocks.py::test_what_a_page_shows_is_so[docs/tutorial.md]",
    "docs/test_blocks.py::test_what_a_page_shows_is_so[docs/reference/command-line.md]",
    "test_discover.py::test_every_node_of_the_protocol_is_found",
    "test_params.py::test_all_menus_of_a_mentor_are_saved_compared_loaded_and_undone",
    "test_params.py::test_a_set_is_saved_compared_loaded_and_undone_with_lost_replies",
    "proof/test_worlds.py::test_each_world_can_be_explored",
    "proof/test_worlds.py::test_nothing_breaks_a_promise_in_a_world_that_is_explored_to_the_end",
    "campaigns/test_hunts.py::test_nothing_grows_without_bound",
    "mutation/test_planted.py::test_a_bug_that_no_test_notices_is_counted_and_nothing_of_it_stays",
)
"""What the names of the longest tests contain: some take more than 20 s."""


def longest_first(items: Sequence[pytest.Item], workers: int) -> list[pytest.Item]:
    """Return the tests in an order in which each of the workers, of which each gets as many tests in a row, begins with
    some of the longest. Behind one another on one worker, they would run on after all others have ended."""
    longest = [item for item in items if any(name in item.nodeid for name in LONGEST)]
    others = iter([item for item in items if not any(name in item.nodeid for name in LONGEST)])
    ordered: list[pytest.Item] = []
    for worker in range(workers):
        begins = longest[worker::workers]
        share = (len(items) - len(ordered)) // (workers - worker)
        ordered += [*begins, *islice(others, max(share - len(begins), 0))]
    return [*ordered, *others]


def one_by_default(values: Iterable[Any]) -> list[Any]:
    """Return parameters of which the first runs by default; the others are slow."""
    first, *others = values
    return [first, *(pytest.param(value, marks=pytest.mark.slow) for value in others)]


def in_turn_by_default(firsts: Iterable[Any], seconds: Iterable[Any]) -> list[Any]:
    """Return all pairs as parameters. By default each of the seconds runs once, with the next of the firsts in turn;
    the other pairs are slow."""
    turns: Sequence[Any] = list(firsts)
    return [
        pytest.param(first, second, marks=[] if number % len(turns) == turn else [pytest.mark.slow])
        for number, second in enumerate(seconds)
        for turn, first in enumerate(turns)
    ]
