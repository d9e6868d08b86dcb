"""The messages between a line's owner and its clients: JSON-RPC 2.0, and their limits."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from collections.abc import Set as AbstractSet
from math import inf, isnan
from typing import Any

from busmaster import ReplyTiming, Timings
from busmaster.bounds import LONGEST_REPLY, MOST_PARTS
from busmaster.errors import InvalidCommand
from busmaster.ext import Learned, Profile, documented

VERSIONS = (3,)
"""Versions of the service protocol. A client names those that it knows first; the highest common one holds."""


BEFORE_NUMBER = ',"id":'
PLAIN = frozenset((int, float, bool, str, type(None)))
"""Types of values that are encoded without change."""

PARSE_ERROR, INVALID_REQUEST, NO_METHOD, INVALID_PARAMS, INTERNAL, BUS_ERROR = (
    -32700,
    -32600,
    -32601,
    -32602,
    -32603,
    -32000,
)


class Malformed(Exception):
    """An invalid message. `code`: the error code of JSON-RPC."""

    def __init__(self, what: str, code: int = INVALID_REQUEST) -> None:
        super().__init__(what)
        self.code = code


def written(message: Mapping[str, Any]) -> str:
    """Return a message as text. Raises TypeError for a value that JSON does not support."""
    return f'{{"jsonrpc":"2.0",{encoded(message)[1:]}'


def words(method: str, params: Mapping[str, Any]) -> str:
    """Return a request as text, up to its number. Raises TypeError for a value that JSON does not support."""
    return written({"method": method, "params": params})[:-1]


def numbered(words: str, number: int) -> str:
    """Return a question as text, with its number: behind the words, which may be the same as before."""
    return f"{words}{BEFORE_NUMBER}{number}}}"


def answered(number: int, result: Any) -> str:
    """Return the reply to a request as text. Raises TypeError for a result that JSON does not support."""
    return f'{{"jsonrpc":"2.0","id":{number},"result":{encoded(result)}}}'


def encoded(value: Any) -> str:
    """Return a value as JSON. Raises TypeError for a value that JSON does not support."""
    try:
        return "".join(_encode(value, 0))
    except ValueError:  # a number that JSON does not have
        return "".join(_encode(_finite(value), 0))


def read(text: str | bytes) -> dict[str, Any]:
    """Return a message. Raises Malformed for an invalid one."""
    if not isinstance(text, str):
        raise Malformed("a message is text")
    text = text.strip()
    try:
        decoded, end = _decode(text, 0)
    except StopIteration as error:
        raise Malformed(f"not valid JSON: no value begins at {error.value}", PARSE_ERROR) from None
    except (ValueError, RecursionError) as error:
        raise Malformed(f"not valid JSON: {error}", PARSE_ERROR) from None
    if end < len(text):
        raise Malformed("not valid JSON: there is more text after the value", PARSE_ERROR)
    if not isinstance(decoded, dict) or decoded.get("jsonrpc") != "2.0":
        raise Malformed("not a message of JSON-RPC 2.0")
    return decoded


def read_request(text: str | bytes) -> dict[str, Any]:
    """Return a message of a client. Raises Malformed for an invalid one, or one with too many parts."""
    if isinstance(text, str) and len(text) > MOST_PARTS and sum(map(text.count, ",[{")) > MOST_PARTS:
        raise Malformed(f"a message must have at most {MOST_PARTS} values")
    return read(text)


def value_of(decoded: Any) -> Any:
    """Return the original of a decoded value: a list was a tuple, {"members": [...]} a frozenset."""
    if isinstance(decoded, list):
        return tuple(decoded) if PLAIN.issuperset(map(type, decoded)) else tuple(map(value_of, decoded))
    if isinstance(decoded, dict):
        if set(decoded) == {"float"}:
            return float(decoded["float"])
        if set(decoded) == {"members"} and isinstance(decoded["members"], list):
            return frozenset(decoded["members"])
        return {name: value_of(part) for name, part in decoded.items()}
    return decoded


def encode_timings(timings: Timings | Learned | None) -> Any:
    """Return the reply times of a node in the form of a message."""
    if isinstance(timings, Learned):
        return {"learned": encode_timings(timings.document)}
    if timings is None:
        return None
    return {step: _encode_timing(getattr(timings, step)) for step in ("read", "write", "packet")}


def timings_of(decoded: Any) -> Timings | Learned | None:
    """Return the reply times in a message. Raises InvalidCommand for invalid ones."""
    if decoded is None:
        return None
    try:
        if set(decoded) == {"learned"}:
            document = timings_of(decoded["learned"])
            if isinstance(document, Learned):
                raise TypeError("learned twice")
            return Learned(document)
        steps = {step: ReplyTiming(**timing) for step, timing in decoded.items()}
        times = Timings(**steps)
    except (TypeError, KeyError) as error:
        raise InvalidCommand(f"invalid reply times: {error}") from None
    for step in steps.values():
        if (
            max(step.max_reply_delay, step.inter_byte_timeout, step.driver_release_time, step.silence or 0.0)
            > LONGEST_REPLY
        ):
            raise InvalidCommand(f"a program may have the line wait {LONGEST_REPLY:g} s for a reply, and no longer")
    return times


def check_within(times: Timings | Learned | None, profile: Profile, address: int) -> None:
    """Raise InvalidCommand for reply times that keep the line for longer than those of the protocol's document.

    The line sends nothing else while it waits for a reply.
    """
    times, limits = documented(times), profile.timings
    for step in () if times is None else ("read", "write", "packet"):
        for name in ("max_reply_delay", "inter_byte_timeout", "driver_release_time", "silence"):
            asked, limit = getattr(getattr(times, step), name), getattr(getattr(limits, step), name)
            if asked is not None and asked > (getattr(limits, step).max_reply_delay if limit is None else limit):
                raise InvalidCommand(
                    f"{profile.label(address)}: {name} of {asked:g} s is longer than that of {profile.name}: "
                    "set it for the node in the line's file, or use a program with the role admin"
                )


def _encode_timing(timing: ReplyTiming) -> dict[str, float]:
    names = ("late_after", "window", "max_reply_delay", "inter_byte_timeout", "driver_release_time", "silence")
    return {name: value for name in names if (value := getattr(timing, name)) is not None}


def _finite(value: Any) -> Any:
    """Return the same with numbers that JSON does not have as {"float": "inf"}."""
    if isinstance(value, float) and (isnan(value) or value in (inf, -inf)):
        return {"float": str(value)}
    if isinstance(value, dict):
        return {name: _finite(part) for name, part in value.items()}
    return list(map(_finite, value)) if isinstance(value, list | tuple) else value


def _encode_set(value: Any) -> dict[str, list[Any]]:
    """Return a set (flags that are on) in the form of a message. Raises TypeError for any other type."""
    if isinstance(value, AbstractSet):
        return {"members": sorted(value)}
    raise TypeError(f"a {type(value).__name__} cannot be sent")


def _encoder() -> Callable[..., Iterable[str]]:
    """Return what makes the parts of a value's text, which is not indented: 0. It is made once: Python does so anew for
    each value, which takes longer than to use it.
    """
    usual = json.JSONEncoder(separators=(",", ":"), allow_nan=False, default=_encode_set)
    text = json.encoder.encode_basestring_ascii
    try:
        make = json.encoder.c_make_encoder  # type: ignore[attr-defined]  # undocumented
        encode: Callable[..., Iterable[str]] = make(None, usual.default, text, None, ":", ",", False, False, False)
    except (AttributeError, TypeError):  # another Python
        return usual.iterencode
    return encode


_decode: Callable[[str, int], tuple[Any, int]] = json.JSONDecoder().scan_once  # type: ignore[attr-defined]  # undocumented
"""What a text has from a place on, and where that ends: a third of what `loads` takes, which looks for more."""
_encode = _encoder()
