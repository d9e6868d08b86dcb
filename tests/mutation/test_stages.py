"""The order in which tests are asked: every one in the end, the nearest first."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.mutation.places import ROOMS
from tests.mutation.stages import FURTHER, NEAR, QUICK, stages_of

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("room", "module", "first"),
    [
        ("arbiter", "busmaster/arbiter/health.py", "tests/arbiter/test_health.py"),
        ("arbiter", "busmaster/arbiter/probes.py", "tests/arbiter/test_probes.py"),
        ("wire", "busmaster/wire/readers.py", "tests/wire/test_readers.py"),
        ("codecs", "busmaster/protocols/ct_ansi/codec.py", "tests/protocols/test_ct_ansi.py"),
        ("codecs", "busmaster/protocols/_comms/codec.py", "tests/protocols/test_hcp2.py"),
        ("codecs", "busmaster/protocols/msc/exchange.py", "tests/protocols/test_msc_exchange.py"),
        ("pump", "busmaster/transport/marks.py", "tests/transport/test_marks.py"),
    ],
)
def test_the_tests_named_after_a_module_are_asked_first(room: str, module: str, first: str) -> None:
    assert first in stages_of(room, module, True, ROOT)[0]


@pytest.mark.parametrize("room", ROOMS)
def test_every_test_is_asked_in_the_end_and_only_the_rooms_if_near(room: str) -> None:
    near = stages_of(room, "busmaster/nothing.py", True, ROOT)
    whole = stages_of(room, "busmaster/nothing.py", False, ROOT)
    assert near[-1] == NEAR[room]
    asked = [path for stage in whole[len(near) - 1 :] for path in stage]
    assert len(asked) == len(set(asked))
    tests = {path.relative_to(ROOT) for path in (ROOT / "tests").rglob("test_*.py")}
    assert not {test for test in tests if not any(test.is_relative_to(path) for path in asked)}


def test_the_tests_that_are_asked_first_exist() -> None:
    for paths in (*NEAR.values(), *QUICK.values(), *FURTHER.values()):
        assert [path for path in paths if not (ROOT / path).exists()] == []
