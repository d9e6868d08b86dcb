"""The worlds that continuous integration holds: no promise is broken in them, and they are explored to the end."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.verification.proof.explore import Explorer
from tests.verification.proof.history import retell, told
from tests.verification.proof.setups import NAKS, Setup
from tests.verification.proof.worlds import GROUPS, quick, worlds

LIMIT = 600.0
"""Seconds for one world: a few of an idle core, and a busy one is ten times slower."""


def in_tiers() -> Iterator[Any]:
    """The first world by default. Before a release: the largest ones, whose refusals Modbus has in CI too, and those
    of protocols that frame their replies as another one does."""
    for number, setup in enumerate(quick()):
        large = setup.may(NAKS) and setup.kind != "modbus"
        large = large or (setup.in_sync and setup.kind in ("microflex", "ct-ansi"))
        yield pytest.param(setup, marks=[pytest.mark.exhaustive] if large else [pytest.mark.slow] if number else [])


@pytest.mark.timeout(LIMIT + 30)
@pytest.mark.parametrize("setup", list(in_tiers()), ids=lambda setup: setup.name)
def test_nothing_breaks_a_promise_in_a_world_that_is_explored_to_the_end(setup: Setup) -> None:
    found = Explorer(setup).run(LIMIT)
    for problem, histories in found.violations.items():
        calls = retell(setup, histories, problem)
        pytest.fail(f"{problem}\n{told(calls) if calls is not None else histories[0]}")
    assert found.closed


def test_each_world_has_a_name_of_its_own() -> None:
    named = [setup for group in GROUPS for setup in GROUPS[group]()]
    assert len({setup.name for setup in named}) == len(set(named))
    assert {setup.name for setup in worlds(list(GROUPS))} == {setup.name for setup in named}


@pytest.mark.slow
def test_each_world_can_be_explored() -> None:
    """Not to the end: each can be begun, saved and restored. Once, nobody noticed that those of sequences could not."""
    for setup in worlds(list(GROUPS)):
        seconds = 1.0 if setup.longest_hold > 0 else 0.05  # a sequence must have ended
        assert Explorer(setup).run(seconds).events, setup.name
