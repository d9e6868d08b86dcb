"""Bugs that are planted by hand: a list that fits the code, and a page that says what the list has."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.verification.mutation.planted import LISTS, PAGE, ROOT, Bug, page_text, planted_text, read, try_all

CODE = "def larger(one: int, two: int) -> int:\n    return max(one, two)\n"
TEST = "from code_of_it import larger\n\n\ndef test_larger() -> None:\n    assert larger(1, 2) == 2\n"


def bug(old: str, new: str, test: str = "test_it.py") -> Bug:
    return Bug(file="code_of_it.py", old=old, new=new, bug="a bug", tests=[test], chosen="by hand", first="missed")


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    (tmp_path / "code_of_it.py").write_text(CODE)
    (tmp_path / "test_it.py").write_text(TEST)
    return tmp_path


@pytest.mark.slow
def test_a_bug_that_no_test_notices_is_counted_and_nothing_of_it_stays(
    tree: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert try_all(tree, [bug("max(one, two)", "min(one, two)"), bug("max(one, two)", "max(two, one)")]) == 1
    assert capsys.readouterr().out == "noticed code_of_it.py: a bug\nmissed  code_of_it.py: a bug\n"
    assert (tree / "code_of_it.py").read_text() == CODE


@pytest.mark.parametrize(("old", "new"), [("sum(", "max("), ("one", "two"), ("max", "max")])
def test_a_text_that_is_not_there_just_once_is_an_error(old: str, new: str) -> None:
    with pytest.raises(SystemExit, match=r"code_of_it\.py: a bug: the old text must occur once"):
        planted_text(CODE, bug(old, new))


def test_a_new_text_that_is_not_python_is_an_error() -> None:
    with pytest.raises(SystemExit, match="it is no Python then"):
        planted_text(CODE, bug("    return", "return"))


@pytest.mark.slow
def test_tests_that_fail_without_a_bug_are_an_error(tree: Path) -> None:
    (tree / "test_it.py").write_text(TEST.replace("== 2", "== 1"))
    with pytest.raises(SystemExit, match="the tests fail without a bug"):
        try_all(tree, [bug("max", "min")])


def test_the_page_has_the_bugs_of_the_lists() -> None:
    assert PAGE.read_text() == page_text(), "python -m tests.verification.mutation.planted --page"


@pytest.mark.parametrize("file", LISTS, ids=lambda file: str(file.stem))
def test_each_bug_names_a_file_and_tests_that_there_are(file: Path) -> None:
    for one in read([file]):
        assert one.first in ("noticed", "missed")
        assert (ROOT / one.file).is_file()
        assert one.tests
        for test in one.tests:
            path, _, name = test.partition("::")
            assert name.partition("[")[0] in (ROOT / path).read_text(), f"{one.file}: {one.bug}: there is no {test}"


@pytest.mark.parametrize("file", LISTS, ids=lambda file: str(file.stem))
def test_each_bug_can_be_planted(file: Path) -> None:
    """One whose text is no longer in the code would not be tried, and still count as noticed on the page."""
    wrong = []
    for one in read([file]):
        try:
            planted_text((ROOT / one.file).read_text(), one)
        except SystemExit as error:
            wrong.append(str(error))
    assert wrong == []
