"""The messages between a line's owner and its clients: JSON-RPC 2.0.

The tables below have the type of each message. The decoders and docs/service.schema.json are made from them. A message
is decoded in two steps: first its envelope, then its parameters by the type of its method, so that a request with
invalid parameters gets a reply. Unknown fields are ignored.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from functools import lru_cache
from math import isfinite
from typing import Any, NamedTuple, get_args

from busmaster import InvalidCommand
from busmaster.app.bounds import MOST_PARTS
from busmaster.app.service import client_messages as client
from busmaster.app.service import owner_messages as owner
from busmaster.app.service.fields import BusErrorData, GroupForm, NonFinite, Number, Value
from busmaster.app.service.typed import DecodeError, Decoder, Encoder, Raw, Struct, ValidationError, to_builtins

VERSIONS = (3,)
"""Versions of the service protocol. A client names those that it knows first; the highest common one holds."""

PARSE_ERROR, INVALID_REQUEST, NO_METHOD, INVALID_PARAMS, INTERNAL, BUS_ERROR = (
    -32700,
    -32600,
    -32601,
    -32602,
    -32603,
    -32000,
)


class RequestTypes(NamedTuple):
    """The type of a request's parameters, and that of its result."""

    params: Any
    result: Any


REQUESTS: Mapping[str, RequestTypes] = {
    "hello": RequestTypes(client.HelloParams, owner.HelloResult),
    "node": RequestTypes(client.NodeParams, owner.NodeResult),
    "request": RequestTypes(client.RequestParams, Value),
    "check": RequestTypes(client.CheckParams, None),
    "safe": RequestTypes(client.SafeParams, dict[str, BusErrorData | None]),
    "now": RequestTypes(client.NoParams, float),
    "statistics": RequestTypes(client.NoParams, owner.StatisticsResult),
    "groups": RequestTypes(client.NoParams, list[GroupForm]),
    "plan": RequestTypes(client.PlanParams, owner.PlanResult),
    "subscribe": RequestTypes(client.SubscribeParams, owner.SubscribeResult),
    "gather": RequestTypes(client.GatherParams, owner.NoResult),
    "poll": RequestTypes(client.PollParams, owner.PollResult),
    "events": RequestTypes(client.StreamParams, owner.NoResult),
    "exchanges": RequestTypes(client.StreamParams, owner.NoResult),
    "overview": RequestTypes(client.StreamParams, owner.NoResult),
    "details": RequestTypes(client.DetailsParams, owner.DetailsResult),
    "write": RequestTypes(client.WriteParams, None),
    "pause": RequestTypes(client.PauseParams, None),
    "demand": RequestTypes(client.DemandParams, None),
    "suspend": RequestTypes(client.SuspendParams, None),
}
CLIENT_NOTIFICATIONS: Mapping[str, Any] = {
    "cancel": client.CancelParams,
    "refusals": client.RefusalsParams,
    "stop": client.StopParams,
    "hold": client.HoldParams,
    "release": client.SequenceParams,
    "end": client.StreamParams,
}
OWNER_NOTIFICATIONS: Mapping[str, Any] = {
    "stops": owner.StopsParams,
    "access": owner.AccessParams,
    "poll_groups": owner.PollGroupsParams,
    "touched": owner.TouchedParams,
    "points": owner.StreamMessage[owner.PointsBody],
    "snapshot": owner.StreamMessage[owner.SnapshotBody],
    "event": owner.EventMessage,
    "ended": owner.StreamMessage[owner.NoBody],
    "exchanges": owner.StreamMessage[owner.ExchangesBody],
    "frame": owner.StreamMessage[owner.FrameBody],
    "rows": owner.StreamMessage[owner.RowsBody],
    "values": owner.StreamMessage[owner.ValuesBody],
    "groups": owner.StreamMessage[owner.GroupsBody],
    "nodes": owner.StreamMessage[owner.NodesBody],
}

_REQUEST_PARAMS = {method: Decoder(types.params) for method, types in REQUESTS.items()}
_RESULTS = {method: Decoder(types.result) for method, types in REQUESTS.items()}
_CLIENT_PARAMS = {method: Decoder(params) for method, params in CLIENT_NOTIFICATIONS.items()}
_OWNER_PARAMS = {method: Decoder(params) for method, params in OWNER_NOTIFICATIONS.items()}
_CLIENT_MESSAGE = Decoder(client.ClientMessage)
_OWNER_MESSAGE = Decoder(owner.OwnerMessage)
_EVENT_NAME = Decoder(owner.StreamMessage[owner.EventName])
_EVENTS = {kind.__name__.removesuffix("Form") for kind in get_args(owner.EventForm)}
_ENCODER = Encoder()
SHORT = 128
"""Bytes of the parameters of a request, at most, that are kept after they were decoded. Most reads have fewer, and
writes more: a time is in each, so their text is never that of an earlier one."""
KEPT = 1024
"""Requests that are kept: those that were used last, of all clients."""

INVALID = (DecodeError, RecursionError)
"""Exceptions of a decoder. msgspec has no limit for nested values of its own, so the interpreter's ends them."""


class Malformed(Exception):
    """An invalid message. `code`: the error code of JSON-RPC."""

    def __init__(self, what: str, code: int = INVALID_REQUEST) -> None:
        super().__init__(what)
        self.code = code


class InvalidParams(InvalidCommand):
    """The parameters of a request, or of a notification, do not have the type of its method."""

    def __init__(self, method: str, what: str) -> None:
        super().__init__(f"{method}: {what}; service.schema.json has its parameters")


# encoding


class _Request(Struct, frozen=True, tag_field="jsonrpc", tag="2.0"):
    id: int
    method: str
    params: Struct


class _Notification(Struct, frozen=True, tag_field="jsonrpc", tag="2.0"):
    method: str
    params: Struct


class _Result(Struct, frozen=True, tag_field="jsonrpc", tag="2.0"):
    id: int | None
    result: Any


class _Error(Struct, frozen=True, tag_field="jsonrpc", tag="2.0"):
    id: int | None
    error: owner.ErrorForm


def encode(message: object) -> bytes:
    """Return a message, or a part of one, as JSON. Values of protocols must have passed `encode_value`.

    Raises TypeError for a value that JSON does not support.
    """
    try:
        return _ENCODER.encode(message)
    except UnicodeEncodeError:  # the name of a file that is not UTF-8, which Python has as surrogates
        return _ENCODER.encode(_printable(to_builtins(message)))


def encode_request(method: str, number: int, params: Struct) -> bytes:
    """Return a request of a client."""
    return encode(_Request(number, method, params))


def encode_notification(method: str, params: Struct) -> bytes:
    """Return a notification of either side."""
    return encode(_Notification(method, params))


def encode_stream_message(method: str, stream: int, dropped: int, body: Raw) -> bytes:
    """Return a notification of a stream. Its body is already encoded, once for all clients."""
    return _ENCODER.encode(_Notification(method, owner.StreamMessage(stream, dropped, body)))


def encode_result(number: int | None, result: Any) -> bytes:
    """Return the reply to a request."""
    return encode(_Result(number, result))


def encode_error_reply(number: int | None, error: owner.ErrorForm) -> bytes:
    """Return the reply to a request that failed, or with None to a message that is not a request."""
    return encode(_Error(number, error))


def encode_json(value: Any) -> str:
    """Return any value as JSON, in the form of `encode_value`."""
    return encode(encode_value(value)).decode()


def encode_value(value: Any) -> Any:
    """Return a value of a protocol in the form of messages. msgspec would encode infinity as null, and a set as a list.

    Raises TypeError for a value that JSON does not support.
    """
    kind = type(value)
    if kind is int or kind is bool or kind is str:  # most values, and faster than the patterns
        return value
    match value:
        case None | bool() | str():
            return value if value is None or isinstance(value, bool) else str(value)
        case float():
            return float(value) if isfinite(value) else NonFinite(repr(float(value)))
        case int():
            return int(value)
        case list() | tuple():
            return list(map(encode_value, value))
        case Mapping():
            return {str(name): encode_value(part) for name, part in value.items()}
        case AbstractSet():  # flags that are on
            return {"members": sorted(value)}
    raise TypeError(f"a {type(value).__name__} cannot be sent")


def encode_number(value: float) -> Number:
    """Return a number in the form of messages."""
    return value if isfinite(value) else NonFinite(repr(value))


def value_of(decoded: Any) -> Any:
    """Return the original of a decoded value: a list was a tuple, {"members": [...]} a frozenset."""
    if isinstance(decoded, list):
        return tuple(map(value_of, decoded))
    if isinstance(decoded, dict):
        if set(decoded) == {"float"}:
            return float(decoded["float"])
        if set(decoded) == {"members"} and isinstance(decoded["members"], list):
            return frozenset(decoded["members"])
        return {name: value_of(part) for name, part in decoded.items()}
    return decoded


def _printable(value: Any) -> Any:
    """Return the same with "?" for each character that UTF-8 does not have."""
    match value:
        case str():
            return value.encode(errors="replace").decode()
        case list() | tuple():
            return list(map(_printable, value))
        case dict():
            return {_printable(name): _printable(part) for name, part in value.items()}
    return value


# decoding


def decode_client_message(text: str | bytes) -> client.ClientMessage:
    """Return a message of a client, with its parameters still encoded.

    Raises Malformed for an invalid one, or one with too many parts: counting them is faster than decoding them.
    """
    if not isinstance(text, str):
        raise Malformed("a message is text")
    if len(text) > MOST_PARTS and sum(map(text.count, ",[{")) > MOST_PARTS:
        raise Malformed(f"a message must have at most {MOST_PARTS} values")
    try:
        message: client.ClientMessage = _CLIENT_MESSAGE.decode(text)
    except INVALID as error:
        raise _malformed(error) from None
    return message


def decode_owner_message(text: str | bytes) -> owner.OwnerMessage:
    """Return a message of the owner, with its parameters or its result still encoded. Raises Malformed."""
    if not isinstance(text, str):
        raise Malformed("a message is text")
    try:
        message: owner.OwnerMessage = _OWNER_MESSAGE.decode(text)
    except INVALID as error:
        raise _malformed(error) from None
    return message


def decode_request_params(method: str, params: Raw) -> Any:
    """Return the parameters of a request. Raises Malformed for an unknown method, and InvalidParams."""
    if method == "request" and len(params) <= SHORT:
        return _short_request(bytes(params))
    decoder = _REQUEST_PARAMS.get(method)
    if decoder is None:
        raise Malformed(f"no method {method[:40]!r}", NO_METHOD)
    return _decode(decoder, method, params)


@lru_cache(KEPT)
def _short_request(params: bytes) -> client.RequestParams:
    """Return the parameters of a request. Most requests are reads, with the same parameters again and again."""
    decoded: client.RequestParams = _decode(_REQUEST_PARAMS["request"], "request", params)
    return decoded


def decode_client_notification(method: str, params: Raw) -> Any:
    """Return the parameters of a client's notification; None for an unknown method. Raises InvalidParams."""
    decoder = _CLIENT_PARAMS.get(method)
    return None if decoder is None else _decode(decoder, method, params)


def decode_part(method: str, params: Raw) -> Any:
    """Return the part of invalid parameters that a client's notification `method` has, None if it is invalid too."""
    try:
        return _CLIENT_PARAMS[method].decode(params)
    except INVALID:
        return None


def decode_owner_notification(method: str, params: Raw) -> Any:
    """Return the parameters of the owner's notification; None for an unknown method, and for an unknown event.

    Raises InvalidParams.
    """
    if method == "event":
        name: owner.StreamMessage[owner.EventName] = _decode(_EVENT_NAME, method, params)
        if name.body.event not in _EVENTS:
            return None
    decoder = _OWNER_PARAMS.get(method)
    return None if decoder is None else _decode(decoder, method, params)


def decode_result(method: str, result: Raw) -> Any:
    """Return the result of a request. Raises InvalidParams."""
    return _decode(_RESULTS[method], method, result)


def _decode(decoder: Decoder[Any], method: str, part: Raw | bytes) -> Any:
    try:
        return decoder.decode(part)
    except INVALID as error:
        raise InvalidParams(method, reason_of(error)) from None


_PLACE = re.compile(r"(?P<what>.*?)(?: - at `\$\.?(?P<place>.*)`)?", re.DOTALL)
_MISSING = re.compile(r"Object missing required field `(.*)`")


def reason_of(error: Exception) -> str:
    """Return why a decoder has failed, with the name of the field, as in "options.retries: expected `int`"."""
    found = _PLACE.fullmatch(str(error))
    assert found is not None  # it matches any text
    what, place = found["what"], found["place"] or ""
    if (missing := _MISSING.fullmatch(what)) is not None:
        return f"{'.'.join(filter(None, (place, missing[1])))!r} is missing"
    what = what[:1].lower() + what[1:]
    return f"{place}: {what}" if place else what


def _malformed(error: Exception) -> Malformed:
    """Return the error for an invalid envelope."""
    if not isinstance(error, ValidationError):
        return Malformed(f"not valid JSON: {error}", PARSE_ERROR)
    reason = reason_of(error)
    if reason.startswith(("method", "'method'")):
        return Malformed("a message has a method, and its parameters by name")
    if reason.startswith("id:"):
        return Malformed("the id of a request is a whole number")
    return Malformed("not a message of JSON-RPC 2.0")
