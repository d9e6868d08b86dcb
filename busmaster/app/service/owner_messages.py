"""The messages of a line's owner: results, notifications and errors. docs/service.md describes them."""

from __future__ import annotations

from typing import Annotated, Any, Generic, Literal, TypeAlias, TypeVar

from busmaster import Health
from busmaster.app.service.fields import (
    Address,
    BusErrorData,
    Count,
    Duration,
    ErrorData,
    GroupForm,
    HealthText,
    Microseconds,
    Moment,
    NonFinite,
    Number,
    PointForm,
    ProtocolName,
    QualityText,
    RequestId,
    StateText,
    StreamNumber,
    Value,
    one_of,
)
from busmaster.app.service.typed import UNSET, Meta, Raw, Struct, UnsetType
from busmaster.events import LineChange
from busmaster.ext import Timeline

Body = TypeVar("Body")


class ErrorForm(Struct, frozen=True, omit_defaults=True):
    """An error. `data` names its class; JSON-RPC's own errors have none."""

    code: Annotated[int, Meta(extra_json_schema={"enum": [-32700, -32600, -32601, -32602, -32603, -32000]})]
    message: str
    data: ErrorData | UnsetType = UNSET


class OwnerMessage(Struct, frozen=True):
    """A reply or a notification of the owner. `result` and `params` are decoded by the type of the method."""

    jsonrpc: Literal["2.0"]
    method: str | UnsetType = UNSET
    params: Raw = Raw(b"{}")
    id: RequestId | None = None
    result: Raw | UnsetType = UNSET
    error: ErrorForm | UnsetType = UNSET


# results


class KnownNode(Struct, frozen=True):
    protocol: ProtocolName
    address: Address
    label: str
    health: HealthText


class HelloResult(Struct, frozen=True):
    version: int
    now: Moment
    name: str
    line: str
    baudrate: int | None
    framing: str | None
    echo: bool
    tcp: str | None
    process: int
    read_only: bool
    clients: Count
    refused_connections: Count
    refused_requests: Count
    failed_logins: Count
    state: StateText
    nodes: list[KnownNode]
    groups: list[GroupForm]


class NodeResult(Struct, frozen=True):
    label: str
    health: HealthText


class NoResult(Struct, frozen=True):
    """An empty object."""


class SubscribeResult(Struct, frozen=True):
    period: Duration


class PollResult(Struct, frozen=True):
    period: Duration
    name: str


class QuantilesForm(Struct, frozen=True):
    count: Count
    mean: Number
    p50: Number
    p99: Number
    highest: Number


class DriverErrorsForm(Struct, frozen=True):
    framing: Count
    parity: Count
    breaks: Count
    overruns: Count
    buffer_overruns: Count


class StatisticsResult(Struct, frozen=True):
    elapsed: Duration
    exchanges: Count
    completed: Count
    cancelled: Count
    unexpected_bytes: Count
    noise_bytes: Count
    tainted: Count
    collisions: Count
    resyncs: Count
    quiet_time: Duration
    busy: Duration
    noisy: Count
    losses: Count
    backlog: Count
    waits: Annotated[list[QuantilesForm], Meta(min_length=4, max_length=4)]
    sync_reads: Count
    ambiguous: Count
    damaged: Count
    breaks: Count
    driver: DriverErrorsForm | None
    utilisation: Annotated[float, Meta(ge=0, le=1)]


class MergedForm(Struct, frozen=True):
    node: str
    command: str
    serves: int
    saved: float


class GroupPlanForm(Struct, frozen=True):
    name: str
    period: float
    values: int
    exchanges: int
    line_time: Number
    cycle: Number
    longest_cycle: Number
    missed: Number
    achieved: Number
    worst_wait: Number
    worst_cycle: Number
    merged: list[MergedForm]
    fitting_period: float | None
    could_save: float


class LossesForm(Struct, frozen=True):
    share: Number
    documented: Number
    learned: Number
    windows: Annotated[list[Number], Meta(min_length=2, max_length=2)]


class LineSettingsForm(Struct, frozen=True):
    baudrate: int
    bytesize: int
    parity: str
    stopbits: float


class PlanResult(Struct, frozen=True):
    line: LineSettingsForm
    utilisation: Number
    groups: list[GroupPlanForm]
    typical_wait: Number
    dead_wait: Number
    worst_waits: Annotated[list[Number], Meta(min_length=4, max_length=4, description="By priority, urgent first.")]
    fitting_baudrate: int | None
    losses: LossesForm


class ShownValue(Struct, frozen=True, array_like=True):
    """The value of a point, its quality, the time of its request, its error, and the limit that it exceeds."""

    value: int | float | str | NonFinite | None
    quality: QualityText
    requested: Moment
    error: str
    alarm: Annotated[str, one_of("", "low", "high", "set", "clear")]


class TimelineForm(Struct, frozen=True):
    """The steps of the last exchange; null for what did not happen."""

    queued: Moment
    started: Moment | None
    first_byte: Moment | None
    last_byte: Moment | None
    attempts: Count
    exchanges_ahead: Count
    quiet_time_ahead: Duration


class LimitForm(Struct, frozen=True):
    name: str
    minimum: Number | None
    maximum: Number | None
    max_step: Number | None
    writable: bool


class DetailsResult(Struct, frozen=True):
    command: str
    sample: ShownValue | None
    hint: str
    timeline: TimelineForm | None
    due: Moment | None
    low: Number | None
    high: Number | None
    labels: dict[str, str]
    limits: list[LimitForm]


# notifications


class StopsParams(Struct, frozen=True):
    protocol: ProtocolName
    address: Address
    stops: int


class AccessParams(Struct, frozen=True):
    read_only: bool


class PollGroupsParams(Struct, frozen=True):
    groups: list[GroupForm]


class TouchedParams(Struct, frozen=True):
    protocol: ProtocolName
    address: Address
    when: Moment
    all: bool
    items: list[str] | None


class StreamMessage(Struct, Generic[Body], frozen=True):
    """A message of a stream. `dropped` counts the earlier ones for which the client was too slow."""

    stream: StreamNumber
    dropped: Count
    body: Body


class NoBody(Struct, frozen=True):
    """An empty object."""


class PointsBody(Struct, frozen=True):
    set: Count
    points: list[PointForm]


class SampleForm(Struct, frozen=True, array_like=True):
    value: Value
    error: BusErrorData | None
    due: Moment
    started: Moment | None
    finished: Moment
    wall: Annotated[float, Meta(description="Seconds since 1970.")]
    quality: QualityText
    timeline: Timeline


class SnapshotBody(Struct, frozen=True):
    set: Count
    cycle: Count
    due: Moment
    started: Moment | None
    finished: Moment
    missed: Count
    wall: float
    samples: list[SampleForm]


class EventName(Struct, frozen=True):
    """The field that names an event."""

    event: str


class _NodeEvent(Struct, frozen=True, tag_field="event"):
    protocol: ProtocolName
    address: Address
    label: str


class NodeChangedForm(_NodeEvent, frozen=True, tag="NodeChanged"):
    before: Health
    after: Health
    returning: bool


class MaxReplyDelayRaisedForm(_NodeEvent, frozen=True, tag="MaxReplyDelayRaised"):
    age: Duration
    max_reply_delay: Duration


class MaxReplyDelayLoweredForm(_NodeEvent, frozen=True, tag="MaxReplyDelayLowered"):
    max_reply_delay: Duration


class RepliesLateForm(_NodeEvent, frozen=True, tag="RepliesLate"):
    age: Duration
    window: Duration


class LineChangedForm(Struct, frozen=True, tag_field="event", tag="LineChanged"):
    change: LineChange
    cause: str


class PortFailedForm(Struct, frozen=True, tag_field="event", tag="PortFailed"):
    cause: str
    hint: str
    bug: str | None


class AlarmChangedForm(Struct, frozen=True, tag_field="event", tag="AlarmChanged"):
    point: PointForm
    limit: Literal["low", "high"]
    bound: bool | float | NonFinite
    value: Value
    active: bool


EventForm: TypeAlias = (
    NodeChangedForm
    | MaxReplyDelayRaisedForm
    | MaxReplyDelayLoweredForm
    | RepliesLateForm
    | LineChangedForm
    | PortFailedForm
    | AlarmChangedForm
)


class EventMessage(StreamMessage[EventForm], frozen=True):
    """An event. One of a later version is ignored."""


class UnexpectedBytes(Struct, frozen=True, array_like=True):
    """Bytes that belong to no exchange, and their number; if there are many, only the first are sent."""

    transmissions: Annotated[list[Transmission], Meta(min_length=1)]
    bytes: Count


class Transmission(Struct, frozen=True, array_like=True):
    """Bytes of the master or of a node, in hexadecimal digits."""

    when: Microseconds
    sender: Annotated[str, one_of("master", "node")]
    data: Annotated[str, Meta(pattern="^([0-9a-f]{2})*$")]


class ExchangeForm(UnexpectedBytes, frozen=True, array_like=True):
    """An exchange."""

    ended: Microseconds
    protocol: str
    address: int
    command: str
    writes: bool
    purpose: str
    request: Annotated[int, Meta(ge=1)]
    attempt: Annotated[int, Meta(ge=1)]
    verdict: Annotated[str, one_of("ok", "no reply", "garbled", "refused", "ambiguous", "spoilt", "cut off")]
    result: str
    late: bool
    resynchronised: Annotated[
        int, Meta(ge=0, description="Microseconds for which the line had resynchronised in all, at its beginning.")
    ]


class ExchangesBody(Struct, frozen=True):
    now: Moment
    left_out: Count
    exchanges: list[
        Annotated[
            list[Any],
            Meta(
                min_length=2,
                extra_json_schema={"anyOf": [{"$ref": "#/$defs/ExchangeForm"}, {"$ref": "#/$defs/UnexpectedBytes"}]},
            ),
        ]
    ]


class FrameBody(Struct, frozen=True):
    set: Count
    title: str
    line: str
    settings: str
    read_only: bool
    now: Moment
    elapsed: Duration
    state: StateText
    why: str
    since: Moment | None
    utilisation: Annotated[float, Meta(ge=0, le=1)]
    backlog: Count
    losses: Count
    groups: Count
    nodes: Count
    points: Count
    left_out: Count
    events: list[Annotated[tuple[float, str], Meta(description="A time, and an event as a sentence.")]]


class RowForm(Struct, frozen=True):
    """A point of an overview. `kind`: the protocol of LINE.toml; a microflex uses hcp2."""

    group: str
    key: str
    node: str
    protocol: ProtocolName
    kind: str
    address: Address
    item: str
    unit: str
    precision: Count | None
    writable: bool


class RowsBody(Struct, frozen=True):
    set: Count
    first: Count
    rows: list[RowForm]


class ValuesBody(Struct, frozen=True):
    set: Count
    first: Count
    values: list[ShownValue | None]


class GroupCounts(Struct, frozen=True):
    """`achieved`: the mean period, 0 before the second cycle. `jitter`: how late cycles start, 99 % quantile."""

    name: str
    period: Duration
    paused: bool
    cycles: Count
    missed: Count
    achieved: Duration
    jitter: Duration


class GroupsBody(Struct, frozen=True):
    first: Count
    groups: list[GroupCounts]


class NodeCounts(Struct, frozen=True):
    """`kind`: the protocol of LINE.toml; a microflex uses hcp2."""

    label: str
    protocol: ProtocolName
    kind: str
    address: Address
    health: Annotated[str, one_of(*(health.value for health in Health), "suspended")]
    requests: Count
    failed: Count
    late: Count
    p50: Duration
    p99: Duration


class NodesBody(Struct, frozen=True):
    first: Count
    nodes: list[NodeCounts]
