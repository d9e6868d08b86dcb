"""A command that arrives as text: one or several values, and optionally an id and an expiry time."""

from __future__ import annotations

import json
from typing import Any, NamedTuple, TypeGuard

from busmaster import InvalidCommand
from busmaster.app.bounds import LARGEST_VALUE, LONGEST_COMMAND, LONGEST_ID

LATEST = 1e11
"""Seconds since 1970. A later time, some thousand years from now, is in milliseconds."""


class Payload(NamedTuple):
    """`expires` is in seconds since 1970; None if it is not given."""

    value: Any
    id: str = ""
    expires: float | None = None


class NoCommand(InvalidCommand):
    """A text is not a command. `id` is the one that it contains nevertheless, "" for none."""

    def __init__(self, fault: str, mark: str) -> None:
        self.id = mark
        super().__init__(fault)


def read_payload(payload: object) -> Payload:
    """Read `12.5`, `[1, 2]`, or `{"value": 12.5, "id": "a1", "expires": 1767225600}`. Raises NoCommand."""
    raw = payload if isinstance(payload, bytes | bytearray) else str(payload).encode()
    if len(raw) > LONGEST_COMMAND:
        raise NoCommand(f"a command must have at most {LONGEST_COMMAND} bytes, not {len(raw)}", "")
    text = bytes(raw).decode(errors="replace")
    try:
        decoded = json.loads(text, parse_constant=lambda name: name)
    except (ValueError, RecursionError):
        decoded = None
    mark = decoded.get("id", "") if isinstance(decoded, dict) else ""
    shown = str(mark)
    if not isinstance(mark, str | int) or isinstance(mark, bool) or len(shown) > LONGEST_ID or not shown.isprintable():
        raise NoCommand(f"an id must be a whole number, or a text of one line with at most {LONGEST_ID} characters", "")
    try:
        value, expires = _read(decoded, text)
    except InvalidCommand as error:
        raise NoCommand(str(error), shown) from None
    return Payload(value, shown, expires)


def _read(decoded: Any, text: str) -> tuple[Any, float | None]:
    """Return the value and the expiry time."""
    if not isinstance(decoded, dict):
        return _numbers(decoded, text), None
    if not set(decoded) <= {"value", "id", "expires"} or "value" not in decoded:
        raise InvalidCommand(f'{text[:40]!r} is not a command; use {{"value": ..., "id": ..., "expires": ...}}')
    expires = decoded.get("expires")
    if expires is not None and not _is_number(expires):
        raise InvalidCommand("expires must be a time in seconds since 1970")
    if expires is not None and expires > LATEST:
        raise InvalidCommand("expires must be a time in seconds since 1970, not in milliseconds")
    return _numbers(decoded["value"], text), expires


def _numbers(value: Any, text: str) -> Any:
    numbers = value if isinstance(value, list) else [value]
    if not numbers or not all(map(_is_number, numbers)):
        raise InvalidCommand(f"{text[:40]!r} is neither a number nor a list of numbers")
    if any(abs(number) > LARGEST_VALUE for number in numbers):
        raise InvalidCommand(f"{text[:40]!r} is larger than {LARGEST_VALUE:g}")
    return value


def _is_number(value: object) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool)
