"""The state of a watched line: its points with their recent values, groups, nodes and last events."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

from busmaster import Health, Quality
from busmaster.app.service.messages import value_of
from busmaster.app.service.touches import Touches

KEPT_VALUES = 120
"""Of each point, for its trend."""
OLD_AFTER = 3
"""Periods of its group without a cycle after which a value is old."""
LEAST_AGE = 1.0
"""Seconds after which a value is old at the earliest, however fast its group is."""
Identity: TypeAlias = tuple[str, str, int]
"""Group and key of a point, and how many like it the group has before it."""
CURRENT = frozenset(quality.value for quality in Quality if quality.is_current)


@dataclass(slots=True)
class Row:
    """One point of one poll group. `value` is the last good one, a number or a text; `asked` the time of its request.

    `quality` is the present one: "bad" with an `error`, "stale" after a write to its place, else that of the read.
    """

    group: str
    key: str
    node: str
    protocol: str
    address: int
    item: str
    unit: str = ""
    precision: int | None = None
    writable: bool = False
    value: float | str | None = None
    kind: str = ""
    """Its protocol in LINE.toml: a "microflex" uses hcp2. "" if an older owner does not send it."""
    quality: str = ""
    asked: float | None = None
    error: str = ""
    """The error of the last cycle."""
    alarm: str = ""
    """The limit that it has left, low or high; of a bit that is an alarm set or clear."""
    past: deque[tuple[float, float | None]] = field(default_factory=lambda: deque(maxlen=KEPT_VALUES))
    """Time of the request, and the number; None for no value."""
    number: int = 0

    @property
    def identity(self) -> Identity:
        """Its key, which never changes."""
        return self.group, self.key, self.number

    @property
    def name(self) -> str:
        """Node and item."""
        return f"{self.node} {self.item}"

    def take(self, value: Any, quality: str, asked: float, error: str, alarm: str, *_: Any) -> None:
        """Store the result of a cycle, or a later change of it by a write or a loss of the line."""
        self.error, self.alarm, self.quality = error, alarm, quality
        if not error:
            self.value, self.asked = value, asked
        if not (self.past and self.past[-1][0] == asked):
            self.past.append((asked, value if isinstance(value, int | float) and not error else None))

    def lose(self, why: str) -> None:
        """Note that the present value is unknown. The last value is kept, but is not good."""
        self.error, self.quality = why, Quality.BAD.value

    def doubt(self, touches: Touches) -> None:
        """Mark a good value as stale if it was requested before the end of a write to its place."""
        if self.quality not in CURRENT or self.asked is None:
            return
        if touches.is_stale(self.protocol, self.address, self.item, self.asked):
            self.quality = Quality.STALE.value

    def go_on(self, before: Row) -> None:
        """Continue with the data of the same point."""
        if (self.protocol, self.address, self.unit) == (before.protocol, before.address, before.unit):
            self.value, self.quality, self.asked = before.value, before.quality, before.asked
            self.error, self.alarm, self.past = before.error, before.alarm, before.past


@dataclass(frozen=True, slots=True)
class Node:
    """One node: its health, how many requests were sent and how many of them failed, latencies in seconds."""

    label: str
    protocol: str
    address: int
    health: str
    requests: int = 0
    failed: int = 0
    late: int = 0
    p50: float = 0.0
    p99: float = 0.0
    kind: str = ""
    """As of a Row."""


@dataclass(frozen=True, slots=True)
class Group:
    """One poll group. Times in seconds; `jitter` is the 99 % quantile of how late its cycles start."""

    name: str
    period: float
    cycles: int = 0
    missed: int = 0
    achieved: float = 0.0
    jitter: float = 0.0
    paused: bool = False

    @property
    def old_after(self) -> float:
        """Age of its values from which they are old."""
        return old_after(self.period, self.achieved)


@dataclass(frozen=True, slots=True)
class Frame:
    """The line itself. Times are in seconds: `now` by the bus's clock, `elapsed` since the last reset of the counts.

    `utilisation` is from 0 to 1.
    """

    title: str
    line: str
    settings: str
    read_only: bool
    now: float
    elapsed: float
    state: str
    utilisation: float
    backlog: int
    losses: int
    groups: int
    nodes: int
    points: int
    left_out: int
    events: tuple[tuple[float, str], ...]
    why: str = ""
    """Why the line is lost."""
    since: float | None = None
    """Since when it is, by the bus's clock."""


class Picture:
    """The state of a line, built from the messages of its owner. `receive` takes them.

    `clean` prepares received values for the display: it restores them, and can also remove control characters.
    """

    def __init__(self, clean: Callable[[Any], Any] = value_of) -> None:
        self._clean = clean
        self.frame: Frame | None = None
        self._set = 0
        self._rows: dict[int, list[Row]] = {}
        self._values: dict[int, Sequence[Any]] = {}
        self._known: dict[Identity, Row] = {}
        self._groups: dict[int, list[Group]] = {}
        self._nodes: dict[int, list[Node]] = {}
        self._touches = Touches()

    def receive(self, method: str, decoded: Mapping[str, Any]) -> None:
        """Handle one message of the line's owner. Additions of later versions are ignored."""
        body = self._clean(decoded)
        match method:
            case "frame":
                self._begin(body.pop("set"))
                body["events"] = tuple((when, text) for when, text in body["events"])
                self.frame = _made(Frame, body)
            case "rows":
                self._begin(body["set"])
                if body["set"] == self._set:
                    self._take_rows(body["first"], body["rows"])
            case "values":
                self._begin(body["set"])
                if body["set"] == self._set:
                    self._values[body["first"]] = body["values"]
                    self._take_values(body["first"])
            case "touched":
                self._touches.note(body)
                for row in self.rows:
                    row.doubt(self._touches)
            case "groups":
                self._groups[body["first"]] = [_made(Group, decoded) for decoded in body["groups"]]
            case "nodes":
                self._nodes[body["first"]] = [_made(Node, decoded) for decoded in body["nodes"]]

    def lose(self, why: str) -> None:
        """Note that the program that owns the line is gone: no node is up, and no value is good."""
        for row in self.rows:
            row.lose(why)
        for nodes in self._nodes.values():
            nodes[:] = [replace(node, health=Health.OFFLINE.value) for node in nodes]
        if self.frame is not None:
            self.frame = replace(self.frame, state="offline", why=why, since=None)

    def _begin(self, number: int) -> None:
        """Begin a new set of points, if this is one: its parts may come in any order."""
        if number > self._set:
            self._set = number
            self._known = {row.identity: row for row in self.rows}
            self._rows.clear()
            self._values.clear()

    def _take_rows(self, first: int, decoded: Sequence[Mapping[str, Any]]) -> None:
        self._rows[first] = rows = [_made(Row, row) for row in decoded]
        alike: dict[tuple[str, str], int] = {}
        for row in self.rows:
            row.number = alike.get((row.group, row.key), 0)
            alike[row.group, row.key] = row.number + 1
        for row in rows:
            if (before := self._known.get(row.identity)) is not None:
                row.go_on(before)
        self._take_values(first)

    def _take_values(self, first: int) -> None:
        for row, value in zip(self._rows.get(first, ()), self._values.get(first, ()), strict=False):
            if value is not None:
                row.take(*value)
                row.doubt(self._touches)  # it may have been read before a write that was reported before it

    @property
    def rows(self) -> list[Row]:
        """The points, in the order of the groups."""
        return [row for first in sorted(self._rows) for row in self._rows[first]]

    @property
    def groups(self) -> list[Group]:
        """The poll groups."""
        groups = [group for first in sorted(self._groups) for group in self._groups[first]]
        return groups[: self.frame.groups] if self.frame else []

    @property
    def nodes(self) -> dict[tuple[str, int], Node]:
        """The nodes, by protocol and address, in the order of the bus."""
        nodes = [node for first in sorted(self._nodes) for node in self._nodes[first]]
        return {(node.protocol, node.address): node for node in nodes[: self.frame.nodes if self.frame else 0]}


def old_after(period: float, achieved: float) -> float:
    """Return the age, in seconds, from which values of a group are old: it had no cycle for so long."""
    return max(LEAST_AGE, OLD_AFTER * max(period, achieved))


def _made(kind: Any, decoded: Mapping[str, Any]) -> Any:
    """Return the object of these fields, without those that it does not have."""
    return kind(**{name: decoded[name] for name in kind.__dataclass_fields__ if name in decoded})


def matching(rows: list[Row], nodes: Mapping[tuple[str, int], Node], words: str) -> Iterator[Row]:
    """Yield the rows in whose names, group, unit, health or error each of the words is."""
    wanted = words.lower().split()
    if not wanted:
        yield from rows
        return
    for row in rows:
        node = nodes.get((row.protocol, row.address))
        text = f"{row.node} {row.item} {row.key} {row.group} {row.unit} {node.health if node else ''} {row.error}"
        if all(word in text.lower() for word in wanted):
            yield row
