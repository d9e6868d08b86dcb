"""The revised pages have no finding of the language check, and the check finds what it is for."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import language
from tests.language import CLEAN, EXCEPTIONS, ROOT, RULES, files, findings

REVISED = files(CLEAN.split())


@pytest.mark.parametrize("path", REVISED, ids=lambda path: str(path.relative_to(ROOT)))
def test_revised_page_has_no_finding(path: Path) -> None:
    assert [f"{path.name}:{number}: {rule}: {words}" for number, rule, words in findings(path)] == []


@pytest.mark.parametrize(("name", "rule"), [(name, rule) for name, (rules, _) in EXCEPTIONS.items() for rule in rules])
def test_each_exception_is_needed(name: str, rule: str) -> None:
    assert rule in {found for _, found, _ in findings(ROOT / name, exceptions=False)}


BAD = {
    "person": "Somebody reads it.",
    "say": "The page tells it.",
    "ask": "It asked twice.",
    "hear": "It was never heard.",
    "owe": "A reply is owed.",
    "reckon": "It reckons the load.",
    "believe": "It believes the reply.",
    "door": "A door to the line.",
    "old term": "The lateness is long.",
    "answer": "It is the answer.",
    "is no": "This is no number.",
    "what": "It depends on what is sent.",
    "be": "Read all else.",
    "long": "word " * 31,
}


@pytest.mark.parametrize("rule", [*RULES, "long"])
def test_each_rule_finds_a_bad_sentence(rule: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(language, "ROOT", tmp_path)
    (tmp_path / "page.md").write_text(BAD[rule])
    assert [found for _, found, _ in findings(tmp_path / "page.md")] == [rule]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Nobody is there.", [(1, "person", "Nobody")]),
        ("One line\n\n- It is no number.", [(3, "is no", "is no")]),
        ("There is no default, and it is no longer sent.", []),
        ("What is a line? It is a wire.", []),
        ("`nobody asks` is code.", []),
        ("```text\nnobody asks\n```\n\n| It was told | x |", [(5, "say", "told")]),
        ("word " * 31, [(1, "long", "31 words: word word word word word word word word ...")]),
        ("- " + "word " * 30 + "\n- " + "word " * 30, []),
    ],
)
def test_page_is_checked_outside_code(
    text: str, expected: list[tuple[int, str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(language, "ROOT", tmp_path)
    (tmp_path / "page.md").write_text(text)
    assert list(findings(tmp_path / "page.md")) == expected


def test_docstrings_comments_and_messages_are_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(language, "ROOT", tmp_path)
    source = '"""What is owed."""\n\nnobody = 1  # whoever reads\nraise ValueError("this was told before", "asked")\n'
    (tmp_path / "module.py").write_text(source)
    found = {(number, rule) for number, rule, _ in findings(tmp_path / "module.py")}
    assert found == {(1, "owe"), (1, "what"), (3, "person"), (4, "say")}


@pytest.mark.parametrize("text", ["Table {\n    nobody: red;\n}", "q     asks\nEnter told"])
def test_indented_text_and_columns_in_a_string_are_not_checked(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(language, "ROOT", tmp_path)
    (tmp_path / "module.py").write_text(f"STYLE = {text!r}\n")
    assert list(findings(tmp_path / "module.py")) == []


def test_tables_and_literal_blocks_of_a_docstring_are_not_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(language, "ROOT", tmp_path)
    source = '"""Two of them.\n\n    nobody asks it\n\n====  ====\nit is told\n====  ====\n\nIt is owed.\n"""\n'
    (tmp_path / "module.py").write_text(source)
    assert [rule for _, rule, _ in findings(tmp_path / "module.py")] == ["owe"]
