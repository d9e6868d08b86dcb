"""The permissions of users, groups and tokens in `[service]`, in the form of a line's authorisation."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from fnmatch import fnmatchcase
from typing import Any, Protocol

from busmaster import InvalidCommand, Point
from busmaster.app.config.service import RoleSection, ServiceSection
from busmaster.app.service.permission import Access, Permission
from busmaster.ext import Handle, Placed

ALL = "*"


class Names(Protocol):
    """What a line's file names."""

    @property
    def nodes(self) -> Mapping[str, Handle]: ...

    def points_named(self, text: str, /) -> Iterator[Point[Any]]:
        """Yield the points that a text names. Raises InvalidCommand."""
        ...


def access_of(section: ServiceSection, names: Names, secrets: Mapping[str, bytes] | None = None) -> Access:
    """Return the permissions. Raises FileError for an unknown point, and for one that cannot be permitted alone."""
    return Access(
        users={uid: _permission(role, names) for uid, role in section.users.items()},
        groups={gid: _permission(role, names) for gid, role in section.groups.items()},
        tokens={name: _permission(role, names) for name, role in section.tokens.items()},
        secrets=secrets or {},
    )


def _permission(role: RoleSection, names: Names) -> Permission:
    if role.allow_writes is None:
        return Permission(role.who, role.role)
    only: dict[tuple[str, int], frozenset[Hashable] | None] = {}
    for number, text in enumerate(role.allow_writes):
        with role.table.part(), role.table.at("allow_writes", number):
            for (protocol, address), places in _places(text, names):
                before = only.get((protocol, address), frozenset())
                only[protocol, address] = None if before is None or places is None else before | places
    return Permission(role.who, role.role, only)


def _places(text: str, names: Names) -> Iterator[tuple[tuple[str, int], frozenset[Hashable] | None]]:
    """Yield by node what `drive*/speed,current` names, None for all of the node: `press/*`."""
    pattern, slash, items = text.partition("/")
    nodes = [name for name in names.nodes if fnmatchcase(name, pattern)] if slash and ALL in pattern else [pattern]
    if not nodes:
        raise InvalidCommand(f"no node matches {pattern!r}; the nodes are {', '.join(names.nodes)}")
    for name in nodes:
        if items == ALL and name in names.nodes:
            yield _key(names.nodes[name]), None
            continue
        for point in names.points_named(f"{name}/{items}" if slash else text):
            if not point.writable:
                raise InvalidCommand(f"{point.key} is read-only")
            if not isinstance(point.command, Placed):
                raise InvalidCommand(f"{point.key} cannot be permitted alone; permit {name}/*")
            yield (point.node.profile.name, point.node.address), frozenset(point.command.places)


def _key(handle: Handle) -> tuple[str, int]:
    return handle.node.profile.name, handle.node.address
