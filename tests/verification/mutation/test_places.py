"""What is left out of a mutation run: only what no test could notice."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.verification.mutation.asked import FURTHER, NEAR
from tests.verification.mutation.places import ROOMS, files_of, inert_spans

ROOT = Path(__file__).parents[3]
EQUIVALENT = Path(__file__).with_name("equivalent.json")

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


@pytest.mark.parametrize("room", ROOMS)
def test_each_room_has_files_and_tests(room: str) -> None:
    assert files_of(room, ROOT)
    assert all((ROOT / path).exists() for path in (*NEAR[room], *FURTHER))


def test_a_pattern_that_matches_no_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no file is busmaster/wire/\*\.py: say in ROOMS"):
        files_of("wire", tmp_path)


def test_each_excuse_is_of_lines_that_there_are() -> None:
    gone = [excuse for excuse in json.loads(EQUIVALENT.read_text()) if not _is_there(excuse)]
    assert not gone, "delete them, or say where the lines are now"


def _is_there(excuse: str) -> bool:
    """Whether the lines that an excuse replaces, and the one before, stand in its file one behind the other."""
    name, *lines = excuse.split("\n")
    before = [line[2:].strip() for line in lines if line[:1] in (" ", "-")]
    path = ROOT / name
    if not path.is_file():
        return False
    code = [line.strip() for line in path.read_text().splitlines()]
    return any(code[at : at + len(before)] == before for at in range(len(code) - len(before) + 1))
