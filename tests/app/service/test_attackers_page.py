"""docs/attackers.md holds what was measured, put there by the tool that measures."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.app.service.attackers import HEAD, KINDS, Outcome, attack_of, row, with_rows

PAGE = Path(__file__).parents[3] / "docs" / "attackers.md"
OUTCOME = Outcome(0.75, 0.95, 20, 0.2, 19, 0.5, 0, 45.0, True)


def test_a_row_replaces_its_own_and_stands_in_the_order_of_the_attacks() -> None:
    first, second, third = list(KINDS)[:3]
    page = f"above\n{HEAD}| {third} | old |\n| {first} | old |\n\nbelow\n"
    page = with_rows(page, {second: row(second, OUTCOME)})
    page = with_rows(page, {third: row(third, OUTCOME)})
    assert page == f"above\n{HEAD}| {first} | old |\n{row(second, OUTCOME)}\n{row(third, OUTCOME)}\n\nbelow\n"


def test_a_page_without_a_place_for_the_table_is_left_alone() -> None:
    with pytest.raises(SystemExit, match="no place"):
        with_rows("a page\n", {})


def test_the_page_shows_at_least_twenty_attacks_that_there_are() -> None:
    text = PAGE.read_text()
    assert with_rows(text, {}) == text
    shown = [attack_of(line) for line in text.partition(HEAD)[2].splitlines() if line.startswith("|")]
    assert len(shown) > 20
    assert set(shown) <= set(KINDS)
