"""Who may import whom, read off the syntax trees. docs/architecture.md draws it; a new module must find its row here.

A package that is drawn apart so that it can be read apart is so for its types too: imports for types count.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "busmaster"
BASE = {"contract", "errors"}
"""What a protocol and the arbiter agree on: every room may use it."""
LIBRARY_OF_THE_APPLICATION = {"", "capture", "emulator", "events", "ext", "testing.bench"}
"""The modules of the library that the application imports: the root, `ext`, and four that are public. This list is
frozen: what the application needs beyond it goes into `busmaster.ext`, which is documented and versioned."""
APPLICATION: dict[str, set[str]] = {
    "app.bounds": set(),
    "app.service": {"app.bounds"},
    "app.outputs": {"app.bounds", "app.service"},
    "app.interfaces": {"app.bounds", "app.service"},
    "app.config": {"app.bounds", "app.service", "app.outputs"},
    "app.line": {"app.bounds", "app.config", "app.service", "app.outputs"},
    "app.diagnostics": {"app.config", "app.service"},
    "app.cli": {
        *("app.bounds", "app.config", "app.diagnostics", "app.interfaces", "app.line", "app.outputs", "app.service"),
    },
}
"""The rooms of the application, and which others of them each may import."""
ON_DEMAND = {"app.line.configured_line", "app.service.remote", "app.service.service"}
"""What the root offers of the application. It is imported when it is first used."""

LIBRARY = {entry.stem for entry in PACKAGE.iterdir() if entry.suffix in ("", ".py") and entry.name[0] != "_"} - {
    "app",
    "config",
}
MAY_IMPORT: dict[str, set[str]] = {
    "errors": set(),
    "contract": {"contract"} | BASE,
    "wire": {"wire"} | BASE,
    "arbiter": {"arbiter"} | BASE,
    "planning": {"planning", "arbiter"} | BASE,
    "transport": {"transport", "arbiter"} | BASE,
    "bus": {"bus", "transport", "arbiter", "planning"} | BASE,
    "ext": {"bus", "transport", "arbiter", "planning", "registry"} | BASE,
    "events": {"bus", "arbiter"},
    "statistics": {"bus", "arbiter"},
    "emulator": {"emulator", "wire"} | BASE,
    "emulator.world": {"emulator", "wire", "arbiter"} | BASE,
    "emulator.memory": {"emulator", "transport"} | BASE,
    "registry": {"registry", "bus.handle", "emulator.device", "emulator.traceable"} | BASE,
    "capture": {"capture", "wire", "registry", "transport.files", "transport.clock"} | BASE,
    "testing": LIBRARY - {"protocols"},
    "testing.bench": {"", "testing", "ext", "emulator"} | BASE,
    "__init__": LIBRARY | ON_DEMAND,
    "__main__": {"app.cli"},
    "app": {"app"},
    "config": set(),
    **{room: {room, *others, *LIBRARY_OF_THE_APPLICATION - {""}} for room, others in APPLICATION.items()},
}
OPEN: dict[str, set[str]] = {
    "arbiter": {
        *("arbiter", "backlog", "choice", "clients", "counters", "events", "health", "learned", "on_wire", "schedule"),
        *("shared_backlog", "transaction", "unexpected"),
    },
    "bus": {
        *("alarms", "bus", "exclusive", "handle", "limits", "meaning", "node", "parameters", "points", "polling"),
        *("reads_after_writes", "requester", "samples", "shared_line", "snapshots", "suitability"),
    },
    "capture": {"", "decode", "files", "pcapng", "recorder", "replay", "telegrams"},
    "contract": {
        *("arguments", "bounds", "driver", "exchange", "frames", "items", "learning", "places", "profile", "renames"),
        *("tap", "timing"),
    },
    "emulator": {"", "chance", "device", "faults", "line", "memory", "motion", "serve", "traceable"},
    "errors": {""},
    "events": {""},
    "ext": {""},
    "planning": {"", "merging"},
    "registry": {""},
    "statistics": {""},
    "testing": {"bench"},
    "transport": {
        *(
            "clock",
            "endpoints",
            "files",
            "holders",
            "identity",
            "kernel",
            "pump",
            "reconnect",
            "rfc2217",
            "serial_port",
            "tcp",
        ),
    },
    "wire": {"characters", "checks", "numbers", "readers"},
    "app.bounds": {""},
    "app.cli": {""},
    "app.config": {
        *("", "emulated", "names", "point_section", "points", "recording", "rewriting", "schema", "sections"),
        *("service", "source", "table", "templates"),
    },
    "app.diagnostics": {"adapters", "diagnosis", "examination", "probing", "search", "steps", "uart", "writing"},
    "app.interfaces": {"following", "modbus_tcp", "opcua", "opcua_access", "web"},
    "app.line": {"", "parameter_sets", "points_table", "points_taking"},
    "app.outputs": {"base", "cells", "distributor", "history", "kinds", "settings"},
    "app.service": {
        *("authorisation", "folder", "messages", "payload", "permission", "picture", "record", "refusals", "remote"),
        *("remote_exchanges", "remote_group", "remote_overview", "rights", "service", "tcp", "touches", "values"),
    },
}
"""The modules of each room that other rooms may import; "" is the room itself. The others are its own affair.

A protocol's folder is open to its own, to those that build on it, and to the root, which offers its handles.
"""
LISTENING = {"capture.decode", "contract.frames", "capture.telegrams"}
PARTS: dict[str, set[str]] = {
    "codec": {"wire"} | BASE,
    "handle": {"bus.requester", "bus.parameters", "bus.points", "bus.handle"} | BASE,
    "device": {"wire", "emulator"} | BASE,
    "capture": {"wire"} | LISTENING | BASE,
    "": {"registry"} | BASE,
}
"""What the parts of a protocol may import, beside what `WITHIN` says of its own folder and those it builds on."""
WITHIN = {
    "codec": {"codec"},
    "handle": {"codec", "handle"},
    "device": {"device"},
    "capture": {"codec", "capture"},
    "": {"", "codec", "handle", "capture"},
}
"""A device never imports its master's codec: the two must not share a mistake."""
BUILT_ON = {"ct_ansi": "mentor", "ei_bisynch": "mentor"}
PART_OF = {"mint": "device"}
"""Modules whose name does not end in that of their part. Any other is of the codec: exchanges, and maps as data."""
TIMELESS = BASE | {"wire", "arbiter", "planning", "emulator"}
TIMELY = {"emulator.memory", "emulator.serve"}
CLOCKS_AND_PORTS = {"asyncio", "anyio", "time", "random", "socket", "serial"}
SEEDED = {"emulator": {"random"}}
"""The emulator is handed a seeded `random.Random`: it may name the type, and never call the shared generator."""


@cache
def modules() -> tuple[str, ...]:
    found = (path.relative_to(PACKAGE).with_suffix("").parts for path in sorted(PACKAGE.rglob("*.py")))
    return tuple(".".join(one if one == ("__init__",) or one[-1] != "__init__" else one[:-1]) for one in found)


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


USERS = {"testing.bench"}
"""Modules of the library that use the bus as an application does, by the root's names."""


@cache
def imports(module: str, *, types: bool = False) -> tuple[str, ...]:
    """Absolute dotted names that the module imports when it runs, in functions too; with `types` for them as well."""
    tree = ast.parse(source_of(module).read_text())
    return tuple(imported(module, ast.walk(tree) if types else run_time_nodes(tree)))


def imported(module: str, nodes: Iterable[ast.AST]) -> Iterator[str]:
    """What these nodes of the module import."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} uses a relative import"
            for alias in node.names:
                inner = PACKAGE.parent.joinpath(*f"{node.module}.{alias.name}".split("."))
                is_module = inner.with_suffix(".py").exists() or inner.is_dir()
                yield f"{node.module}.{alias.name}" if is_module else str(node.module)


def part_of(module: str) -> str | None:
    """Which part of a protocol the module is; "" for a folder's own, None for what is in no protocol's folder."""
    folder, _, name = module.removeprefix("protocols.").partition(".")
    if not module.startswith("protocols.") or not folder:
        return None
    part = PART_OF.get(name, name.rpartition("_")[2])
    return part if part in PARTS else "codec"


def folder_of(module: str) -> str:
    return module.split(".")[1]


def builds_on(module: str, other: str) -> bool:
    """A protocol's modules use those of their own folder, of what protocols share, and of the one that it builds on."""
    return folder_of(other).startswith("_") or folder_of(other) in (folder_of(module), BUILT_ON.get(folder_of(module)))


def is_pure(module: str) -> bool:
    part = part_of(module)
    if part is None:
        return within(module, TIMELESS) and not within(module, TIMELY)
    return part in ("codec", "device", "capture")


def row(table: dict[str, set[str]], module: str) -> set[str] | None:
    """The table's entry for the module, else for the package around it."""
    while module:
        if module in table:
            return table[module]
        module = module.rpartition(".")[0]
    return None


def within(module: str, allowed: set[str]) -> bool:
    return any(module == name or module.startswith(f"{name}.") for name in allowed)


def allows(module: str, name: str) -> bool:
    """Whether `module` may import `name`, both without the package's own."""
    part = part_of(module)
    if part is None:
        allowed = row(MAY_IMPORT, module)
        assert allowed is not None, f"{module} has no row in the import table"
        return within(name, allowed)
    other = part_of(name)
    return within(name, PARTS[part]) if other is None else other in WITHIN[part] and builds_on(module, name)


def room_of(module: str) -> str:
    """The room of a module: a package or module of the root's, or of the application's."""
    parts = module.split(".")
    return ".".join(parts[:2]) if parts[0] == "app" else parts[0]


def own_imports(module: str) -> Iterator[str]:
    """What the module imports of this package, without the package's name, for types and in functions too."""
    for name in imports(module, types=True):
        if name.split(".")[0] == "busmaster":
            yield name.removeprefix("busmaster").removeprefix(".")


def test_a_module_imports_only_the_layers_below_it() -> None:
    wrong = [
        f"{module} may not import {name or 'the root'}"
        for module in modules()
        if module != "protocols"
        for name in own_imports(module)
        if not (allows(module, name) if name else room_of(module) in {*APPLICATION, "__main__"} or module in USERS)
    ]
    assert wrong == []


def test_the_application_imports_nothing_of_the_library_but_what_is_listed() -> None:
    taken = {
        name
        for module in modules()
        if room_of(module) in APPLICATION
        for name in own_imports(module)
        if not name.startswith("app.")
    }
    assert taken == LIBRARY_OF_THE_APPLICATION


FACES = ("__init__", "ext", "protocols")
"""What gives users names of many rooms."""


def test_no_room_reaches_into_another() -> None:
    """What a room keeps to itself can be changed without a look at the others."""
    wrong = [
        f"{module} imports {name}, which {room} keeps to itself"
        for module in modules()
        if module not in FACES
        for name in own_imports(module)
        if name and (room := room_of(name)) not in ("protocols", room_of(module))
        if name[len(room) + 1 :] not in OPEN.get(room, ())
    ]
    assert wrong == []


def circles() -> list[set[str]]:
    """Sets of modules that import each other, types included."""
    names = set(modules())
    ways = {module: {name or "__init__" for name in own_imports(module)} & names - {module} for module in names}
    ways["__init__"] -= ON_DEMAND
    reach = {module: reached(ways, module) for module in names}
    found: list[set[str]] = []
    for module in sorted(names):
        circle = {other for other in reach[module] if module in reach[other]}
        if circle and circle not in found:
            found.append(circle)
    return found


def reached(ways: dict[str, set[str]], start: str) -> set[str]:
    """All modules that `start` imports, by whatever way."""
    found: set[str] = set()
    waiting = [start]
    while waiting:
        new = ways[waiting.pop()] - found
        found |= new
        waiting += new
    return found


def test_no_files_import_each_other_in_a_circle() -> None:
    """Not for types either: what is in a circle can only be read, and changed, all at once."""
    assert circles() == []


def test_a_pure_module_reads_no_clock_and_opens_no_port() -> None:
    wrong = [
        f"{module} imports {name}"
        for module in modules()
        if is_pure(module)
        for name in {name.split(".")[0] for name in imports(module)}
        if name in CLOCKS_AND_PORTS - (row(SEEDED, module) or set())
    ]
    assert wrong == []


def test_the_emulator_draws_only_from_a_generator_it_was_handed() -> None:
    wrong = [
        f"{module}:{node.lineno}"
        for module in modules()
        if within(module, {"emulator"}) or part_of(module) == "device"
        for node in ast.walk(ast.parse(source_of(module).read_text()))
        if (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id == "random"
            and node.attr != "Random"
        )
        or (
            isinstance(node, ast.ImportFrom)
            and node.module == "random"
            and [alias.name for alias in node.names] != ["Random"]
        )
    ]
    assert wrong == []


def test_the_checks_see_an_import_inside_a_function_and_skip_one_for_types() -> None:
    tree = ast.parse("if TYPE_CHECKING:\n    import asyncio\nelse:\n    import time\ndef f():\n    import socket\n")
    names = [alias.name for node in run_time_nodes(tree) if isinstance(node, ast.Import) for alias in node.names]
    assert names == ["time", "socket"]


def test_what_the_core_may_import_outside_the_package_is_its_three_dependencies() -> None:
    """The extras stay optional: nothing below the command line and the outputs needs them."""
    optional = {"click", "rich", "textual", "aiomqtt", "prometheus_client", "matplotlib"}
    optional |= {"asyncua", "msgspec", "starlette", "uvicorn", "websockets"}
    wrong = [
        f"{module} needs {name}, which is an extra"
        for module in modules()
        if module.split(".")[0] not in ("app", "capture", "testing")
        for name in {name.split(".")[0] for name in imports(module)} & optional
    ]
    assert wrong == []
