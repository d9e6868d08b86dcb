"""Converts snapshots, events and statistics to the structures of messages, and back at the client."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol, cast

from busmaster import Bus, GarbledReply, InvalidCommand, Point, Quality, Sample, Snapshot
from busmaster.app.service.failures import bus_error_of, error_data
from busmaster.app.service.fields import GroupForm, PointForm, protocol_of
from busmaster.app.service.messages import encode_number, encode_value, value_of
from busmaster.app.service.owner_messages import (
    AlarmChangedForm,
    EventForm,
    LineChangedForm,
    MaxReplyDelayLoweredForm,
    MaxReplyDelayRaisedForm,
    NodeChangedForm,
    PortFailedForm,
    RepliesLateForm,
    SampleForm,
    SnapshotBody,
    StatisticsResult,
)
from busmaster.app.service.typed import Raw, convert, to_builtins
from busmaster.events import (
    AlarmChanged,
    BusEvent,
    LineChanged,
    MaxReplyDelayLowered,
    MaxReplyDelayRaised,
    NodeChanged,
    PortFailed,
    RepliesLate,
)
from busmaster.ext import DriverErrors, LineStatistics, NodeRecord, Profile, Quantiles, Requester
from busmaster.ext import Protocol as BusProtocol


class FindNode(Protocol):
    """Returns the node that a protocol's name and an address stand for."""

    def __call__(self, protocol: str, address: int, /) -> Requester: ...


class SyncReads(NamedTuple):
    """The probe and the sync reads of a kind of node, in the form of messages; None: those of its protocol."""

    probe: dict[str, Any] | None = None
    sync_reads: list[dict[str, Any]] | None = None


def encode_sync_reads(profile: Profile) -> SyncReads:
    """Return the probe and the sync reads of a kind of node, if they are not those of its protocol."""
    protocol = protocol_of(profile.name)
    usual = protocol.profile
    if (profile.probe, tuple(profile.sync_reads)) == (usual.probe, tuple(usual.sync_reads)):
        return SyncReads()
    return SyncReads(
        protocol.write_down(profile.probe), [protocol.write_down(command) for command in profile.sync_reads]
    )


def profile_of(protocol: BusProtocol, form: SyncReads) -> Profile:
    """Return the profile with the probe and the sync reads that a client has sent.

    Raises InvalidCommand for a command that is not a read of the protocol.
    """
    if form.probe is None and form.sync_reads is None:
        return protocol.profile
    if form.probe is None or form.sync_reads is None:
        raise InvalidCommand(f"{protocol.name}: a client sends a probe together with sync reads")
    probe, *sync_reads = [protocol.read_back(command) for command in (form.probe, *form.sync_reads)]
    for command in (probe, *sync_reads):
        if command.writes:
            raise InvalidCommand(f"{protocol.name}: a probe or sync read must read, and {command} writes")
    return replace(protocol.profile, probe=probe, sync_reads=tuple(sync_reads))


# poll groups


def listed_groups(bus: Bus) -> list[GroupForm]:
    """Return the poll groups of a line in the form of messages."""
    return [GroupForm(group.name, group.period) for group in bus.groups]


# snapshots


def encode_points(points: Iterable[Point[Any]]) -> list[PointForm]:
    """Return points in the form of messages: their names and their commands."""
    return [
        PointForm(
            point.node.profile.name,
            point.node.address,
            protocol_of(point.node.profile.name).write_down(point.command),
            point.key,
            point.item,
            point.unit,
        )
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


def point_of(form: PointForm, find: FindNode) -> Point[Any]:
    """Return the point in a message. It does not change values, because they were decoded by the owner.

    Without a name, the command is its name: two points of a node must not have the same key.
    """
    protocol = protocol_of(form.protocol)
    node, command = find(protocol.name, form.address), protocol.read_back(form.command)
    return Point(node, form.item or form.key or str(command), command, form.unit)


def owners_point_of(form: PointForm, find: FindNode) -> Point[Any]:
    """Return the owner's point in a message, with the owner's name for it."""
    point = point_of(form, find)
    return OwnersPoint(point.node, point.item, point.command, point.unit, owners_key=form.key)


def encode_snapshot(snapshot: Snapshot, set_: int, samples: list[Raw]) -> SnapshotBody:
    """Return a cycle in the form of a message. Its samples are encoded already, a few at a time."""
    return SnapshotBody(
        set_,
        snapshot.cycle,
        snapshot.due,
        snapshot.started,
        snapshot.finished,
        snapshot.missed,
        snapshot.wall,
        cast("list[SampleForm]", samples),
    )


def snapshot_of(body: SnapshotBody, group: str, points: Sequence[Point[Any]]) -> Snapshot:
    """Return the cycle in a message; its samples are in the order of its points."""
    samples = {point: _sample_of(form, point) for point, form in zip(points, body.samples, strict=True)}
    return Snapshot(
        group=group,
        samples=samples,
        cycle=body.cycle,
        due=body.due,
        started=body.started,
        finished=body.finished,
        missed=body.missed,
        wall=body.wall,
    )


def encode_sample(sample: Sample[Any]) -> SampleForm:
    """Return a sample in the form of a message."""
    return SampleForm(
        encode_value(sample.value),
        None if sample.error is None else error_data(sample.error),
        sample.due,
        sample.started,
        sample.finished,
        sample.wall,
        sample.quality.value,
        sample.timeline,
    )


def _sample_of(form: SampleForm, point: Point[Any]) -> Sample[Any]:
    error = None if form.error is None else bus_error_of(form.error)
    quality, value = Quality(form.quality), value_of(form.value)
    if error is None:
        try:
            value = point.value_of(value)
        except GarbledReply as bad:
            value, error, quality = None, bad, Quality.BAD
    return Sample(value, error, form.due, form.started, form.finished, quality, form.timeline, form.wall)


# events


def encode_event(event: BusEvent) -> EventForm | None:
    """Return an event in the form of a message; None for one that clients do not get."""
    match event:
        case LineChanged():
            return LineChangedForm(event.change, event.cause)
        case PortFailed():
            bug = None if event.bug is None else f"{type(event.bug).__name__}: {event.bug}"
            return PortFailedForm(event.cause, event.hint, bug)
        case AlarmChanged():
            [point] = encode_points([event.point])
            return AlarmChangedForm(
                point, event.limit, encode_number(event.bound), encode_value(event.value), event.active
            )
        case NodeChanged() | MaxReplyDelayRaised() | MaxReplyDelayLowered() | RepliesLate():
            return _encode_node_event(event)
    return None


def _encode_node_event(event: NodeChanged | MaxReplyDelayRaised | MaxReplyDelayLowered | RepliesLate) -> EventForm:
    node = event.node.profile.name, event.node.address, event.node.label
    match event:
        case NodeChanged():
            return NodeChangedForm(*node, event.before, event.after, event.returning)
        case MaxReplyDelayRaised():
            return MaxReplyDelayRaisedForm(*node, event.age, event.max_reply_delay)
        case MaxReplyDelayLowered():
            return MaxReplyDelayLoweredForm(*node, event.max_reply_delay)
        case RepliesLate():
            return RepliesLateForm(*node, event.age, event.window)


def event_of(form: EventForm, find: FindNode) -> BusEvent:
    """Return the event in a message; its `node` is the client's own."""
    match form:
        case LineChangedForm():
            return LineChanged(form.change, form.cause)
        case PortFailedForm():
            return PortFailed(form.cause, form.hint, None if form.bug is None else Exception(form.bug))
        case AlarmChangedForm():
            bound, value = value_of(to_builtins(form.bound)), value_of(form.value)
            return AlarmChanged(owners_point_of(form.point, find), form.limit, bound, value, form.active)
    # It has all attributes of a node that events need: label, address, profile, line.
    node = cast("NodeRecord", find(form.protocol, form.address))
    match form:
        case NodeChangedForm():
            return NodeChanged(node, form.before, form.after, form.returning)
        case MaxReplyDelayRaisedForm():
            return MaxReplyDelayRaised(node, form.age, form.max_reply_delay)
        case RepliesLateForm():
            return RepliesLate(node, form.age, form.window)
        case MaxReplyDelayLoweredForm():
            return MaxReplyDelayLowered(node, form.max_reply_delay)


# statistics


def encode_statistics(statistics: LineStatistics) -> StatisticsResult:
    """Return the counters of a line in the form of a message."""
    counters = {**dataclasses.asdict(statistics), "utilisation": statistics.utilisation}
    return convert(encode_value(counters), StatisticsResult, from_attributes=True)


def statistics_of(form: StatisticsResult) -> LineStatistics:
    """Return the counters in a message."""
    counters: Mapping[str, Any] = value_of(to_builtins(form))
    known = {part.name for part in dataclasses.fields(LineStatistics)}
    counts = {name: value for name, value in counters.items() if name in known}
    counts["waits"] = tuple(Quantiles(**wait) for wait in counters["waits"])
    counts["driver"] = None if counters["driver"] is None else DriverErrors(**counters["driver"])
    return LineStatistics(**counts)
