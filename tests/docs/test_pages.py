"""Links on the pages lead somewhere, files are there, every page is found, nothing cites what is not here."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.docs.pages import INDEX, PAGES, ROOT, anchors, blocks, links, name_of, prose

OUTWARD: tuple[str, ...] = ()
"""The addresses beyond the repository to which pages link. No test asks whether they are still there: look yourself."""


BESIDE = [ROOT / name for name in ("CHANGELOG.md", "CODE_OF_CONDUCT.md", "SECURITY.md")]
"""Pages whose links are checked, and nothing else."""


@pytest.mark.parametrize("page", [*PAGES, *BESIDE], ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    for link in links(page):
        path, _, anchor = link.partition("#")
        if "://" in path:
            assert link in OUTWARD, f"{name_of(page)}: {link} is not in OUTWARD"
            continue
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{name_of(page)}: {link} leads nowhere"
        assert target.is_relative_to(ROOT), f"{name_of(page)}: {link} leads out of the repository"
        assert not anchor or anchor in anchors(target), f"{name_of(page)}: {link} names no heading"


def test_each_outward_link_that_is_listed_is_on_a_page() -> None:
    assert {link for page in PAGES for link in links(page) if "://" in link} == set(OUTWARD)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_that_a_page_names_are_there(page: Path) -> None:
    """In `backquotes`, perhaps with others."""
    for words in re.findall(r"`([^`\n]+)`", prose(page)):
        for name in re.findall(r"(?<![\w/.])(?:busmaster|tests|benchmarks|examples|docs)/[\w./-]*", words):
            assert (ROOT / name).exists(), f"{name_of(page)}: there is no {name}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_page_begins_with_its_only_title(page: Path) -> None:
    titles = re.findall(r"^# .*$", prose(page), re.MULTILINE)
    assert len(titles) == 1
    assert prose(page).startswith(titles[0])


@pytest.mark.parametrize("page", [page for page in PAGES if page != INDEX], ids=name_of)
def test_every_page_can_be_found_from_the_index(page: Path) -> None:
    assert page in {(INDEX.parent / link.partition("#")[0]).resolve() for link in links(INDEX)}


def test_the_picture_and_the_table_of_rooms_have_every_room() -> None:
    page = ROOT / "docs" / "architecture.md"
    [picture] = blocks(page, "text")
    folders = (ROOT / "busmaster", ROOT / "busmaster" / "app")
    paths = [path for folder in folders for path in folder.iterdir() if path.suffix in ("", ".py")]
    rooms = {path.stem for path in paths if path.name[0] != "_"} - {"app"}
    listed = re.findall(r"^\| `busmaster/(?:app/)?(\w+)(?:/|\.py)`", prose(page), re.MULTILINE)
    assert set(listed) == rooms
    assert rooms <= set(re.findall(r"\w+", picture.text))


def test_pre_commit_runs_what_the_extras_install_and_fetches_nothing() -> None:
    text = (ROOT / ".pre-commit-config.yaml").read_text()
    hooks = re.findall(r"entry: \.venv/bin/(.*?)(?: --force-exclude)?$", text, re.MULTILINE)
    assert set(hooks) == {"ruff check", "ruff format --check", "mypy"}
    assert re.findall(r"repo: (.*)", text) == ["local"]


def test_workflows_run_the_checks_and_build_the_site_as_a_maintainer_does() -> None:
    workflows = ROOT / ".github" / "workflows"
    checks = (ROOT / ".ci" / "run").read_text()
    assert "- run: .ci/run\n" in (workflows / "ci.yml").read_text()
    [build] = re.findall(r"python -m (sphinx .*) \S*site\"", checks)
    assert f"python -m {build} site\n" in (workflows / "docs.yml").read_text()
    assert f'python -m {build} "$READTHEDOCS_OUTPUT/html"\n' in (ROOT / ".readthedocs.yaml").read_text()


# what is cited

READ_BY_USERS = ("busmaster", "tests", "benchmarks", "examples", "docs")
CITED_NOWHERE = re.compile(
    r"\bDESIGN(\.md)?\b|\bPROTOCOLS(\.md)?\b|\bCLI\.md\b|\b[Ii]ssue #?\d|\((H|G|M|S|D)\d{1,2}\)"
    r"|\b(PUBLISHED in|data from|example from) seeds?\b|\bthe card('s)?\b"
)
"""Papers that are not here. The promises, R1 to R15, are in docs/promises.md."""


def texts() -> Iterator[tuple[str, int, str]]:
    paths = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md", ROOT / "pyproject.toml"]
    for room in READ_BY_USERS:
        paths += [path for path in (ROOT / room).rglob("*") if path.suffix in (".py", ".md", ".toml", ".lua", ".json")]
    for path in paths:
        for number, line in enumerate(path.read_text().splitlines(), 1):
            yield name_of(path), number, line


@pytest.mark.slow
def test_nothing_cites_what_is_not_in_the_repository() -> None:
    """A protocol's own manual may be cited, by its title."""
    found = [
        f"{name}:{number}: {line.strip()}"
        for name, number, line in texts()
        if CITED_NOWHERE.search(line) and name != name_of(Path(__file__))
    ]
    assert found == []
