"""The address space of a line in OPC UA: how its objects and variables are made, and given values."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Any

from asyncua import Server, ua

from busmaster.app.interfaces.opcua_terms import CODES, time_of, unit_of, variant_of, widened

POINTS = "urn:busmaster:points"
"""The namespace of points: there an identifier is a point's key, "winder/force"."""
HEALTH = "urn:busmaster:line"
"""The namespace of the rest: the line's own state, its groups and nodes."""
_ANALOG_TYPES = {
    (False, False): ua.ObjectIds.DataItemType,
    (True, False): ua.ObjectIds.AnalogUnitType,
    (False, True): ua.ObjectIds.AnalogItemType,
    (True, True): ua.ObjectIds.AnalogUnitRangeType,
}
"""Variable types of numbers, by whether EngineeringUnits and EURange are there: each type requires its properties."""
UNKNOWN = ua.DataValue(StatusCode=ua.StatusCode(CODES.BadWaitingForInitialData))


class Variable:
    """One variable. Clients read the last value, status and times that were put."""

    def __init__(self, space: Space, place: ua.NodeId) -> None:
        self.place = place
        self.kind: ua.VariantType | None = None
        """The type of its values; None before the first."""
        self.status: int = CODES.BadWaitingForInitialData
        self.when = 0.0
        """When its value was read, in seconds since 1970."""
        self._space = space
        self._value: Any = None
        self._analog_type: int = ua.ObjectIds.DataItemType
        """Its variable type if its values are numbers."""

    async def put(self, value: Any, status: int, when: float) -> None:
        """Send a value to clients. With a Bad status they get no value, and `when` is the time of the failure.

        Raises TypeError for a value that OPC UA has no type for.
        """
        variant = None
        if not ua.StatusCode(status).is_bad():
            kind = widened(self.kind, value)
            variant = variant_of(value, kind)
            if kind is not self.kind:
                await self._space.retype(self.place, kind, is_list=isinstance(value, tuple))
                self.kind = kind
                self._show_type()
            self._value = value
        self.status, self.when = status, when
        await self._space.put(self.place, variant, status, when)

    async def doubt(self) -> None:
        """Mark a good value as not current. One that is not good is not changed."""
        if self.status == CODES.Good:
            await self.put(self._value, CODES.UncertainLastUsableValue, self.when)

    async def show(self, value: Any) -> None:
        """Put a value that is known now, if it is another one than before."""
        if value != self._value or self.status != CODES.Good:
            await self.put(value, CODES.Good, time.time())

    async def describe(self, *, unit: str, range_: ua.Range | None, writable: bool) -> None:
        """Show the unit of its values, their range, and whether they can be written."""
        await self._space.give_property(self.place, "EngineeringUnits", unit_of(unit) if unit else None)
        await self._space.give_property(self.place, "EURange", range_)
        await self._space.give_access(self.place, writable)
        self._analog_type = _ANALOG_TYPES[bool(unit), range_ is not None]
        self._show_type()

    def _show_type(self) -> None:
        """Give it the variable type of OPC UA (Part 8, 5.3) that its properties and the type of its values allow."""
        is_number = self.kind in (ua.VariantType.Int64, ua.VariantType.Double)
        self._space.set_type(self.place, self._analog_type if is_number else ua.ObjectIds.DataItemType)


class Space:
    """What a server shows. `begin` makes what every line has."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._session = server.iserver.isession
        self._points = self._health = 0
        self.line = ua.NodeId()
        self.nodes = ua.NodeId()
        self.groups = ua.NodeId()

    async def begin(self) -> None:
        """Make the objects Line, Nodes and Groups."""
        self._points = await self._server.register_namespace(POINTS)
        self._health = await self._server.register_namespace(HEALTH)
        objects = ua.NodeId(ua.ObjectIds.ObjectsFolder)
        self.line = await self.object("Line", "Line", objects)
        self.nodes = await self.object("Nodes", "Nodes", self.line, ua.ObjectIds.FolderType)
        self.groups = await self.object("Groups", "Groups", self.line, ua.ObjectIds.FolderType)

    async def object(
        self, key: str, name: str, parent: ua.NodeId, type_: int = ua.ObjectIds.BaseObjectType
    ) -> ua.NodeId:
        """Make an object, and return its identifier."""
        attributes = ua.ObjectAttributes()
        attributes.DisplayName = attributes.Description = ua.LocalizedText(name)
        return await self._add(ua.NodeId(key, self._health), name, parent, ua.NodeClass.Object, attributes, type_)

    async def variable(self, key: str, name: str, parent: ua.NodeId) -> Variable:
        """Make a variable for the state of line, groups or nodes."""
        attributes = _attributes(name, name)
        place = ua.NodeId(key, self._health)
        type_ = ua.ObjectIds.BaseDataVariableType
        await self._add(place, name, parent, ua.NodeClass.Variable, attributes, type_)
        return self._unknown(place)

    async def point(self, key: str, name: str, parent: ua.NodeId, described: str) -> Variable:
        """Make the variable of a point."""
        place = ua.NodeId(key, self._points)
        attributes = _attributes(name, described)
        await self._add(place, name, parent, ua.NodeClass.Variable, attributes, ua.ObjectIds.DataItemType)
        return self._unknown(place)

    async def put(self, place: ua.NodeId, value: ua.Variant | None, status: int, when: float) -> None:
        """Give a variable a value of the type that it has; None for no value, with a Bad status."""
        data = ua.DataValue(
            value or ua.Variant(None, ua.VariantType.Null),
            StatusCode=ua.StatusCode(status),
            SourceTimestamp=time_of(when),
            ServerTimestamp=datetime.now(UTC),
        )
        await self._server.write_attribute_value(place, data)

    def set_type(self, place: ua.NodeId, type_: int) -> None:
        """Change the variable type of a variable. Clients cannot do this, so asyncua has no service for it."""
        space, wanted = self._server.iserver.aspace, ua.NodeId(type_)
        for reference in space[place].references:
            if reference.ReferenceTypeId.Identifier != ua.ObjectIds.HasTypeDefinition:
                for back in space[reference.NodeId].references:  # a browse of its parent shows the type, too
                    if back.NodeId == place:
                        back.TypeDefinition = wanted
            elif reference.NodeId != wanted:
                reference.NodeId = wanted
                names = space[wanted].attributes
                reference.BrowseName = names[ua.AttributeIds.BrowseName].value.Value.Value
                reference.DisplayName = names[ua.AttributeIds.DisplayName].value.Value.Value

    async def retype(self, place: ua.NodeId, kind: ua.VariantType, *, is_list: bool) -> None:
        """Give a variable another type."""
        for attribute, value in (
            (ua.AttributeIds.DataType, ua.Variant(ua.NodeId(kind.value), ua.VariantType.NodeId)),
            (ua.AttributeIds.ValueRank, ua.Variant(1 if is_list else -1, ua.VariantType.Int32)),
        ):
            await self._server.write_attribute_value(place, ua.DataValue(value), attribute)
        # A value of the type before would have one of the new type refused.
        self._server.iserver.aspace[place].attributes[ua.AttributeIds.Value].value = UNKNOWN

    def _unknown(self, place: ua.NodeId) -> Variable:
        self._server.iserver.aspace[place].attributes[ua.AttributeIds.Value].value = UNKNOWN
        return Variable(self, place)

    async def give_property(self, parent: ua.NodeId, name: str, value: Any) -> None:
        """Give a variable a property of OPC UA; None for one that it does not have, or has no longer."""
        place = ua.NodeId(f"{parent.Identifier} {name}", self._health)
        if value is None and place not in self._server.iserver.aspace:
            return
        if place not in self._server.iserver.aspace:
            attributes = _attributes(name, name)
            attributes.DataType = ua.NodeId(value.data_type.Identifier)
            item = _item(place, ua.QualifiedName(name, 0), parent, ua.NodeClass.Variable, attributes)
            item.ReferenceTypeId = ua.NodeId(ua.ObjectIds.HasProperty)
            item.TypeDefinition = ua.NodeId(ua.ObjectIds.PropertyType)
            await self._session.add_nodes([item])
        variant = None if value is None else ua.Variant(value, ua.VariantType.ExtensionObject)
        await self.put(place, variant, CODES.Good if variant else CODES.BadConfigurationError, time.time())

    async def give_access(self, place: ua.NodeId, writable: bool) -> None:
        """Set whether a variable may be written."""
        access = ua.AccessLevel.CurrentRead.mask | (ua.AccessLevel.CurrentWrite.mask if writable else 0)
        data = ua.DataValue(ua.Variant(access, ua.VariantType.Byte))
        for attribute in (ua.AttributeIds.AccessLevel, ua.AttributeIds.UserAccessLevel):
            await self._server.write_attribute_value(place, data, attribute)

    async def _add(
        self, place: ua.NodeId, name: str, parent: ua.NodeId, kind: ua.NodeClass, attributes: Any, type_: int
    ) -> ua.NodeId:
        item = _item(place, ua.QualifiedName(name, place.NamespaceIndex), parent, kind, attributes)
        folders = (ua.NodeId(ua.ObjectIds.ObjectsFolder), self.nodes, self.groups)
        organizes = ua.ObjectIds.Organizes if parent in folders else ua.ObjectIds.HasComponent
        item.ReferenceTypeId = ua.NodeId(organizes)
        item.TypeDefinition = ua.NodeId(type_)
        [result] = await self._session.add_nodes([item])
        result.StatusCode.check()
        return place


def _attributes(name: str, described: str) -> Any:
    attributes = ua.VariableAttributes()
    attributes.DisplayName = ua.LocalizedText(name)
    attributes.Description = ua.LocalizedText(described)
    attributes.DataType = ua.NodeId(ua.ObjectIds.BaseDataType)
    attributes.ValueRank = -1
    attributes.AccessLevel = attributes.UserAccessLevel = ua.AccessLevel.CurrentRead.mask
    return attributes


def _item(place: ua.NodeId, name: ua.QualifiedName, parent: ua.NodeId, kind: ua.NodeClass, attributes: Any) -> Any:
    item = ua.AddNodesItem()
    item.RequestedNewNodeId = place
    item.BrowseName = name
    item.ParentNodeId = parent
    item.NodeClass = kind
    item.NodeAttributes = attributes
    return item
