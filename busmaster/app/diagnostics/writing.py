"""A LINE.toml for the nodes that were found: it polls every node that replied, and is a start for the user's own."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from statistics import median
from typing import Any

from busmaster import LineSettings, Rfc2217Port, Rs485, SerialPort, TcpPort
from busmaster.app.config.rewriting import toml_text
from busmaster.app.diagnostics.diagnosis import milliseconds, percentile, rounded_up, speed
from busmaster.app.diagnostics.search import Discovery, Found
from busmaster.ext import identity

SHORTEST_WRITTEN_PERIOD = 0.5
ROOM = 2.0
"""How much longer than its exchanges a cycle of all nodes may take."""
NEAR = 0.75
"""Of a window: a node that took longer gets a longer one."""


def line_text(port: SerialPort | TcpPort, discovery: Discovery) -> str:
    """Return the text of a LINE.toml with the nodes that were found, at least one, on that port."""
    found = discovery.found
    names = {node: _name(node, found) for node in found}
    polled = [node for node in found if not node.refuses]
    lines = [
        f"# What answered on {port.name}: {summary(discovery)}.",
        "# `busmaster items PROTOCOL` lists what else can be read.",
        "",
        'title = "Discovered line"',
        *_timing(found),
        "",
        *_port(port, discovery),
    ]
    for node in found:
        lines += ["", *_node(names[node], node)]
    if polled:
        points = [f"{names[node]}/{node.kind.probe_item}" for node in polled]
        lines += [
            "",
            "[groups.all]",
            f"period = {_period(discovery.settings, polled):g}",
            f"points = {toml_text(points)}",
        ]
    return "\n".join(lines) + "\n"


def lasting(port: SerialPort | TcpPort) -> SerialPort | TcpPort:
    """Return a USB adapter's port by a name that stays its own; any other port as it is. May block."""
    if isinstance(port, SerialPort) and not port.path.startswith(identity.USB):
        with contextlib.suppress(OSError):  # it has just gone
            device = identity.usb_device(os.stat(port.path).st_rdev)
            if device is not None and (name := identity.lasting_name(device)):
                return replace(port, path=name)
    return port


def summary(discovery: Discovery) -> str:
    """Return the result in a few words: "Host Comms Protocol 2 at 57600 8N1, nodes 1, 2, 5"."""
    texts = []
    for protocol in dict.fromkeys(node.protocol for node in discovery.found):
        nodes = [node for node in discovery.found if node.protocol is protocol]
        at = "" if discovery.settings is None else f" at {speed(discovery.settings)}"
        some = ", ".join(str(node.address) for node in nodes)
        who = f"{'node' if len(nodes) == 1 else 'nodes'} {some}" if protocol.profile.addressed else "one drive"
        texts.append(f"{protocol.profile.title}{at}, {who}")
    return "; ".join(texts)


def _timing(found: Sequence[Found]) -> Iterator[str]:
    """Yield the line that has reply times learned, if they can be of one of these nodes."""
    if any(node.protocol.profile.checked_requests for node in found):
        yield 'timing = "learned"  # reply times from the replies: a lost reply then holds up the line for less'


def _name(node: Found, found: Sequence[Found]) -> str:
    if not node.protocol.profile.addressed:
        return "drive"
    alone = len({other.protocol.name for other in found}) == 1
    return f"node{node.address}" if alone else f"{node.kind.name}_{node.address}"


def _port(port: SerialPort | TcpPort, discovery: Discovery) -> Iterator[str]:
    """Yield the lines of [port]: the settings that were found, and the user's settings that are not the defaults."""
    table = _set(port)
    if isinstance(table.get("rs485"), Rs485):
        table["rs485"] = _set(table["rs485"])
    if discovery.settings is not None and isinstance(port, SerialPort | Rfc2217Port):
        table |= dataclasses.asdict(discovery.settings)
    if discovery.echo:
        table["echo"] = True
    if isinstance(port, Rfc2217Port):
        table = {"rfc2217": True} | table
    yield "[port]"
    yield from (f"{key} = {toml_text(value)}" for key, value in table.items())


def _set(settings: SerialPort | TcpPort | Rs485) -> dict[str, Any]:
    """Return the values that are not the defaults, by their names."""
    values = {field: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    return {field.name: value for field, value in values.items() if value != field.default}


def _node(name: str, node: Found) -> Iterator[str]:
    kind = node.kind
    others = [other.name for other in node.protocol.kinds if other is not kind]
    times = " / ".join(map(milliseconds, (node.starts[0], median(node.starts), percentile(node.starts))))
    yield f"[nodes.{name}]"
    yield f"# its reply: {' '.join(node.text.split())}; replies began after {times} ms (least / median / p99)"
    yield f"protocol = {toml_text(kind.name)}" + (f"  # or {', '.join(map(toml_text, others))}" if others else "")
    if node.protocol.profile.addressed:
        yield f"address = {node.address}"
    yield f"reply_time = {max(0.001, round(median(node.starts), 4)):g}"
    window = node.protocol.profile.timings.read.window
    slowest = node.starts[-1]
    if slowest > NEAR * window:
        yield f"timing = {{ window = {rounded_up(2 * slowest):g} }}"


def _period(settings: LineSettings | None, nodes: Sequence[Found]) -> float:
    """Return a period, in seconds, in which all of them can be read with time to spare."""
    total = sum(node.starts[-1] + 64 * (settings or node.protocol.profile.line).byte_time for node in nodes)
    return max(SHORTEST_WRITTEN_PERIOD, math.ceil(2 * ROOM * total) / 2)


__all__ = ["lasting", "line_text", "summary"]
