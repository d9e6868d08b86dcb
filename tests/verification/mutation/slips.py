"""Slips: changes that a programmer makes by forgetting a case, an argument or a step, unlike cosmic-ray's operators.

Each edit replaces one piece of the source by another text. The content of f-strings stays as it is, because Python 3.11
reports no places for it, and so do decorators: most of their arguments, such as `slots`, change nothing that is seen.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

PREFIX = "slip/"
"""Begins the name of each operator of this module."""
SIMPLE = (ast.Expr, ast.Assign, ast.AugAssign, ast.AnnAssign, ast.Delete)
"""Statements whose order can be confused."""
ENDS = (ast.Break, ast.Continue, ast.Return, ast.Raise)
"""Statements after which nothing of a block runs."""


@dataclass(frozen=True, slots=True)
class Edit:
    """One change: the text between two places, as (line, column), becomes another one."""

    start: tuple[int, int]
    end: tuple[int, int]
    text: str


def edits(source: str) -> dict[str, list[Edit]]:
    """Return all edits of a source by operator, in the order of the source."""
    tree = ast.parse(source)
    lines = source.encode().splitlines()
    unplaced = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)}
    decorated = (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef | ast.FunctionDef))
    unplaced |= {id(part) for node in decorated for one in node.decorator_list for part in ast.walk(one)}
    found: dict[str, list[Edit]] = {}
    for node in ast.walk(tree):
        if id(node) in unplaced and not isinstance(node, ast.JoinedStr):
            continue
        for operator, place, text in slips_of(node):
            start, end = span_in(lines, place)
            found.setdefault(PREFIX + operator, []).append(Edit(start, end, text))
    for those in found.values():
        those.sort(key=lambda edit: edit.start)
    return found


def slipped(source: str, operator: str, occurrence: int) -> str:
    """Return the source after one edit."""
    edit = edits(source)[operator][occurrence]
    lines = source.splitlines(keepends=True)
    (first, begins), (last, ends) = edit.start, edit.end
    before = "".join(lines[: first - 1]) + lines[first - 1][:begins]
    return before + edit.text + lines[last - 1][ends:] + "".join(lines[last:])


def slips_of(node: ast.AST) -> Iterator[tuple[str, Sequence[ast.AST], str]]:
    """Yield the name, the replaced nodes and the new text of each slip at one node."""
    match node:
        case ast.Expr(value=ast.Call() | ast.Await()) | ast.AugAssign() | ast.Delete() | ast.Raise():
            yield "step", [node], "pass"
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            yield "step", [node], "pass"
        case ast.If(test=test):
            yield "case", [test], "False"
            yield "guard", [test], "True"
        case ast.IfExp(body=body, orelse=orelse):
            yield "choice", [node], f"({ast.unparse(body)})"
            yield "choice", [node], f"({ast.unparse(orelse)})"
        case ast.BoolOp(op=op, values=values):
            for place in range(len(values)):
                rest = values[:place] + values[place + 1 :]
                kept = rest[0] if len(rest) == 1 else ast.BoolOp(op, rest)
                yield "operand", [node], f"({ast.unparse(kept)})"
        case ast.Compare(left=left, ops=[ast.Is() | ast.IsNot() as op], comparators=[ast.Constant(value=None)]):
            yield "truth", [node], f"(not {ast.unparse(left)})" if isinstance(op, ast.Is) else f"({ast.unparse(left)})"
        case ast.ExceptHandler(body=body):
            yield "handler", body, "raise"
        case ast.For(body=body) | ast.AsyncFor(body=body) if not isinstance(body[-1], ENDS):
            yield "first", [body[-1]], f"{indented(body[-1])}\n{' ' * body[-1].col_offset}break"
        case ast.ListComp():
            yield "first", [node], f"({ast.unparse(node)})[:1]"
    if isinstance(node, ast.Call):
        yield from slips_of_call(node)
    if isinstance(node, ast.Set) or (isinstance(node, ast.Tuple | ast.List) and isinstance(node.ctx, ast.Load)):
        yield from slips_of_elements(node)
    for block in (getattr(node, name, None) for name in ("body", "orelse", "finalbody")):
        # The order of definitions in a module or a class changes nothing, or ends the import.
        if isinstance(block, list) and not isinstance(node, ast.Module | ast.ClassDef):
            for one, two in pairwise(block):
                if isinstance(one, SIMPLE) and isinstance(two, SIMPLE) and not (is_text(one) or is_text(two)):
                    yield "order", [one, two], f"{indented(two)}\n{' ' * one.col_offset}{indented(one)}"


def slips_of_call(node: ast.Call) -> Iterator[tuple[str, Sequence[ast.AST], str]]:
    """Yield the slips at a call: an argument that is not passed, and a call that is forgotten."""
    for place in range(len(node.keywords)):
        rest = node.keywords[:place] + node.keywords[place + 1 :]
        yield "argument", [node], ast.unparse(ast.Call(node.func, node.args, rest))
    if len(node.args) == 1 and not node.keywords and not isinstance(node.args[0], ast.Starred | ast.GeneratorExp):
        yield "call", [node], f"({ast.unparse(node.args[0])})"
    if not node.args and not node.keywords and isinstance(node.func, ast.Attribute):
        yield "call", [node], ast.unparse(node.func.value)


def slips_of_elements(node: ast.Set | ast.Tuple | ast.List) -> Iterator[tuple[str, Sequence[ast.AST], str]]:
    """Yield a slip for each forgotten element of a collection of constants."""
    if len(node.elts) < 2 or not all(isinstance(one, ast.Constant | ast.Attribute | ast.Name) for one in node.elts):
        return
    for place in range(len(node.elts)):
        rest = node.elts[:place] + node.elts[place + 1 :]
        kept = ast.Set(rest) if isinstance(node, ast.Set) else type(node)(rest, node.ctx)
        text = ast.unparse(kept)
        yield "element", [node], text if text[0] in "({[" else f"({text})"


def is_text(statement: ast.stmt) -> bool:
    """Return True for a docstring."""
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def indented(statement: ast.stmt) -> str:
    """Return the text of a statement, its further lines indented as it is."""
    return ast.unparse(statement).replace("\n", "\n" + " " * statement.col_offset)


def span_in(lines: Sequence[bytes], nodes: Sequence[ast.AST]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return where the first of these nodes begins and the last one ends, as (line, column) in characters."""
    first, last = nodes[0], nodes[-1]
    assert isinstance(first, ast.expr | ast.stmt)
    assert isinstance(last, ast.expr | ast.stmt)
    end, behind = last.end_lineno or last.lineno, last.end_col_offset or last.col_offset
    before = lines[first.lineno - 1][: first.col_offset]
    return (first.lineno, len(before.decode())), (end, len(lines[end - 1][:behind].decode()))
