"""Encodes snapshots, events and statistics for messages, and decodes them at the client."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Protocol, cast

from busmaster import Bus, Health, Point, Quality, Sample, Snapshot
from busmaster.app.service.failures import bus_error_of, error_data
from busmaster.app.service.messages import value_of
from busmaster.bounds import MOST_SYNC_READS
from busmaster.errors import GarbledReply, InvalidCommand
from busmaster.events import (
    AlarmChanged,
    BusEvent,
    LineChange,
    LineChanged,
    MaxReplyDelayLowered,
    MaxReplyDelayRaised,
    NodeChanged,
    PortFailed,
    RepliesLate,
)
from busmaster.ext import NodeRecord, Profile, Requester
from busmaster.registry import Protocol as BusProtocol
from busmaster.registry import protocols
from busmaster.statistics import DriverErrors, LineStatistics, Quantiles, Timeline


class FindNode(Protocol):
    """Returns the node that a protocol's name and an address stand for."""

    def __call__(self, protocol: str, address: int, /) -> Requester: ...


@cache  # it is called for each request of a client
def protocol_of(name: str) -> BusProtocol:
    """Return the protocol of a name. Raises InvalidCommand if there is none."""
    for protocol in protocols():
        if protocol.name == name:
            return protocol
    raise InvalidCommand(f"no such protocol {name!r}; there are {', '.join(one.name for one in protocols())}")


def encode_sync_reads(profile: Profile) -> dict[str, Any]:
    """Return the probe and the sync reads of a kind of node, as they are sent, where they are not its protocol's."""
    protocol = protocol_of(profile.name)
    usual = protocol.profile
    if (profile.probe, tuple(profile.sync_reads)) == (usual.probe, tuple(usual.sync_reads)):
        return {}
    return {
        "probe": protocol.write_down(profile.probe),
        "sync_reads": [protocol.write_down(command) for command in profile.sync_reads],
    }


def profile_of(protocol: BusProtocol, probe: Any, sync_reads: Any) -> Profile:
    """Return the profile with the probe and the sync reads that a client has sent; None: the protocol's.

    Raises InvalidCommand for a command that is not a read of the protocol.
    """
    if probe is None and sync_reads is None:
        return protocol.profile
    if not isinstance(probe, dict) or not isinstance(sync_reads, list) or not 0 < len(sync_reads) <= MOST_SYNC_READS:
        raise InvalidCommand(f"{protocol.name}: a client sends one probe, and 1 to {MOST_SYNC_READS} sync reads")
    first, *others = [protocol.read_back(dict(form)) for form in (probe, *sync_reads)]
    for command in (first, *others):
        if command.writes:
            raise InvalidCommand(f"{protocol.name}: a probe or sync read must read, and {command} writes")
    return replace(protocol.profile, probe=first, sync_reads=tuple(others))


# poll groups


def listed_groups(bus: Bus) -> list[dict[str, Any]]:
    """Return the poll groups of a line as they are sent."""
    return [{"name": group.name, "period": group.period} for group in bus.groups]


# snapshots


def encode_points(points: Iterable[Point[Any]]) -> list[dict[str, Any]]:
    """Return points in the form of messages: their names and their commands."""
    return [
        {
            "key": point.key,
            "item": point.item,
            "unit": point.unit,
            "protocol": point.node.profile.name,
            "address": point.node.address,
            "command": protocol_of(point.node.profile.name).write_down(point.command),
        }
        for point in points
    ]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class OwnersPoint(Point[Any]):
    """A point under the name that the line's owner has for it: "winder/position". It equals one that reads the same."""

    owners_key: str = ""

    @property
    def key(self) -> str:
        """Return node and item as the owner's file has them."""
        return self.owners_key

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Point):
            return NotImplemented
        return (self.node, self.item, self.command) == (other.node, other.item, other.command)

    __hash__ = Point.__hash__


def point_of(decoded: Mapping[str, Any], find: FindNode) -> Point[Any]:
    """Return the point in a message. It does not change values, because they were decoded by the owner."""
    protocol = protocol_of(decoded.get("protocol"))
    node = find(protocol.name, decoded["address"])
    command = protocol.read_back(decoded["command"])
    return Point(node, str(decoded.get("item", "")), command, str(decoded.get("unit", "")))


def owners_point_of(decoded: Mapping[str, Any], find: FindNode) -> Point[Any]:
    """Return the owner's point in a message, with the owner's name for it."""
    point = point_of(decoded, find)
    return OwnersPoint(point.node, point.item, point.command, point.unit, owners_key=str(decoded["key"]))


def encode_snapshot(snapshot: Snapshot) -> dict[str, Any]:
    """Return a cycle in the form of a message, without its samples."""
    return {name: getattr(snapshot, name) for name in ("cycle", "due", "started", "finished", "missed", "wall")}


def snapshot_of(decoded: Mapping[str, Any], group: str, points: Sequence[Point[Any]]) -> Snapshot:
    """Return the cycle in a message; its samples are in the order of its points."""
    names = ("cycle", "due", "started", "finished", "missed", "wall")
    samples = {point: _sample_of(one, point) for point, one in zip(points, decoded["samples"], strict=True)}
    return Snapshot(group=group, samples=samples, **{name: decoded[name] for name in names})


def encode_sample(sample: Sample[Any]) -> list[Any]:
    """Return a sample in the form of a message."""
    error = None if sample.error is None else error_data(sample.error)
    times = (sample.due, sample.started, sample.finished, sample.wall)
    return [sample.value, error, *times, sample.quality.value, sample.timeline]


def _sample_of(decoded: Sequence[Any], point: Point[Any]) -> Sample[Any]:
    value, error, due, started, finished, wall, quality, timeline = decoded
    failed = None if error is None else bus_error_of(error)
    how_good = Quality(quality)
    value = value_of(value)
    if failed is None:
        try:
            value = point.value_of(value)
        except GarbledReply as bad:
            value, failed, how_good = None, bad, Quality.BAD
    return Sample(value, failed, due, started, finished, how_good, Timeline(*timeline), wall)


# events


def encode_event(event: BusEvent) -> dict[str, Any] | None:
    """Return an event in the form of a message; None for one that clients do not get."""
    form: dict[str, Any] = {"event": type(event).__name__}
    match event:
        case NodeChanged():
            form |= {"before": event.before.value, "after": event.after.value, "returning": event.returning}
        case MaxReplyDelayRaised():
            form |= {"age": event.age, "max_reply_delay": event.max_reply_delay}
        case MaxReplyDelayLowered():
            form |= {"max_reply_delay": event.max_reply_delay}
        case RepliesLate():
            form |= {"age": event.age, "window": event.window}
        case LineChanged():
            return form | {"change": event.change.value, "cause": event.cause}
        case PortFailed():
            bug = None if event.bug is None else f"{type(event.bug).__name__}: {event.bug}"
            return form | {"cause": event.cause, "hint": event.hint, "bug": bug}
        case AlarmChanged():
            [point] = encode_points([event.point])
            limits = {name: getattr(event, name) for name in ("limit", "bound", "value", "active")}
            return form | {"point": point, **limits}
        case _:
            return None
    node = event.node
    return form | {"protocol": node.profile.name, "address": node.address, "label": node.label}


def event_of(decoded: Mapping[str, Any], find: FindNode) -> BusEvent | None:
    """Return the event in a message; its `node` is the client's own. None for one of a later version."""
    name = decoded["event"]
    if name == "LineChanged":
        return LineChanged(LineChange(decoded["change"]), decoded["cause"])
    if name == "PortFailed":
        return PortFailed(
            decoded["cause"], decoded["hint"], None if decoded["bug"] is None else Exception(decoded["bug"])
        )
    if name == "AlarmChanged":
        point = owners_point_of(decoded["point"], find)
        return AlarmChanged(point, decoded["limit"], decoded["bound"], decoded["value"], decoded["active"])
    if name not in ("NodeChanged", "MaxReplyDelayRaised", "MaxReplyDelayLowered", "RepliesLate"):
        return None
    # It has all attributes of a node that events need: label, address, profile, line.
    node = cast("NodeRecord", find(decoded["protocol"], decoded["address"]))
    if name == "NodeChanged":
        return NodeChanged(node, Health(decoded["before"]), Health(decoded["after"]), decoded["returning"])
    if name == "MaxReplyDelayRaised":
        return MaxReplyDelayRaised(node, decoded["age"], decoded["max_reply_delay"])
    if name == "RepliesLate":
        return RepliesLate(node, decoded["age"], decoded["window"])
    return MaxReplyDelayLowered(node, decoded["max_reply_delay"])


# statistics


def encode_statistics(statistics: LineStatistics) -> dict[str, Any]:
    """Return the counters of a line in the form of a message."""
    return {**dataclasses.asdict(statistics), "utilisation": statistics.utilisation}


def statistics_of(decoded: Mapping[str, Any]) -> LineStatistics:
    """Return the counters in a message."""
    known = {part.name for part in dataclasses.fields(LineStatistics)}
    counts: dict[str, Any] = {name: value for name, value in decoded.items() if name in known}
    counts["waits"] = tuple(Quantiles(**wait) for wait in decoded["waits"])
    counts["driver"] = None if decoded["driver"] is None else DriverErrors(**decoded["driver"])
    return LineStatistics(**counts)
