"""The kinds of outputs that LINE.toml can enable: those of this package, and those that other packages bring.

A kind is one `OutputKind`. A kind of this package is listed in `OWN`; another package names its own by an entry point
in the group `busmaster.outputs`. The module of a kind is imported when a file enables it, not before: an output can
need packages of an extra. docs/adding-an-output.md shows a whole one.
"""

from __future__ import annotations

import warnings
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING

from busmaster import InvalidCommand
from busmaster.app.outputs.base import OutputKind
from busmaster.ext import meant

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "busmaster.outputs"
"""The group of entry points by which a package brings an output. The name of an entry is that of its table."""
OWN = {
    "csv": ("busmaster.app.outputs.files", "CSV"),
    "jsonl": ("busmaster.app.outputs.files", "JSONL"),
    "sqlite": ("busmaster.app.outputs.sqlite", "SQLITE"),
    "mqtt": ("busmaster.app.outputs.mqtt", "MQTT"),
    "metrics": ("busmaster.app.outputs.metrics", "METRICS"),
}
"""The module of each kind of this package, and the name of the kind in that module."""


def names() -> tuple[str, ...]:
    """Return the names of all kinds, this package's first."""
    return (*OWN, *_brought())


@cache
def find(name: str) -> OutputKind:
    """Return the kind of that name. Raises InvalidCommand if there is none, or if its package cannot be used."""
    if name in OWN:
        module, attribute = OWN[name]
        kind = getattr(import_module(module), attribute)
        assert isinstance(kind, OutputKind)
        return kind
    entry = _brought().get(name)
    if entry is None:
        raise InvalidCommand(f"no such output {name!r}; {meant(name, names())}")
    return _loaded(entry)


@cache
def kinds() -> tuple[OutputKind, ...]:
    """Return all kinds. One that cannot be used is left out with a warning."""
    found = [find(name) for name in OWN]
    for name in _brought():
        try:
            found.append(find(name))
        except InvalidCommand as error:
            warnings.warn(str(error), stacklevel=2)
    return tuple(found)


@cache
def _brought() -> dict[str, EntryPoint]:
    from importlib.metadata import entry_points  # importing it takes longer than reading a file

    return {entry.name: entry for entry in sorted(entry_points(group=GROUP)) if entry.name not in OWN}


def _loaded(entry: EntryPoint) -> OutputKind:
    package = f" of {entry.dist.name}" if entry.dist is not None else ""
    try:
        kind = entry.load()
    except Exception as error:  # another package can raise anything
        raise InvalidCommand(
            f"the output {entry.name!r}{package} cannot be imported: {error}; fix or uninstall that package"
        ) from None
    if not isinstance(kind, OutputKind):
        raise InvalidCommand(
            f"the output {entry.name!r}{package} is not an OutputKind but "
            f"{f'the class {kind.__name__}' if isinstance(kind, type) else f'a {type(kind).__name__}'}; "
            "fix or uninstall that package"
        )
    if kind.name != entry.name:
        raise InvalidCommand(
            f"the output {entry.name!r}{package} is an OutputKind of the name {kind.name!r}; "
            "use one name for both, or uninstall that package"
        )
    return kind
