"""List words and patterns that the style rules out (CONTRIBUTING.md), and sentences of more than 30 words.

`python -m tests.language [PATHS] [--counts]` checks Markdown prose, docstrings, comments and messages. It only reports.
`tests/test_language.py` keeps the paths of `CLEAN` free of findings. Add a path when you have revised it.
"""

import ast
import inspect
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
CHECKED = ["README.md", "CONTRIBUTING.md", "benchmarks/README.md", "docs", "busmaster"]
CLEAN = """busmaster CO*.md README.md SECURITY.md benchmarks/README.md docs/*.md docs/explanation docs/howto
docs/protocols"""
LONGEST = 30
RULES = {  # name: what to look for, in any case
    "person": r"\b(?:no|some)(?:body| one)\b|\bwho(?:m|ever)\b|\bhis\b|\bhe\b|\bhim\b",
    "say": r"\b(?:sa(?:y|ys|id|ying)|t(?:ell|ells|old|elling))\b",
    "ask": r"\bask(?:s|ed|ing)?\b",
    "hear": r"\bhea(?:r|rs|rd|ring)\b",
    "owe": r"\bow(?:e|es|ed|ing)\b|\bdebts?\b|\bstragglers?\b",
    "reckon": r"\breckon\w*|\bmend(?:s|ed|ing|ings)?\b|\bfor the sake of\b",
    "believe": r"\bbeliev\w+|\bdoubt(?:s|ed)\b|\bt(?:ake|akes|aken|aking) (?:\w+ ){0,3}for (?:an?|the|one)\b",
    "door": r"\b(?:doors?|gates?|rooms)\b",
    "old term": r"\b(?:lateness|nominal|byte gaps?|settl(?:e|es|ed|ing)|unasked|legs?|in step)\b",
    "answer": r"\b(?:an?|the|its?|no|each|every|first|late|whose|what) answers?\b|\bresponses?\b",
    "is no": r"(?<!\bthere )\b(?:is|are|was|were|be) no\b(?! longer| more| less)",
    "what": r"\bwhat(?:ever)? (?:is|are|was|were|ha[sd]|have|it|they|you|comes?|goes|can|must|to)\b(?![^.!?]*\?)",
    "be": r"\bto be \w+ed (?:before|for)\b|\bthat there (?:is|are)\b|\bbut for\b|\bhardly\b|\ball else\b",
}
EXCEPTIONS = {  # path: the rules that do not apply to it, and the reason
    "benchmarks/README.md": (["what"], "other pages link to two of its headings"),
    "busmaster/app/outputs/sqlite.py": (["door"], "a column of databases of 0.2"),
    "docs/explanation/words.md": (["answer", "believe", "door", "old term", "owe"], "lists earlier and other terms"),
}


def markdown(text: str) -> Iterator[tuple[int, str]]:
    """Paragraphs, list items and table cells with their line; code becomes one word."""
    text = re.sub(r"^( *)(`{3,}).*?^\1\2$", lambda m: "\n" * m[0].count("\n"), text, flags=re.M | re.S)
    text = re.sub(r"<!--.*?-->", "", re.sub(r"`[^`]+`", "CODE", re.sub(r"(\[[^\]]*\])\([^)]*\)", r"\1", text)))
    start, parts = 1, list[str]()
    for number, line in enumerate([*text.splitlines(), ""], 1):
        if parts and re.match(r"\s*(?:[-*|#>]|\d+\.|$)", line):
            yield start, " ".join(parts)
            parts = []
        if line.lstrip().startswith("|"):
            yield from ((number, cell) for cell in line.split("|"))
        elif line.strip():
            start, parts = (number, [line]) if not parts else (start, [*parts, line])


def python(text: str) -> Iterator[tuple[int, str]]:
    """Docstrings, comments, and strings of three words and more, without literal blocks and tables."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    yield from ((one.start[0], one.string.lstrip("# ")) for one in tokens if one.type == tokenize.COMMENT)
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value.split()) > 2:
            for paragraph in re.split(r"\n\s*\n", re.sub(r"`[^`]+`", "CODE", inspect.cleandoc(node.value))):
                if not re.search(r"^(?: {4}|====)|\n {4}|\S {3,}\S", paragraph):  # a literal block, a table, or SQL
                    yield node.lineno, " ".join(paragraph.split())


def findings(path: Path, *, exceptions: bool = True) -> Iterator[tuple[int, str, str]]:
    """The line, the rule and the words of each finding, by default without the exceptions."""
    excepted = EXCEPTIONS.get(path.relative_to(ROOT).as_posix(), ([], ""))[0] if exceptions else []
    for number, text in (markdown if path.suffix == ".md" else python)(path.read_text()):
        for rule, pattern in RULES.items():
            if rule not in excepted:
                yield from ((number, rule, found[0]) for found in re.finditer(pattern, text, re.I))
        for sentence in re.split(r"(?<=[.!?])[)*\"]*\s+", text):
            words = re.findall(r"[^\W_]\S*", sentence)
            if len(words) > LONGEST and "long" not in excepted:
                yield number, "long", f"{len(words)} words: {' '.join(words[:8])} ..."


def main(arguments: list[str]) -> None:
    counts, show = Counter[str](), sys.stdout.write
    for path in files([word for word in arguments if word != "--counts"] or CHECKED):
        for number, rule, words in findings(path):
            counts[rule] += 1
            show("" if "--counts" in arguments else f"{path.relative_to(ROOT)}:{number}: {rule}: {words}\n")
    show("".join(f"{count:6} {rule}\n" for rule, count in [*counts.most_common(), ("in all", counts.total())]))


def files(paths: Iterable[str]) -> list[Path]:
    found = {file for name in paths for path in ROOT.glob(name) for file in (path, *path.rglob("*.[mp][dy]"))}
    return sorted(file for file in found if file.is_file())


if __name__ == "__main__":
    main(sys.argv[1:])
