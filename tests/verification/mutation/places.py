"""What may be mutated, room by room, and a seeded sample of it.

The operators are cosmic-ray's, or the slips of `slips.py`. Left out is what no test can notice: annotations, which are
never evaluated here, what only types are made of, and docstrings.
"""

from __future__ import annotations

import ast
import os
from collections.abc import Collection, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from random import Random
from typing import Any, TypeAlias

from tests.verification.mutation.slips import edits

CORE: dict[str, tuple[str, ...]] = {
    "arbiter": ("busmaster/arbiter/*.py",),
    "contract": ("busmaster/contract/*.py",),
    "wire": ("busmaster/wire/*.py",),
    "codecs": (
        "busmaster/protocols/*/codec.py",
        "busmaster/protocols/*/exchange.py",
        "busmaster/protocols/*/blocks.py",
    ),
    "pump": ("busmaster/transport/pump.py", "busmaster/transport/marks.py"),
}
"""The rooms of the core, by patterns of their files. Their mutants are drawn by default."""
OUTSIDE: dict[str, tuple[str, ...]] = {
    "service": ("busmaster/app/service/*.py",),
    "outputs": ("busmaster/app/outputs/*.py",),
    "config": ("busmaster/app/config/*.py",),
    "line": ("busmaster/app/line/*.py",),
    "interfaces": ("busmaster/app/interfaces/*.py",),
    "cli": ("busmaster/app/cli/*.py",),
    "diagnostics": ("busmaster/app/diagnostics/*.py",),
    "bus": ("busmaster/bus/*.py",),
    "handles": ("busmaster/protocols/*/handle.py",),
    "transport": ("busmaster/transport/*.py",),
    "capture": ("busmaster/capture/*.py", "busmaster/protocols/*/capture.py"),
    "emulator": ("busmaster/emulator/*.py", "busmaster/protocols/*/device.py"),
    "planning": ("busmaster/planning/*.py",),
    "testing": ("busmaster/testing/*.py",),
}
"""The rooms outside the core whose mutants can be drawn. The checks of rights are in the service."""
ROOMS = {**CORE, **OUTSIDE}
WITHOUT_BYTECODE = {"PYTHONDONTWRITEBYTECODE": "1", "PYTHONPYCACHEPREFIX": os.devnull}
"""Environment of tests whose code changes: a change within a second that keeps a file's size would not be compiled. The
second variable keeps tests/conftest.py from caching bytecode all the same."""
IDLE = {"core/ReplaceComparisonOperator_Is_Eq", "core/ReplaceComparisonOperator_IsNot_NotEq"}
"""Operators that change nothing here: `is` compares None, members of enums, and objects that equal only themselves."""

Span: TypeAlias = tuple[tuple[int, int], tuple[int, int]]
"""From the first (line, column) to behind the last."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of one place: the `occurrence`-th that `operator` could make in `module`."""

    room: str
    module: str
    operator: str
    occurrence: int
    line: int

    def as_fields(self) -> dict[str, Any]:
        """The fields by name, for a line of the session's file."""
        return asdict(self)


def places(root: Path, rooms: Collection[str], slips: bool = False) -> Iterator[Mutant]:
    """All mutants of these rooms, in a fixed order; with `slips`, those of `slips.py`."""
    for room in ROOMS:
        if room in rooms:
            for path in files_of(room, root):
                yield from (slips_in if slips else mutants_of)(room, path, root)


def files_of(room: str, root: Path) -> list[Path]:
    """Return the files of a room.

    Raises FileNotFoundError for a pattern that matches none: what moved away would not be mutated, without a word.
    """
    found: set[Path] = set()
    for pattern in ROOMS[room]:
        paths = set(root.glob(pattern))
        if not paths:
            raise FileNotFoundError(f"no file is {pattern}: say in ROOMS where the room {room} is now")
        found |= paths
    return sorted(found)


def mutants_of(room: str, path: Path, root: Path) -> Iterator[Mutant]:
    """All mutants of one file."""
    from cosmic_ray.ast import ast_nodes, get_ast_from_path
    from cosmic_ray.plugins import get_operator, operator_names

    inert = inert_spans(path.read_text())
    nodes = list(ast_nodes(get_ast_from_path(path)))
    found: dict[str, list[Span]] = {}
    for name in sorted(operator_names()):
        kind = get_operator(name)
        if kind.arguments() or name in IDLE:
            continue  # the ones with arguments want a name that somebody has to think of
        family = name.rpartition("_")[0] if "BinaryOperator" in name else name  # an operator's places are its own
        if family not in found:
            found[family] = [span for node in nodes for span in kind().mutation_positions(node)]
        for occurrence, (start, end) in enumerate(found[family]):
            if not any(first <= start and end <= last for first, last in inert):
                yield Mutant(room, str(path.relative_to(root)), name, occurrence, start[0])


def slips_in(room: str, path: Path, root: Path) -> Iterator[Mutant]:
    """All slips of one file."""
    source = path.read_text()
    inert = inert_spans(source)
    for operator, those in edits(source).items():
        for occurrence, edit in enumerate(those):
            if not any(first <= edit.start and edit.end <= last for first, last in inert):
                yield Mutant(room, str(path.relative_to(root)), operator, occurrence, edit.start[0])


def inert_spans(source: str) -> list[Span]:
    """Where annotations, docstrings, protocols and imports for types are: (line, column) from the first to behind the
    last."""
    found: list[ast.AST] = []
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef():
                found += [node.returns] if node.returns else []
            case ast.arg(annotation=ast.expr() as annotation):
                found.append(annotation)
            case ast.AnnAssign():
                found.append(node.annotation)
                if ast.unparse(node.annotation).endswith("TypeAlias") and node.value:
                    found.append(node.value)
            case ast.ClassDef() if any(ast.unparse(base).startswith("Protocol") for base in node.bases):
                found.append(node)
            case ast.If() if "TYPE_CHECKING" in ast.unparse(node.test):
                found.append(node)
            case ast.Expr(value=ast.Constant(value=str())):
                found.append(node)
    return [span_of(node) for node in found]


def span_of(node: Any) -> Span:
    """Where a node is."""
    return (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)


def drawn(root: Path, count: int, seed: int, rooms: frozenset[str], slips: bool = False) -> list[Mutant]:
    """A sample of `count` places, each with one of the changes that could be made there.

    The same for the same seed and the same tree, in an order that is drawn too. A place counts once, however many
    operators would fit: an addition has eleven, and ten of them any test notices.
    """
    changes: dict[tuple[object, ...], list[Mutant]] = {}
    for mutant in places(root, rooms, slips):
        changes.setdefault(place_of(mutant), []).append(mutant)
    chance = Random(seed)
    return [chance.choice(changes[place]) for place in chance.sample(list(changes), min(count, len(changes)))]


def place_of(mutant: Mutant) -> tuple[object, ...]:
    """The place that it changes: operators that replace the same thing by others share it."""
    replaced = mutant.operator.rpartition("_")[0] or mutant.operator
    return mutant.module, replaced, mutant.line, mutant.occurrence
