"""What OPC UA clients see of a line beside its points: how it does, and how its groups and nodes do."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any

from asyncua import ua

from busmaster.app.interfaces.following import Following
from busmaster.app.interfaces.opcua_space import Space, Variable
from busmaster.app.interfaces.opcua_terms import CODES

LINE = {"State": "state", "Name": "line", "Utilisation": "utilisation", "Backlog": "backlog", "Losses": "losses"}
GROUP = {name.capitalize(): name for name in ("period", "achieved", "jitter", "cycles", "missed", "paused")}
NODE = {name.capitalize(): name for name in ("health", "requests", "failed", "late")}
"""Names of variables, and the attributes of a Frame, a Group or a Node of the picture that they show."""
Place = tuple[str, str]
"""Of a variable: the object that has it, and its name."""


class Health:
    """The variables of a line, its groups and nodes, except for its points."""

    def __init__(self, space: Space, line: Following) -> None:
        self.dropped: dict[str, int] = {}
        """Of each group, the cycles that this process was too slow for."""
        self._space = space
        self._line = line
        self._objects: dict[str, ua.NodeId] = {}
        self._variables: dict[Place, Variable] = {}

    async def show(self) -> None:
        """Update the clients' view to the present state of the line, which is unknown while its program is away."""
        known = dict(self._known()) if self._line.is_connected else {}
        known["Line", "Connected"] = self._line.is_connected
        for place, value in known.items():
            if place not in self._variables:
                owner, name = place
                parent = self._space.line if owner == "Line" else self._objects[owner]
                self._variables[place] = await self._space.variable(f"{owner} {name}", name, parent)
            await self._variables[place].show(value)
        for place, variable in self._variables.items():
            if place not in known and variable.status != CODES.BadOutOfService:
                await variable.put(None, CODES.BadOutOfService, time.time())

    async def show_objects(self) -> None:
        """Have an object for each group and each node that is known."""
        for group in self._line.picture.groups:
            await self._object(f"Groups/{group.name}", group.name, self._space.groups)
        for node in self._line.picture.nodes.values():
            await self.node(node.protocol, node.address, node.label)

    async def node(self, protocol: str, address: int, label: str) -> ua.NodeId:
        """Return the object of a node."""
        return await self._object(_node(protocol, address), label, self._space.nodes)

    async def _object(self, key: str, name: str, parent: ua.NodeId) -> ua.NodeId:
        if key not in self._objects:
            self._objects[key] = await self._space.object(key, name, parent)
        return self._objects[key]

    def _known(self) -> Iterator[tuple[Place, Any]]:
        picture = self._line.picture
        if picture.frame is not None:
            yield from _shown("Line", picture.frame, LINE)
            yield ("Line", "ReadOnly"), self._line.read_only
        for group in picture.groups:
            owner = f"Groups/{group.name}"
            if owner in self._objects:
                yield from _shown(owner, group, GROUP)
                yield (owner, "Dropped"), self.dropped.get(group.name, 0)
        for node in picture.nodes.values():
            owner = _node(node.protocol, node.address)
            if owner in self._objects:
                yield from _shown(owner, node, NODE)


def _node(protocol: str, address: int) -> str:
    return f"Nodes/{protocol} {address}"


def _shown(owner: str, thing: Any, names: Mapping[str, str]) -> Iterator[tuple[Place, Any]]:
    for name, field in names.items():
        yield (owner, name), getattr(thing, field)
