"""The messages of a client: the parameters of its requests and of its notifications. docs/service.md describes them."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any, Literal

from busmaster import Priority
from busmaster.app.bounds import (
    MOST_CHECKED,
    MOST_PLANNED_GROUPS,
    MOST_PLANNED_READS,
    MOST_POLLED_POINTS,
    MOST_SYNC_READS,
)
from busmaster.app.service.fields import (
    Address,
    CommandForm,
    Count,
    Duration,
    Moment,
    OptionsForm,
    PointForm,
    ProtocolName,
    ReplyTimesForm,
    RequestId,
    Sequence,
    StreamNumber,
    Value,
    protocol_of,
)
from busmaster.app.service.typed import Meta, Raw, Struct, field
from busmaster.ext import LONGEST_HOLD, LONGEST_PERIOD, LONGEST_SUSPENSION, MOST_RETRIES, SHORTEST_PERIOD, Command


class ClientMessage(Struct, frozen=True):
    """A request of a client, or without an `id` a notification. `params` is decoded by the type of the method."""

    jsonrpc: Literal["2.0"]
    method: str
    id: RequestId | None = None
    params: Raw = Raw(b"{}")


class NoParams(Struct, frozen=True):
    """No parameters."""


class HelloParams(Struct, frozen=True, omit_defaults=True):
    versions: list[int]
    program: str = ""
    safe_only: bool = False


class NodeParams(Struct, frozen=True, omit_defaults=True):
    protocol: ProtocolName
    address: Address
    timings: ReplyTimesForm | None = None
    retries: Annotated[int, Meta(description=f"0 to {MOST_RETRIES}.")] | None = None
    probe: CommandForm | None = None
    sync_reads: Annotated[list[CommandForm], Meta(min_length=1, max_length=MOST_SYNC_READS)] | None = None


class RequestParams(Struct, frozen=True, omit_defaults=True, dict=True):
    protocol: ProtocolName
    address: Address
    command: CommandForm
    touches: CommandForm | None = None
    options: OptionsForm | None = None
    stops_seen: int | None = None
    stop: bool = False
    requested: Moment | None = None
    sequence: Sequence | None = None

    @cached_property
    def checked_command(self) -> Command[Any]:
        """The command itself, which checks its arguments. Raises InvalidCommand."""
        return protocol_of(self.protocol).read_back(self.command)


class CheckParams(Struct, frozen=True, omit_defaults=True):
    protocol: ProtocolName
    address: Address
    commands: Annotated[list[CommandForm], Meta(max_length=MOST_CHECKED)]
    stop: bool = False


class SafeParams(Struct, frozen=True):
    writes: dict[str, float]


class PlannedRead(Struct, frozen=True, omit_defaults=True):
    protocol: ProtocolName
    address: Address
    command: CommandForm
    timings: ReplyTimesForm | None = None
    reply_time: Duration | None = None


class PlannedGroupForm(Struct, frozen=True, omit_defaults=True):
    name: str
    period: Annotated[float, Meta(ge=SHORTEST_PERIOD, le=LONGEST_PERIOD, description="Seconds.")]
    reads: Annotated[list[PlannedRead], Meta(extra_json_schema={"maxItems": MOST_PLANNED_READS})]
    phase: Duration | None = None
    priority: Priority = Priority.POLL


class PlanParams(Struct, frozen=True):
    groups: Annotated[list[PlannedGroupForm], Meta(extra_json_schema={"maxItems": MOST_PLANNED_GROUPS})] = field(
        default_factory=list
    )


class SubscribeParams(Struct, frozen=True):
    group: str
    stream: StreamNumber


class GatherParams(Struct, frozen=True):
    stream: StreamNumber
    points: Annotated[list[PointForm], Meta(max_length=MOST_POLLED_POINTS)]


class PollParams(Struct, frozen=True, omit_defaults=True):
    name: str
    period: Duration
    stream: StreamNumber
    points: Annotated[list[PointForm], Meta(max_length=MOST_POLLED_POINTS)] = field(default_factory=list)
    phase: Duration | None = None
    priority: Priority = Priority.POLL


class StreamParams(Struct, frozen=True):
    """A stream of the client: one to begin, or one that ends."""

    stream: StreamNumber


class DetailsParams(Struct, frozen=True):
    group: str
    key: str


class WriteParams(Struct, frozen=True, omit_defaults=True):
    group: str
    key: str
    value: Value
    options: OptionsForm | None = None
    stops_seen: int | None = None
    requested: Moment | None = None


class PauseParams(Struct, frozen=True):
    group: str
    paused: bool


class DemandParams(Struct, frozen=True):
    group: str


class SuspendParams(Struct, frozen=True, rename={"for_": "for"}):
    protocol: ProtocolName
    address: Address
    for_: Annotated[float, Meta(ge=0, description=f"Seconds, at most {LONGEST_SUSPENSION:g}; 0 to resume.")]


# notifications


class CancelParams(Struct, frozen=True):
    id: RequestId


class RefusalsParams(Struct, frozen=True):
    interface: str
    kind: Annotated[str, Meta(extra_json_schema={"enum": ["logins", "connections", "requests"]})]
    peers: dict[str, Count]


class StopParams(Struct, frozen=True):
    protocol: ProtocolName
    address: Address


class SequenceParams(Struct, frozen=True):
    sequence: Sequence


class HoldParams(Struct, frozen=True):
    sequence: Sequence
    protocol: ProtocolName
    address: Address
    max_hold: Annotated[
        float,
        Meta(ge=0, description="Seconds.", extra_json_schema={"exclusiveMinimum": 0, "maximum": LONGEST_HOLD}),
    ]
