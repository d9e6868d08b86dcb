"""The types of fields that several messages of the service have. Their limits are in `busmaster.app.bounds`."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, TypeAlias

from busmaster import Health, InvalidCommand, Priority, Quality
from busmaster.app.bounds import LONGEST_REPLY, LONGEST_WAIT
from busmaster.app.service.typed import UNSET, Meta, Raw, Struct, UnsetType
from busmaster.ext import MOST_RETRIES, CommandOptions, Protocol, protocols

LARGEST_STREAM = 2**53
"""The largest whole number that every client has, JavaScript included."""
LARGEST_ADDRESS = 2**31


def one_of(*texts: str) -> Meta:
    """Return the values of a text in the schema. A receiver accepts others: a later version may add some."""
    return Meta(extra_json_schema={"enum": list(texts)})


def defined_as(name: str) -> Meta:
    """Return the reference to a definition of the schema, for a field that is decoded in a second step."""
    return Meta(extra_json_schema={"$ref": f"#/$defs/{name}"})


@cache  # it is called for each request of a client
def protocol_of(name: str) -> Protocol:
    """Return the protocol of a name. Raises InvalidCommand if there is none."""
    for protocol in protocols():
        if protocol.name == name:
            return protocol
    raise InvalidCommand(f"no such protocol {name!r}; there are {', '.join(one.name for one in protocols())}")


Count = Annotated[int, Meta(ge=0)]
Duration = Annotated[float, Meta(ge=0, description="Seconds.")]
Moment = Annotated[float, Meta(description="Seconds of the owner's monotonic clock.")]
Microseconds = Annotated[int, Meta(description="Microseconds of the owner's monotonic clock.")]
RequestId = Annotated[
    int, Meta(description="A number of the client's own; two requests in progress must not have the same.")
]
ProtocolName = Annotated[str, Meta(description="The name of a protocol.")]
Address = Annotated[int, Meta(ge=0, le=LARGEST_ADDRESS, description="The address of a node in its protocol.")]
StreamNumber = Annotated[int, Meta(ge=0, le=LARGEST_STREAM, description="A number of the client's own.")]
Sequence = Annotated[int, Meta(ge=0, description="A number of the client's own.")]
HealthText = Annotated[str, one_of(*(health.value for health in Health))]
QualityText = Annotated[str, one_of(*(quality.value for quality in Quality))]
StateText = Annotated[str, one_of("ready", "resynchronising", "offline")]
WaitLimit = Annotated[float, Meta(ge=0, description=f"Seconds; at most {LONGEST_WAIT:g}.")]
"""A longer time is refused with a hint, after decoding."""

CommandForm = Annotated[
    dict[str, Any],
    Meta(
        description="A command by its name, with its arguments as its protocol defines them.",
        extra_json_schema={"properties": {"command": {"type": "string"}}, "required": ["command"]},
    ),
]
Value = Annotated[Any, defined_as("Value")]
"""A value of a protocol, in the form of `encode_value`."""
VALUE_SCHEMA: dict[str, Any] = {
    "description": "The result of an exchange, as its protocol defines it. A list stands for a tuple.",
    "anyOf": [
        {"type": ["null", "boolean", "string", "number"]},
        {"$ref": "#/$defs/NonFinite"},
        {"type": "array", "items": {"$ref": "#/$defs/Value"}},
        {
            "description": "A set, such as the flags that are on.",
            "type": "object",
            "properties": {"members": {"type": "array"}},
            "required": ["members"],
            "additionalProperties": False,
        },
        {"type": "object"},
    ],
}


class NonFinite(Struct, frozen=True):
    """A number that JSON does not have, by its name."""

    float: Annotated[str, one_of("nan", "inf", "-inf")]


Number: TypeAlias = float | NonFinite


class OptionsForm(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Options of a request. An unknown option is refused: the client relies on it."""

    priority: Priority | None = None
    start_within: WaitLimit | None = None
    finish_within: WaitLimit | None = None
    retries: Annotated[int, Meta(ge=0, le=MOST_RETRIES)] | None = None
    idempotent: bool | None = None


def shortened(options: CommandOptions, by: float) -> CommandOptions:
    """Return the options of a request that has waited, its times reduced by that. Both ends do this."""
    left = options.copy()
    if (start_within := left.get("start_within")) is not None:
        left["start_within"] = max(0.0, start_within - by)
    if (finish_within := left.get("finish_within")) is not None:
        left["finish_within"] = max(0.0, finish_within - by)
    return left


LimitedTime = Annotated[float, Meta(ge=0, description=f"Seconds; at most {LONGEST_REPLY:g}.")]
"""Seconds for which the line waits. A longer time is refused with a hint, after decoding."""


class TimingForm(Struct, frozen=True, omit_defaults=True):
    """Reply times of one kind of exchange, in seconds."""

    late_after: Duration
    window: Duration
    max_reply_delay: LimitedTime
    inter_byte_timeout: LimitedTime
    driver_release_time: LimitedTime
    silence: LimitedTime | None = None


class TimingsForm(Struct, frozen=True):
    """Reply times of a node."""

    read: TimingForm
    write: TimingForm
    packet: TimingForm


class ReplyTimesForm(Struct, frozen=True):
    """Reply times of a node, or `learned` alone: the node's times are learned, beginning with these."""

    read: TimingForm | UnsetType = UNSET
    write: TimingForm | UnsetType = UNSET
    packet: TimingForm | UnsetType = UNSET
    learned: TimingsForm | UnsetType | None = UNSET


REPLY_TIMES_SCHEMA: dict[str, Any] = {
    "oneOf": [
        {"required": ["learned"], "maxProperties": 1},
        {"required": ["read", "write", "packet"], "maxProperties": 3},
    ]
}
"""The rule of ReplyTimesForm that is checked after decoding."""


class PointForm(Struct, frozen=True):
    """A point: the command that reads it, and its names, which an owner does not need."""

    protocol: ProtocolName
    address: Address
    command: CommandForm
    key: str = ""
    item: str = ""
    unit: str = ""


class GroupForm(Struct, frozen=True):
    """A poll group of the line."""

    name: str
    period: Duration


class BusErrorData(Struct, frozen=True, omit_defaults=True):
    """An error of the line: its class, and the fields of the class."""

    error: str
    what: str
    line: str | None
    label: str | None
    address: int | None
    command: str | None
    attempts: Count
    hint: str | None
    confirm: bool | UnsetType = UNSET
    temporary: bool | UnsetType = UNSET
    cause: str | BusErrorData | UnsetType = UNSET


class InvalidCommandData(Struct, frozen=True):
    """A refused request."""

    error: Annotated[str, Meta(extra_json_schema={"const": "InvalidCommand"})]
    what: str


ErrorData = Annotated[
    Raw,
    Meta(extra_json_schema={"anyOf": [{"$ref": "#/$defs/BusErrorData"}, {"$ref": "#/$defs/InvalidCommandData"}]}),
]
"""Decoded in a second step: its field `error` decides which of the two it is."""
