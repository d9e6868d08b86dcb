"""Each slip changes one place and leaves a program that can be compiled."""

from __future__ import annotations

import ast

import pytest

from tests.verification.mutation.places import ROOMS, files_of, slips_in
from tests.verification.mutation.slips import PREFIX, edits, slipped
from tests.verification.mutation.test_places import ROOT

CASES = [
    ("step", "def f():\n    é = g(1)\n    h(é)\n", ["def f():\n    é = g(1)\n    pass\n"]),
    ("step", "a.b = 1\n", ["pass\n"]),
    ("case", "if a:\n    b()\n", ["if False:\n    b()\n"]),
    ("guard", "if a and b: c()\n", ["if True: c()\n"]),
    ("choice", "x = a if b else c\n", ["x = (a)\n", "x = (c)\n"]),
    ("operand", "x = a and (b or c)\n", ["x = (b or c)\n", "x = (a)\n", "x = a and ((c))\n", "x = a and ((b))\n"]),
    ("truth", "x = a is not None, b.c is None\n", ["x = (a), b.c is None\n", "x = a is not None, (not b.c)\n"]),
    ("handler", "try:\n    a()\nexcept E:\n    b()\n    c()\n", ["try:\n    a()\nexcept E:\n    raise\n"]),
    ("first", "for a in b:\n    c(a)\n    d(a)\n", ["for a in b:\n    c(a)\n    d(a)\n    break\n"]),
    ("first", "x = [f(a) for a in b]\n", ["x = ([f(a) for a in b])[:1]\n"]),
    ("argument", "f(a, b=1, c=2)\n", ["f(a, c=2)\n", "f(a, b=1)\n"]),
    ("call", "x = a.lower() + str(b)\n", ["x = a + str(b)\n", "x = a.lower() + (b)\n"]),
    ("element", "for x in ('a', 'b'): f\n", ["for x in ('b',): f\n", "for x in ('a',): f\n"]),
    ("element", "x = {1, 2}\n", ["x = {2}\n", "x = {1}\n"]),
    ("order", "if a:\n    b()\n    c = (1,\n        2)\n", ["if a:\n    c = (1, 2)\n    b()\n"]),
]


@pytest.mark.parametrize(("operator", "source", "changed"), CASES)
def test_each_slip_changes_what_its_name_says(operator: str, source: str, changed: list[str]) -> None:
    there = edits(source)[PREFIX + operator]
    assert [slipped(source, PREFIX + operator, place) for place in range(len(there))] == changed


@pytest.mark.parametrize(
    "source",
    ['x = f"{a or b} {c(d=1)}"\n', 'x = """a"""\n', "x = 1\ny = 2\n", "@f(a=1)\nclass A:\n    x = 1\n    y = 2\n"],
)
def test_texts_constants_decorators_and_definitions_are_left_alone(source: str) -> None:
    assert edits(source) == {}


@pytest.mark.slow
@pytest.mark.parametrize("room", ["config", "transport"])
def test_every_slip_of_a_room_is_another_program(room: str) -> None:
    count = 0
    for path in files_of(room, ROOT)[::4]:
        source = path.read_text()
        for mutant in list(slips_in(room, path, ROOT))[::9]:
            count += 1
            changed = slipped(source, mutant.operator, mutant.occurrence)
            assert changed != source
            ast.parse(changed, mutant.module)
    assert count > 20


def test_each_room_has_slips() -> None:
    assert all(any(next(slips_in(room, path, ROOT), None) for path in files_of(room, ROOT)) for room in ROOMS)
