"""Who may import whom, read off the syntax trees. The table is the design's; a new module must find its row here.

Imports under `if TYPE_CHECKING:` are for the type checker alone and bind nothing at run time: they are exempt.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "busmaster"
BASE = {"arguments", "errors", "exchange", "profile"}
HOLDINGS = {"bus", "logbook", "node", "points", "polling", "samples"}
ALL = {entry.stem for entry in PACKAGE.iterdir() if entry.suffix in ("", ".py") and entry.name[0] != "_"}

MAY_IMPORT: dict[str, set[str]] = {
    "errors": set(),
    "arguments": {"errors"},
    "exchange": {"arguments", "errors"},
    "profile": {"arguments", "exchange", "errors"},
    "wire": {"wire"} | BASE,
    "arbiter": {"arbiter"} | BASE,
    "protocols": {"protocols", "wire"} | BASE,
    "merging": BASE,
    "planning": {"planning", "arbiter.schedule", "merging"} | BASE,
    "transport": {"transport", "arbiter"} | BASE,
    "transport.memory": {"transport", "arbiter", "emulator.line"} | BASE,
    **dict.fromkeys(HOLDINGS, HOLDINGS | {"transport", "arbiter", "merging", "planning"} | BASE),
    "handles": {"handles", "protocols"} | HOLDINGS | BASE,
    "emulator": {"emulator", "wire"} | BASE,
    "emulator.world": {"emulator", "wire", "arbiter"} | BASE,
    "outputs": {"outputs", "arbiter"} | HOLDINGS | BASE,
    "config": ALL - {"capture", "testing", "cli"},
    "capture": ALL - {"cli", "config"},
    "testing": ALL - {"cli", "config"},
    "__init__": ALL - {"cli"},
    "__main__": ALL,
    "cli": ALL,
}
TIMELESS = BASE | {"wire", "protocols", "arbiter", "merging", "planning", "emulator"}
TIMELY = {"emulator.serve"}
CLOCKS_AND_PORTS = {"asyncio", "anyio", "time", "random", "socket", "serial"}
SEEDED = {"emulator": {"random"}}
"""The emulator is handed a seeded `random.Random`: it may name the type, and never call the shared generator."""


def modules() -> Iterator[str]:
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        yield ".".join(parts if parts == ("__init__",) or parts[-1] != "__init__" else parts[:-1])


def source_of(module: str) -> Path:
    stem = PACKAGE.joinpath(*module.split("."))
    return stem / "__init__.py" if stem.is_dir() else stem.with_suffix(".py")


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")


def run_time_nodes(node: ast.AST) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and is_type_checking(child):
            yield from run_time_nodes(ast.Module(child.orelse, []))
            continue
        yield child
        yield from run_time_nodes(child)


def imports(module: str) -> Iterator[str]:
    """Absolute dotted names that the module imports when it runs, function bodies included."""
    for node in run_time_nodes(ast.parse(source_of(module).read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} uses a relative import"
            for alias in node.names:
                inner = PACKAGE.parent.joinpath(*f"{node.module}.{alias.name}".split("."))
                is_module = inner.with_suffix(".py").exists() or inner.is_dir()
                yield f"{node.module}.{alias.name}" if is_module else str(node.module)


def row(table: dict[str, set[str]], module: str) -> set[str] | None:
    """The table's entry for the module, else for the package around it."""
    while module:
        if module in table:
            return table[module]
        module = module.rpartition(".")[0]
    return None


def within(module: str, allowed: set[str]) -> bool:
    return any(module == name or module.startswith(f"{name}.") for name in allowed)


@pytest.mark.parametrize("module", list(modules()))
def test_a_module_imports_only_the_layers_below_it(module: str) -> None:
    allowed = row(MAY_IMPORT, module)
    assert allowed is not None, f"{module} has no row in the import table"
    for name in imports(module):
        if name == "busmaster":
            assert module.split(".")[0] in ("cli", "__main__"), f"{module} imports the package's root, a cycle"
        elif name.startswith("busmaster."):
            inner = name.removeprefix("busmaster.")
            assert within(inner, allowed), f"{module} may not import {name}"


@pytest.mark.parametrize("module", [name for name in modules() if within(name, TIMELESS) and not within(name, TIMELY)])
def test_a_pure_module_reads_no_clock_and_opens_no_port(module: str) -> None:
    forbidden = CLOCKS_AND_PORTS - (row(SEEDED, module) or set())
    taken = {name.split(".")[0] for name in imports(module)} & forbidden
    assert not taken, f"{module} imports {', '.join(sorted(taken))}"


@pytest.mark.parametrize("module", [name for name in modules() if within(name, {"emulator"})])
def test_the_emulator_draws_only_from_a_generator_it_was_handed(module: str) -> None:
    for node in ast.walk(ast.parse(source_of(module).read_text())):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "random":
            assert node.attr == "Random", f"{module}:{node.lineno} uses the shared generator random.{node.attr}"
        if isinstance(node, ast.ImportFrom) and node.module == "random":
            assert [alias.name for alias in node.names] == ["Random"], f"{module}:{node.lineno}"


def test_the_checks_see_an_import_inside_a_function_and_skip_one_for_types() -> None:
    tree = ast.parse("if TYPE_CHECKING:\n    import asyncio\nelse:\n    import time\ndef f():\n    import socket\n")
    names = [alias.name for node in run_time_nodes(tree) if isinstance(node, ast.Import) for alias in node.names]
    assert names == ["time", "socket"]


def test_what_the_core_may_import_outside_the_package_is_its_three_dependencies() -> None:
    """The extras stay optional: nothing below the command line and the outputs needs them."""
    optional = {"click", "rich", "textual", "msgspec", "aiomqtt", "prometheus_client", "matplotlib"}
    holders = {"cli", "config", "capture", "outputs", "testing", "__main__"}
    for module in modules():
        if module.split(".")[0] in holders:
            continue
        taken = {name.split(".")[0] for name in imports(module)} & optional
        assert not taken, f"{module} needs {', '.join(sorted(taken))}, which is an extra"
