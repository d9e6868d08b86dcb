"""Finds the protocols of this package and of other packages."""

from __future__ import annotations

import importlib
import pkgutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from busmaster.contract.arguments import meant
from busmaster.errors import InvalidCommand
from busmaster.registry.protocol import NodeKind, Option, Protocol

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from busmaster.emulator.device import Delay, Device
    from busmaster.emulator.traceable import TraceableMemory

PACKAGE = "busmaster.protocols"
GROUP = "busmaster.protocols"
"""Entry point group for protocols of other packages. Each entry point names a `Protocol`."""


@cache
def protocols() -> tuple[Protocol, ...]:
    """Return all protocols, by name.

    A protocol of another package that cannot be loaded, or whose names are already used, is skipped with a warning.
    """
    from importlib.metadata import entry_points  # its import takes longer than that of all protocols together

    found = list(_own())
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name):
        try:
            found.append(_loaded(entry, found))
        except Exception as error:  # another package may raise anything
            brought = f" of {entry.dist.name}" if entry.dist is not None else ""
            warnings.warn(
                f"the protocol {entry.name!r}{brought} cannot be used: {error}; fix or uninstall what brings it",
                stacklevel=2,
            )
    return tuple(sorted(found, key=lambda protocol: protocol.name))


@cache
def kinds() -> Mapping[str, NodeKind]:
    """Return all kinds of node, by name."""
    every = {kind.name: kind for protocol in protocols() for kind in protocol.kinds}
    return MappingProxyType(dict(sorted(every.items())))


def find(name: str) -> NodeKind:
    """Return the kind of node with this name. Raises InvalidCommand if there is none."""
    kind = kinds().get(name)
    if kind is None:
        raise InvalidCommand(f"no such protocol {name!r}; {meant(name, kinds())}")
    return kind


def make_device(
    name: str,
    address: int,
    *,
    delay: Delay | None = None,
    traceable: TraceableMemory | None = None,
    lively: bool = False,
    **options: Any,
) -> Device:
    """Make an emulated device of a kind; `options` are those of `NodeKind.emulated`.

    Raises InvalidCommand for a kind that does not exist, see `DeviceMaker`.
    """
    from busmaster.emulator.device import Delay  # looking up protocols must not import the emulator

    delay = Delay() if delay is None else delay
    return find(name).make_device(address, delay=delay, traceable=traceable, lively=lively, **options)


def _own() -> Iterator[Protocol]:
    """Yield the protocols of this package, one folder each.

    Folders that begin with an underscore contain code shared by several protocols.
    """
    package = importlib.import_module(PACKAGE)
    for module in pkgutil.iter_modules(package.__path__):
        if not module.name.startswith("_"):
            yield importlib.import_module(f"{PACKAGE}.{module.name}").PROTOCOL


def _loaded(entry: EntryPoint, known: list[Protocol]) -> Protocol:
    protocol = entry.load()
    if not isinstance(protocol, Protocol):
        raise TypeError(f"{entry.value} is not a Protocol")
    _check_unique("name", lambda kind: kind.name, protocol, known)
    _check_unique("capture id", lambda kind: kind.capture_id, protocol, known)
    _check_options(protocol, known)
    return protocol


def _check_options(protocol: Protocol, known: list[Protocol]) -> None:
    """Check that an option of several protocols has the same type. Raises InvalidCommand."""
    taken = {option.name: option.kind for other in known for kind in other.kinds for option in _options(kind)}
    for kind in protocol.kinds:
        for option in _options(kind):
            if taken.get(option.name, option.kind) != option.kind:
                raise InvalidCommand(f"the option {option.name} is a {taken[option.name]} of other protocols")


def _options(kind: NodeKind) -> tuple[Option, ...]:
    return kind.options + kind.read_options


def _check_unique(what: str, value: Callable[[NodeKind], object], protocol: Protocol, known: list[Protocol]) -> None:
    taken = {value(kind) for other in known for kind in other.kinds}
    for kind in protocol.kinds:
        if value(kind) and value(kind) in taken:
            raise InvalidCommand(f"the {what} {value(kind)} is taken")
