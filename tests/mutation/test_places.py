"""What is left out of a mutation run: only what no test could notice."""

from __future__ import annotations

from tests.mutation.places import inert_spans

SOURCE = '''"""Says what it is."""

from typing import TYPE_CHECKING, Protocol, TypeAlias

if TYPE_CHECKING:
    from a import b

Name: TypeAlias = int | str


class Adder(Protocol):
    @property
    def limit(self) -> int: ...


limit: int | None = 3


def add(one: int | str, two: int = 1 + 1) -> int | None:
    """Say so."""
    return one + two
'''


def inert_texts() -> list[str]:
    """What is left out of SOURCE, as it stands there."""
    lines = SOURCE.splitlines()
    return [
        lines[first[0] - 1][first[1] : last[1] if first[0] == last[0] else None] for first, last in inert_spans(SOURCE)
    ]


def test_annotations_docstrings_and_imports_for_types_are_left_out() -> None:
    assert sorted(inert_texts()) == sorted(
        [
            '"""Says what it is."""',
            "if TYPE_CHECKING:",
            "class Adder(Protocol):",
            "int",
            "TypeAlias",
            "int | str",
            "int | None",
            "int | str",
            "int",
            "int | None",
            '"""Say so."""',
        ]
    )


def test_defaults_and_sums_are_not_left_out() -> None:
    assert not any("1 + 1" in text or "one + two" in text for text in inert_texts())
