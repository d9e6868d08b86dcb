"""A served line, shared by the connected programs: its messages are made once for all of them."""

from __future__ import annotations

from collections.abc import Collection, Hashable
from functools import partial
from math import inf, nextafter
from typing import Any
from weakref import WeakKeyDictionary, WeakSet

from busmaster import Bus, InvalidCommand, Node, Point, PollGroup, ext
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.exchanges import ExchangesBroadcast
from busmaster.app.service.overview import EventLog, Overview
from busmaster.app.service.plans import Planner
from busmaster.app.service.rights import RIGHTS, Role
from busmaster.app.service.safe import SafeStateRequests
from busmaster.app.service.streams import Broadcast, EventBroadcast, GroupBroadcast
from busmaster.ext import NodeRecord, Placed

MOST_NAMED = 50
"""Points that one message names as stale."""


class ServedLine:
    """One line with its authorisation. `share` weighs the line time of each program: the owner's own share is 1."""

    def __init__(self, bus: Bus, authorisation: Authorisation, share: float, title: str) -> None:
        self.bus = bus
        self.authorisation = authorisation
        self.share = share
        self.title = title
        """Title above the views of the line."""
        self.safe_writes = SafeStateRequests(authorisation)
        self.planner = Planner(bus)
        self.journal = EventLog(bus)
        """The events from now on, also before the line is served."""
        self._demanded: WeakKeyDictionary[PollGroup, dict[Role, float]] = WeakKeyDictionary()
        """When a role's programs last had a group polled off its grid."""
        self.of_programs: WeakSet[PollGroup] = WeakSet()
        """Poll groups of connected programs, which choose the names of their points."""
        self._groups: dict[PollGroup, GroupBroadcast] = {}
        self._events: EventBroadcast | None = None
        self._overview: Overview | None = None
        self._exchanges: ExchangesBroadcast | None = None
        self._points: dict[object, Point[Any]] = {}
        self._points_of: list[tuple[str, tuple[Point[Any], ...]]] = []

    def broadcast_of(self, group: PollGroup) -> Broadcast:
        """Return the source of a poll group's cycles."""
        if group not in self._groups:
            self._groups[group] = GroupBroadcast(group, partial(self._forget_group, group))
        return self._groups[group]

    def events(self) -> Broadcast:
        """Return the source of the events of line and nodes."""
        if self._events is None:
            self._events = EventBroadcast(self.bus, self._end_events)
        return self._events

    def overview(self) -> Broadcast:
        """Return the source of the line's overview."""
        if self._overview is None:
            self._overview = Overview(
                self.bus, self.authorisation, self.journal, lambda: self.title, self._end_overview
            )
        return self._overview

    def exchanges(self) -> Broadcast:
        """Return the source of the exchanges on the line."""
        if self._exchanges is None:
            self._exchanges = ExchangesBroadcast(self.bus, self._end_exchanges)
        return self._exchanges

    def group(self, name: str) -> PollGroup:
        """Return a poll group. Raises InvalidCommand with the known names for an unknown one."""
        return self.bus.group(name)

    def point(self, group: str, key: str) -> tuple[PollGroup, Point[Any]]:
        """Return a point of a poll group, and the group. Raises InvalidCommand if there is none."""
        found = self.group(group)
        for point in found.points:
            if point.key == key:
                return found, point
        raise InvalidCommand(f"poll group {group!r} has no point {key!r}")

    def demand(self, group: PollGroup, role: Role) -> None:
        """Poll a group now. If the programs of this role have demanded that recently, wait for the next cycle."""
        every, now = RIGHTS[role].demand_every, self.bus.now()
        demanded = self._demanded.setdefault(group, {})
        if now < demanded.get(role, -inf) + every * group.period:
            return
        demanded[role] = now
        group.demand()

    def node(self, protocol: str, address: int) -> Node:
        """Return a node that is on the line. Raises InvalidCommand if there is none."""
        for node in self.bus.nodes:
            if (node.profile.name, node.address) == (protocol, address):
                return node
        raise InvalidCommand(f"node {address} of {protocol} is not on this line; check protocol and address")

    def named(self, node: Node, places: Collection[Hashable]) -> Point[Any] | None:
        """Return the point of a poll group of the owner that reads these places of a node."""
        groups = [(group.name, group.points) for group in self.bus.groups if group not in self.of_programs]
        if groups != self._points_of:
            self._points_of = groups
            self._points = {
                (point.node, frozenset(point.command.places)): point
                for _, points in groups
                for point in points
                if isinstance(point.command, Placed)
            }
        return self._points.get((node, frozenset(places)))

    def stale_items(self, record: NodeRecord, when: float) -> list[str] | None:
        """Return the polled points of a node that the write that ended just now has made stale.

        None means all points of the node, also if the list would be too long. A stale mark on a good value is harmless.
        """
        before = nextafter(when, -inf)
        points = {(point.item, point.command): point for group in self.bus.groups for point in group.points_of(record)}
        is_stale = ext.line_of(self.bus).is_stale
        # One program can give a point the name of another one: the name is stale if either is.
        stale = list({point.item: None for point in points.values() if is_stale(point, before)})
        return stale if len(stale) <= MOST_NAMED else None

    def _forget_group(self, group: PollGroup) -> None:
        self._groups.pop(group, None)

    def _end_events(self) -> None:
        self._events = None

    def _end_overview(self) -> None:
        self._overview = None

    def _end_exchanges(self) -> None:
        self._exchanges = None
