"""A run goes on where an earlier one was: what is known is not explored again, and what was open is, with more time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.verification.proof import runs
from tests.verification.proof.runs import is_done, known, to_explore
from tests.verification.proof.worlds import worlds

OPEN: dict[str, Any] = {
    "code": "this",
    "world": "one",
    "closed": False,
    "events": 50,
    "seconds": 30.0,
    "violations": [],
}
CLOSED = {**OPEN, "closed": True, "events": 90}


def test_a_world_is_known_as_far_as_it_was_ever_explored(tmp_path: Path) -> None:
    further = {**OPEN, "events": 60}
    of_other_code = {**CLOSED, "code": "other"}
    file = tmp_path / "found"
    file.write_text("".join(json.dumps(result) + "\n" for result in (further, of_other_code, OPEN)))
    assert known(file, "this") == {"one": further}
    file.write_text("".join(json.dumps(result) + "\n" for result in (CLOSED, further)))
    assert known(file, "this") == {"one": CLOSED}
    assert known(tmp_path / "nothing yet", "this") == {}


@pytest.mark.parametrize(
    ("result", "each", "done"),
    [
        (None, 30.0, False),
        (CLOSED, 60.0, True),
        (OPEN, 30.0, True),
        (OPEN, 60.0, False),
        ({**OPEN, "violations": [{"problem": "R1"}]}, 60.0, True),
    ],
)
def test_a_world_is_begun_again_only_if_more_would_be_found(
    result: dict[str, Any] | None, each: float, done: bool
) -> None:
    assert is_done(result, each) == done


def test_what_was_never_begun_is_explored_before_what_was_left_open() -> None:
    one, other, third = worlds(["quick"])[:3]
    before = {one.name: OPEN, third.name: CLOSED}
    assert to_explore([one, other, third], before, 60.0) == [other, one]


def test_a_folder_without_code_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "EXPLORED", ("busmaster/arbiter", "busmaster/nothing"))
    with pytest.raises(FileNotFoundError, match=r"there is no code in busmaster/nothing: say in EXPLORED"):
        runs.fingerprint()
