"""The pages of the documentation, read: their blocks of code with the marks before these, headings and links."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
INDEX = ROOT / "docs" / "README.md"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "benchmarks" / "README.md"]
PAGES += sorted((ROOT / "docs").rglob("*.md"))

LINE = re.compile(r"^ *(?:(`{3,})(.*)|<!-- (.*?) -->)$")
LINK = re.compile(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)")
PICTURE = re.compile(r"!\[[^\]]*\]\(([^)\s]+)\)|\bsrc(?:set)?=\"([^\"]+)\"")

REASONS = (
    "needs root",
    "needs hardware",
    "needs openssl",
    "needs the network",
    "needs another machine",
    "needs a browser",
    "needs a terminal",
    "takes long",
)
"""Why a block of commands is not run."""


@dataclass(frozen=True, slots=True)
class Mark:
    """A comment for the tests, such as `<!-- line /dev/ttyUSB0: --protocol hcp2 -->`."""

    name: str
    about: str
    text: str
    number: int


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced block: its language, text and the number of its first line. `marks` are those right before it."""

    page: Path
    language: str
    text: str
    number: int
    marks: tuple[Mark, ...]

    @property
    def place(self) -> str:
        return f"{name_of(self.page)}:{self.number}"

    def said(self, name: str) -> str | None:
        """What the mark of that name says before this block; None where there is none."""
        return next((mark.text for mark in self.marks if mark.name == name), None)


MARKS = {
    "file": re.compile(r"file: (?P<about>[\w./-]+)(?: from (?P<text>[\w./-]+))?"),
    "line": re.compile(r"line (?P<about>\S+): (?P<text>\S.*)"),
    "numbers vary": re.compile(r"numbers vary"),
    "goes on": re.compile(r"goes on"),
    "not run": re.compile(rf"not run: (?P<text>{'|'.join(REASONS)})"),
    "needs": re.compile(r"needs: (?P<text>[\w-]+)"),
}


def mark_of(text: str, page: Path, number: int) -> Mark:
    """Read a comment. Raises ValueError for what is no mark."""
    for name, pattern in MARKS.items():
        if found := pattern.fullmatch(text):
            groups = found.groupdict()
            return Mark(name, groups.get("about") or "", groups.get("text") or "", number)
    raise ValueError(f"{name_of(page)}:{number}: no test knows the mark {text!r}; CONTRIBUTING.md says which there are")


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@cache
def parts(page: Path) -> tuple[Block | Mark, ...]:
    """The blocks of a page, and the marks that stand by themselves, in their order. Raises ValueError."""
    return tuple(_parts(page))


def _parts(page: Path) -> Iterator[Block | Mark]:
    marks: list[Mark] = []
    lines = iter(enumerate(page.read_text().splitlines(), 1))
    for number, line in lines:
        found = LINE.match(line)
        if found and found[3]:
            marks.append(mark_of(found[3], page, number))
            continue
        if found:
            indent, fence, language = line[: line.index("`")], found[1], found[2]
            inside: list[str] = []
            for _, text in lines:
                if text == indent + fence:
                    break
                inside.append(text.removeprefix(indent))
            else:
                raise ValueError(f"{name_of(page)}:{number}: a block without an end")
            yield Block(page, language, "".join(f"{text}\n" for text in inside), number + 1, tuple(marks))
        else:
            yield from marks
        marks = []
    yield from marks


def blocks(page: Path, language: str | None = None) -> list[Block]:
    """The blocks of a page, or those of one language."""
    return [part for part in parts(page) if isinstance(part, Block) and language in (None, part.language)]


@cache
def prose(page: Path) -> str:
    """A page without its blocks."""
    return re.sub(r"^( *)(`{3,}).*?^\1\2$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


@cache
def anchors(page: Path) -> set[str]:
    """What the headings of a page can be linked to by, as code hosts and the site make it."""
    seen: dict[str, int] = {}
    found = set()
    for heading in re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        slug = re.sub(r"[^\w\- ]", "", words.lower()).replace(" ", "-")
        times = seen[slug] = seen.get(slug, -1) + 1
        found.add(f"{slug}-{times}" if times else slug)
    return found


def links(page: Path) -> list[str]:
    """Where the links of a page lead, and where its pictures are."""
    pictures = [first or second for first, second in PICTURE.findall(prose(page))]
    return LINK.findall(prose(page)) + pictures
