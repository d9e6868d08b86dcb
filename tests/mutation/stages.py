"""Which tests are asked about a mutant, and in which order: those likeliest to notice it first."""

from __future__ import annotations

from pathlib import Path

NEAR: dict[str, tuple[str, ...]] = {
    "arbiter": ("tests/arbiter",),
    "contract": ("tests/contract", "tests/protocols", "tests/testing", "tests/test_mistyped_arguments.py"),
    "wire": ("tests/wire", "tests/protocols"),
    "codecs": ("tests/contract", "tests/protocols", "tests/handles", "tests/test_mistyped_arguments.py"),
    "pump": ("tests/transport", "tests/bus"),
}
"""The tests of a room: `--near` asks no others."""
QUICK: dict[str, tuple[str, ...]] = {
    "arbiter": tuple(
        f"tests/arbiter/test_{name}.py"
        for name in (
            "edges",
            "transactions",
            "outcomes",
            "exchanges",
            "in_step",
            "owed",
            "health",
            "settling",
            "unsent",
            "choice",
        )
    )
}
"""Those of a room's tests that take a second together, where the whole room takes ten times as long."""
FURTHER: dict[str, tuple[str, ...]] = {
    "arbiter": ("tests/bus", "tests/campaigns", "tests/planning", "tests/transport"),
    "contract": ("tests/arbiter", "tests/config", "tests/planning"),
    "wire": ("tests/emulator",),
    "codecs": ("tests/capture", "tests/emulator"),
    "pump": ("tests/real_wire", "tests/doctor"),
}
"""Where a room's mutants are likeliest to be noticed next; the rest of the tests comes behind."""


def stages_of(room: str, module: str, near: bool, root: Path) -> list[tuple[str, ...]]:
    """The tests in the order in which they are asked: those named after the module, the room's, and all others."""
    own = [path for path in NEAR[room] if (root / path).exists()]
    named = [
        str(path.relative_to(root))
        for folder in own
        for path in sorted((root / folder).glob("test_*.py"))
        if set(path.stem.split("_")) & words_of(module)
    ]
    stages = [tuple(named), QUICK.get(room, ()), tuple(own)]
    if not near:
        further = [path for path in FURTHER[room] if (root / path).exists()]
        tests = [str(path.relative_to(root)) for path in sorted((root / "tests").iterdir()) if holds_tests(path)]
        stages += [tuple(further), tuple(path for path in tests if path not in own + further)]
    return [stage for stage in stages if stage]


def words_of(module: str) -> set[str]:
    """What the tests of a module may be named after: the module itself, or the protocol whose codec it is."""
    path = Path(module)
    name = path.parent.name.removeprefix("_") if path.parts[1] == "protocols" else path.stem
    return {name, name.removesuffix("s"), *name.split("_")} | ({"hcp", "hcp2"} if name == "comms" else set())


def holds_tests(path: Path) -> bool:
    """Whether pytest finds anything there."""
    return path.name.startswith("test_") if path.is_file() else any(path.rglob("test_*.py"))
