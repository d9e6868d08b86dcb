"""Finding the protocols: those in this package, and those that other packages bring."""

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
"""The group of entry points by which a package brings a protocol. Each names a `Protocol`."""


@cache
def protocols() -> tuple[Protocol, ...]:
    """Return all protocols, by name.

    A protocol of another package that cannot be loaded, or whose names are taken, is left out with a warning.
    """
    from importlib.metadata import entry_points  # it takes longer to import than all protocols together

    found = list(_own())
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name):
        try:
            found.append(_loaded(entry, found))
        except Exception as error:  # whatever another package does
            brought = f" of {entry.dist.name}" if entry.dist is not None else ""
            warnings.warn(
                f"the protocol {entry.name!r}{brought} cannot be used: {error}; fix or uninstall what brings it",
                stacklevel=2,
            )
    return tuple(sorted(found, key=lambda protocol: protocol.name))


@cache
def kinds() -> Mapping[str, NodeKind]:
    """Return every kind of node that there is, by name."""
    every = {kind.name: kind for protocol in protocols() for kind in protocol.kinds}
    return MappingProxyType(dict(sorted(every.items())))


def find(name: str) -> NodeKind:
    """Return the kind of node that goes by a name. Raises InvalidCommand if there is none."""
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
    from busmaster.emulator.device import Delay  # naming protocols loads no emulated device

    delay = Delay() if delay is None else delay
    return find(name).make_device(address, delay=delay, traceable=traceable, lively=lively, **options)


def _own() -> Iterator[Protocol]:
    """Yield the protocols of this package: a folder each.

    What several share is in folders that begin with an underscore.
    """
    package = importlib.import_module(PACKAGE)
    for module in pkgutil.iter_modules(package.__path__):
        if not module.name.startswith("_"):
            yield importlib.import_module(f"{PACKAGE}.{module.name}").PROTOCOL


def _loaded(entry: EntryPoint, known: list[Protocol]) -> Protocol:
    protocol = entry.load()
    if not isinstance(protocol, Protocol):
        raise TypeError(f"{entry.value} is no Protocol")
    _check_unique("name", lambda kind: kind.name, protocol, known)
    _check_unique("capture id", lambda kind: kind.capture_id, protocol, known)
    _check_options(protocol, known)
    return protocol


def _check_options(protocol: Protocol, known: list[Protocol]) -> None:
    """Check that an option of several protocols is written in one way. Raises InvalidCommand."""
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
