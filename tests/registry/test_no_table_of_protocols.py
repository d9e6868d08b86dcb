"""Nothing outside a protocol's folder names it: whatever the rest needs, the registry says."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from busmaster.capture import DISSECTOR
from busmaster.registry import kinds, protocols

PACKAGE = Path(__file__).parents[2] / "busmaster"
NAMES = {name.replace("-", "_") for name in (*kinds(), *(protocol.name for protocol in protocols()))} | {"mint"}
"""Those of the protocols, and of products that speak them."""
EXCEPTED = {
    *("__init__.py", "contract/renames.py"),
    *("app/cli/demo.py", "app/cli/demo_line.py", "app/cli/modbus_tcp.py", "app/interfaces/modbus_tcp.py"),
}
"""The public names; the demo, which shows certain drives; the interface that speaks Modbus to its clients."""
MODULES = [
    path
    for path in sorted(PACKAGE.rglob("*.py"))
    if (name := path.relative_to(PACKAGE).as_posix()) not in EXCEPTED and not name.startswith("protocols/")
]


def words(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Every name and text in the code, with its line. Docstrings and comments may give examples."""
    told = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        for field in ("id", "attr", "arg", "name", "asname", "module", "value"):
            word = getattr(node, field, None)
            if isinstance(word, str) and id(node) not in told:
                yield getattr(node, "lineno", 0), word


def named(word: str) -> set[str]:
    """The protocols that a word names: `MentorDrive`, `hcp2_reader`, "no msc"."""
    parts = {part.lower() for part in re.findall(r"[A-Z]?[a-z]+\d*|[A-Z]+\d*(?![a-z])", word)}
    return {name for name in NAMES if name in parts or name in word.lower().replace("-", "_").split()}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_no_code_outside_the_protocols_folders_names_one(path: Path) -> None:
    found = [f"{line}: {word!r}" for line, word in words(ast.parse(path.read_text())) if named(word)]
    assert not found, f"{path.relative_to(PACKAGE)} names a protocol, which the registry should say: {found}"


def test_the_check_sees_names_in_code_and_lets_docstrings_be() -> None:
    code = 'def f(mentor_line):\n    """Of HCP."""\n    return MscController, {"dc104": 1}, x.microflex\n'
    found = {name for _, word in words(ast.parse(code)) for name in named(word)}
    assert found == {"mentor", "msc", "dc104", "microflex"}


def test_the_dissector_knows_each_protocol_by_its_capture_id() -> None:
    text = DISSECTOR.read_text()
    match = re.search(r"^local (HCP(?:, \w+)*) = (1(?:, \d+)*)$", text, re.MULTILINE)
    assert match is not None
    names = [name.strip().lower().replace("_", "-") for name in match[1].split(",")]
    numbers = [int(number) for number in match[2].split(",")]
    assert dict(zip(names, numbers, strict=True)) == {
        kind.name: kind.capture_id for kind in kinds().values() if kind.capture_id
    }
