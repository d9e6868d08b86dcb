"""All that is known of one point, in lines: value, node, limits, its last exchange and its past."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rich.text import Text

from busmaster.app.cli.cells import age_text, sparkline
from busmaster.app.cli.output import number_text, value_text
from busmaster.app.cli.terminal import made_printable
from busmaster.app.service.picture import Frame, Group, Node, Row

RECENT = 6
"""Values that are shown as numbers."""
QUALITIES = {"late": "came late", "stale": "older than a write to it"}


def details_text(
    row: Row, node: Node | None, group: Group | None, details: Mapping[str, Any], frame: Frame | None, width: int
) -> Text:
    """Return the details of a point, for `width` columns. `details` is the description from the line's owner."""
    lines = [Text(f"{row.name}  ({row.key})", "bold")]
    facts = _facts(row, node, group, made_printable(dict(details)), frame)
    lines += [Text.assemble((f"{name:<9}", "bold"), text) for name, text in facts]
    numbers = [number for _, number in row.past if number is not None]
    if numbers:
        trend = [number for _, number in row.past][-width:]
        lines.append(Text(sparkline(trend)))
        recent = [value_text(number, row.precision) for number in reversed(trend[-RECENT:])]
        lines.append(Text(f"of late {'  '.join(recent)}"))
        span = row.past[-1][0] - row.past[0][0]
        lowest, highest = (value_text(one, row.precision) for one in (min(numbers), max(numbers)))
        lines.append(Text(f"{len(row.past)} values in {span:.1f} s, {lowest} to {highest}"))
    return Text("\n").join(lines)


def _facts(
    row: Row, node: Node | None, group: Group | None, details: Mapping[str, Any], frame: Frame | None
) -> Iterator[tuple[str, str]]:
    value = f"{value_text(row.value, row.precision)} {row.unit}".rstrip()
    age = f", requested {age_text(frame.now - row.asked)} ago" if frame and row.asked is not None else ""
    yield "value", value + (f", {QUALITIES[row.quality]}" if row.quality in QUALITIES else "") + age
    if row.alarm:
        yield (
            "alarm",
            f"the bit is {row.alarm}" if row.alarm in ("set", "clear") else f"value beyond its {row.alarm} limit",
        )
    if row.error:
        yield "error", f"{row.error}; {details['hint']}" if details.get("hint") else row.error
    if node is not None:
        state = "offline" if frame and frame.state == "offline" else node.health
        times = f"p50 {node.p50 * 1000:.1f}, p99 {node.p99 * 1000:.1f} ms"
        counts = f"{node.requests} requests, {node.failed} failed, {node.late} late, {times}"
        yield "node", f"{node.kind or node.protocol} {node.address}, {state}: {counts}"
    if group is not None:
        yield "group", f"{group.name}, every {group.period * 1000:g} ms{', paused' if group.paused else ''}"
    if details.get("gone"):
        yield "", str(details["gone"])
    elif details:
        yield "limits", _limits_text(row, details)
        yield "asks", str(details["command"])
        if details.get("timeline"):
            yield "exchange", _exchange_text(details["timeline"])


def _limits_text(row: Row, details: Mapping[str, Any]) -> str:
    texts = []
    for limit in details["limits"]:
        bounds = [
            f"{word} {number_text(limit[name])}"
            for name, word in (("minimum", "from"), ("maximum", "to"), ("max_step", "in steps of at most"))
            if limit[name] is not None
        ]
        texts.append(" ".join(bounds))
    if not all(limit["writable"] for limit in details["limits"]):
        written = "may not be written"
    else:
        written = "written " * row.writable
        written += "; ".join(text for text in texts if text) or ("any value" if row.writable else "it is read-only")
    alarms = [f"{name} {number_text(details[name])}" for name in ("low", "high") if details.get(name) is not None]
    return written + (f"; alarm {', '.join(alarms)}" if alarms else "")


def _exchange_text(times: Mapping[str, Any]) -> str:
    """Return why the last exchange took as long as it did, in milliseconds."""
    queued, started = times["queued"], times["started"]
    attempts = times["attempts"]
    if started is None:
        return f"{attempts} attempts, no reply" if attempts else "not sent"
    parts = [f"waited {_ms(started - queued)}"]
    if times["exchanges_ahead"]:
        parts[0] += f" behind {times['exchanges_ahead']}"
    if times["quiet_time_ahead"]:
        parts[0] += f", {_ms(times['quiet_time_ahead'])} of it while the line resynchronised"
    if times["first_byte"] is not None:
        parts.append(f"reply after {_ms(times['first_byte'] - started)}")
    if times["last_byte"] is not None:
        parts.append(f"whole after {_ms(times['last_byte'] - started)}")
    else:
        parts.append("no reply")
    if attempts != 1:
        parts.append(f"{attempts} attempts")
    return ", ".join(parts)


def _ms(seconds: float) -> str:
    return f"{seconds * 1000:.1f} ms"
