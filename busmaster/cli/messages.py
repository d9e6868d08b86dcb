"""What the process that owns the line and the process that draws the screen say to each other.

One JSON array a line. A frame is the whole picture, so that one that was skipped because the screen is slow is never
missed; an action is a key that the person pressed.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from busmaster.cli.terminal import printable


class Row(msgspec.Struct, array_like=True, frozen=True):
    """One point. `value` is a number, which the screen formats and draws a trend of, or a text; `age` in seconds.

    `precision` is how many digits it shows behind the point of a number, None for all.

    With an `error`, the value and its age are those of the last good one.
    """

    node: str
    item: str
    value: float | str | None
    unit: str = ""
    age: float | None = None
    late: bool = False
    error: str = ""
    writable: bool = False
    precision: int | None = None


class NodeRow(msgspec.Struct, array_like=True, frozen=True):
    """One node: its health, how many requests were sent and how many of them failed, latencies in seconds."""

    label: str
    health: str
    requests: int = 0
    failed: int = 0
    p50: float = 0.0
    p99: float = 0.0


class GroupRow(msgspec.Struct, array_like=True, frozen=True):
    """One poll group. Periods in seconds; `achieved` is the mean of late, None before the second cycle."""

    name: str
    period: float
    achieved: float | None = None
    p99: float | None = None
    cycles: int = 0
    missed: int = 0
    paused: bool = False


class Frame(msgspec.Struct, array_like=True, frozen=True):
    """The whole picture. `now` in seconds since the start, `utilisation` from 0 to 1 over the last second or so."""

    title: str
    port: str
    now: float
    line: str
    utilisation: float
    backlog: int
    rows: tuple[Row, ...] = ()
    nodes: tuple[NodeRow, ...] = ()
    groups: tuple[GroupRow, ...] = ()
    events: tuple[str, ...] = ()
    read_only: bool = False


class Action(msgspec.Struct, array_like=True, frozen=True):
    """What the person asks.

    `quit`, or `interrupt` (Ctrl-C); `pause` (or go on with) and `demand` the groups; `suspend` (or go on with) the node
    `target`; `write` the text `value` to its point `item`.
    """

    kind: Literal["quit", "interrupt", "pause", "demand", "suspend", "write"]
    target: str = ""
    item: str = ""
    value: str = ""


def encode(message: Frame | Action) -> bytes:
    """Return the message as one line of JSON."""
    return msgspec.json.encode(message) + b"\n"


def decode_frame(line: bytes) -> Frame:
    """Return the frame, without anything in its texts that a terminal would obey."""
    return msgspec.convert(_printable(msgspec.json.decode(line)), Frame)


def _printable(told: Any) -> Any:
    if isinstance(told, str):
        return printable(told)
    return list(map(_printable, told)) if isinstance(told, list) else told


decode_action = msgspec.json.Decoder(Action).decode
