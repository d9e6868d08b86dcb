"""Which tests are asked about a mutant: all that run what it changes, the quickest first."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.verification.mutation.asked import (
    FURTHER,
    FURTHER_OUTSIDE,
    NEAR,
    Measured,
    asked,
    changed_lines,
    statements_at,
)
from tests.verification.mutation.places import OUTSIDE, ROOMS

ROOT = Path(__file__).parents[3]
SOURCE = """\
@decorated
def chosen(
    one: int,
    two: int = 2,
) -> int:
    total = (
        one
        + two
    )
    if one < two and (
        two > 3
    ):
        total += 1
    else:
        total -= 1
    match total:
        case 4:
            total = 5
    try:
        return total
    except ValueError:
        return 0
"""


@pytest.mark.parametrize(
    ("line", "those"),
    [
        (1, {1, 2, 3, 4, 5}),
        (4, {1, 2, 3, 4, 5}),
        (8, {6, 7, 8, 9}),
        (11, {10, 11, 12}),
        (13, {13}),
        (15, {15}),
        (17, {17}),
        (18, {18}),
        (20, {20}),
        (21, {21}),
    ],
)
def test_a_line_stands_for_its_statement_or_the_head_of_its_block(line: int, those: set[int]) -> None:
    assert statements_at(SOURCE, {line}) == those


def test_what_is_changed_is_all_of_its_statement() -> None:
    assert changed_lines(SOURCE, SOURCE.replace("+ two", "- two")) == {6, 7, 8, 9}
    assert changed_lines(SOURCE, SOURCE.replace("@decorated\n", "")) == {1, 2, 3, 4, 5}


def test_the_tests_that_run_a_line_are_asked_the_quickest_first(tmp_path: Path) -> None:
    seconds = {"tests/one/test_a.py::slow": 2.0, "tests/one/test_a.py::quick": 0.1, "tests/onerous/test_b.py::c": 1.0}
    Measured(seconds, {"a.py": {3: list(seconds), 4: ["", "tests/one/test_a.py::slow"]}}).write(tmp_path / "file")
    known = Measured.read(tmp_path / "file")
    assert known.running("a.py", {3}) == set(seconds)
    assert known.running("a.py", {4, 5}) == {"", "tests/one/test_a.py::slow"}
    assert known.running("b.py", {3}) == set()
    assert list(known.quickest(seconds, ["tests/one"])) == ["tests/one/test_a.py::quick", "tests/one/test_a.py::slow"]


def test_of_the_tests_further_away_the_quickest_are_asked_until_their_time_is_over() -> None:
    seconds = {"tests/near/test_a.py::slow": 9.0, **{f"tests/far/test_b.py::{n}": float(n) for n in (3, 2, 1)}}
    known = Measured(seconds, {})
    nearest = [*known.nearest(seconds, ["tests/near"], ["tests/far", "tests/near"], 3.5)]
    assert nearest == ["tests/near/test_a.py::slow", "tests/far/test_b.py::1", "tests/far/test_b.py::2"]
    assert [*known.nearest(seconds, ["tests/near"], [], 3.5)] == ["tests/near/test_a.py::slow"]


def test_every_room_has_its_tests_and_all_that_are_asked_exist() -> None:
    assert set(NEAR) == set(ROOMS)
    assert [path for path in (*asked(near=True), *FURTHER) if not (ROOT / path).exists()] == []
    assert set(asked(near=False)) - set(asked(near=True)) == set(FURTHER)
    further = set(asked(near=False, rooms=list(OUTSIDE))) - set(asked(near=True, rooms=list(OUTSIDE)))
    assert further == {path for path in FURTHER_OUTSIDE if path not in asked(near=True, rooms=list(OUTSIDE))}
