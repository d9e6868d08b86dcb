"""The line that a file describes: a bus, its nodes by name, its poll groups by name, and its outputs."""

from __future__ import annotations

import os
from collections.abc import Callable, Container, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from fnmatch import fnmatchcase
from itertools import islice
from operator import is_
from types import TracebackType
from typing import Any, Protocol, Unpack

from busmaster import Bus, Endpoint, InvalidCommand, Node, Point, PollGroup, ext
from busmaster.app.config.names import SHOWN, expanded, listed
from busmaster.app.config.point_section import PointSection, check_suits, sort_of
from busmaster.app.config.points import NamedPoint, Scale
from busmaster.app.config.recording import check_takes
from busmaster.app.config.sections import GroupSection, LineFile, NodeSection, decimals_of, load
from busmaster.app.config.service import RoleSection, ServiceSection
from busmaster.app.line.kept_times import KeptTimes
from busmaster.app.line.safe_state import SafeState, SafeWrite
from busmaster.app.outputs.distributor import Distributor, Wanted
from busmaster.app.outputs.kinds import find
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.permission import Access, Permission
from busmaster.ext import (
    MOST_MEMBERS,
    Handle,
    Limit,
    NodeSource,
    Placed,
    Plan,
    PlannedGroup,
    Send,
    Tap,
    WriteOptions,
    guess,
    is_decimal,
    meant,
)

ALL = "*"


class Names(Protocol):
    """What a line's file names."""

    @property
    def nodes(self) -> Mapping[str, Handle]: ...

    def points_named(self, text: str, /) -> Iterator[Point[Any]]:
        """Yield the points that a text names. Raises InvalidCommand."""
        ...


def access_of(section: ServiceSection, names: Names, secrets: Mapping[str, bytes] | None = None) -> Access:
    """Return the permissions. Raises FileError for an unknown point, and for one that cannot be permitted alone."""
    return Access(
        users={uid: _permission(role, names) for uid, role in section.users.items()},
        groups={gid: _permission(role, names) for gid, role in section.groups.items()},
        tokens={name: _permission(role, names) for name, role in section.tokens.items()},
        secrets=secrets or {},
    )


def _permission(role: RoleSection, names: Names) -> Permission:
    if role.allow_writes is None:
        return Permission(role.who, role.role)
    only: dict[tuple[str, int], frozenset[Hashable] | None] = {}
    for number, text in enumerate(role.allow_writes):
        with role.table.part(), role.table.at("allow_writes", number):
            for (protocol, address), places in _places(text, names):
                before = only.get((protocol, address), frozenset())
                only[protocol, address] = None if before is None or places is None else before | places
    return Permission(role.who, role.role, only)


def _places(text: str, names: Names) -> Iterator[tuple[tuple[str, int], frozenset[Hashable] | None]]:
    """Yield by node what `drive*/speed,current` names, None for all of the node: `press/*`."""
    pattern, slash, items = text.partition("/")
    nodes = [name for name in names.nodes if fnmatchcase(name, pattern)] if slash and ALL in pattern else [pattern]
    if not nodes:
        raise InvalidCommand(f"no node matches {pattern!r}; the nodes are {', '.join(names.nodes)}")
    for name in nodes:
        if items == ALL and name in names.nodes:
            yield _key(names.nodes[name]), None
            continue
        for point in names.points_named(f"{name}/{items}" if slash else text):
            if not point.writable:
                raise InvalidCommand(f"{point.key} is read-only")
            if not isinstance(point.command, Placed):
                raise InvalidCommand(f"{point.key} cannot be permitted alone; permit {name}/*")
            yield (point.node.profile.name, point.node.address), frozenset(point.command.places)


def _key(handle: Handle) -> tuple[str, int]:
    return handle.node.profile.name, handle.node.address


class ConfiguredLine:
    """A line made of a file. Use it in `async with`: entering opens the port and starts groups and outputs.

    `nodes` are the handles by the file's names; `groups` the poll groups, once it is entered. Raises FileError with
    line and key for settings that the protocols or the outputs do not support. `port` is used instead of the file's.
    `tap` receives every byte. Without `outputs`, nothing is recorded or published. `report` is called, on the loop,
    with the events of the outputs. `read_only` rejects all writes from outside; `authorisation` checks each of them.
    With `wait_for_port`, a port that cannot be opened yet is not an error. A line that never `asks` only listens and is
    not entered: its outputs do not report the state of line and nodes.
    """

    def __init__(
        self,
        file: LineFile,
        *,
        port: Endpoint | None = None,
        outputs: bool = True,
        tap: Tap | None = None,
        report: Callable[[str], None] = lambda _: None,
        read_only: bool = False,
        wait_for_port: bool = False,
        asks: bool = True,
    ) -> None:
        self.file = file
        self.bus = Bus(port or file.port, tap=tap, strict=file.strict, wait_for_port=wait_for_port)
        self.nodes: dict[str, Handle] = {}
        for name, node in file.nodes.items():
            with node.table.part():
                self.nodes[name] = self._handle(node)
        if len(self.nodes) < len(file.nodes):  # problems are collected
            self.file = replace(file, nodes={name: file.nodes[name] for name in self.nodes})
        self.groups: dict[str, PollGroup] = {}
        self._points: dict[str, NamedPoint] = {}
        self._limits = list(self._held_limits())
        self._wanted = self._members_of_groups()
        self.safe_state = SafeState(file.safe.within, tuple(self._safe_writes()))
        self.authorisation = Authorisation(self.bus, read_only=read_only, access=access_of(file.service, self))
        self.authorisation.safe_state = self.safe_state
        self.outputs = Distributor(self.bus, report, authorisation=self.authorisation, asks=asks)
        self._kept_times = KeptTimes(self.bus, self._report)
        self.authorisation.record = self.outputs.record
        self._has_outputs = outputs
        if outputs:
            self._add_outputs()

    async def __aenter__(self) -> ConfiguredLine:
        """Open the port, and start the groups and the outputs. Raises LineDown if the port cannot be opened."""
        await self.bus.__aenter__()
        try:
            await self._kept_times.start(self.file.learned, self._own_nodes())
            self._start_groups()
            self.outputs.start(self.groups.values())
        except BaseException:
            await self.__aexit__(None, None, None)
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close the line first. The outputs then have a few seconds to write their queued data."""
        self.authorisation.leaving = True
        try:
            await self.bus.__aexit__(kind, error, traceback)
        finally:
            await self._kept_times.close()
            await self.outputs.close()

    async def take(self, file: LineFile, secrets: Mapping[str, bytes] | None = None) -> None:
        """Apply a changed file, and its tokens: digests by name; None keeps the present ones.

        Unchanged groups keep their grid and streams. Groups whose section or points changed are closed and created
        again. So are outputs; the other outputs are reopened. Raises InvalidCommand, before any change, for changes
        that need a restart, such as another port or other settings of a node. The file must be valid for a line.
        """
        check_same_line(self.file, file)
        fresh = {name: self._handle(node) for name, node in file.nodes.items() if name not in self.nodes}
        before, points, wanted = self.file, self._points, self._wanted
        self.nodes = {name: self.nodes.get(name) or fresh[name] for name in file.nodes}
        self.file = file
        self._kept_times.take(file.learned, self._own_nodes())
        self._points = {name: point for name, point in points.items() if _section(before, name) == _section(file, name)}
        held, self._limits = self._limits, list(self._held_limits())
        for node, limit in held:
            node.lift(limit)
        self._wanted = self._members_of_groups()
        self.safe_state = SafeState(file.safe.within, tuple(self._safe_writes()))
        self.authorisation.safe_state = self.safe_state
        secrets = self.authorisation.access.secrets if secrets is None else secrets
        self.authorisation.access = access_of(file.service, self, secrets)
        for name, group in list(self.groups.items()):
            same = before.groups[name] == file.groups.get(name) and wanted[name] == self._wanted[name]
            # by identity: points are equal whatever their scale and unit, which may be what changed
            if not (same and all(map(is_, wanted[name], self._wanted[name]))):
                del self.groups[name]
                group.close()
        self._start_groups()
        # Up to here in one turn of the loop. A command that an output still takes while it is closed is written by the
        # scale that it was sent for, within the limits of now: those are of the quantity.
        outputs = dict(self._wanted_outputs()) if self._has_outputs else {}
        await self.outputs.replace(outputs, self.groups.values())

    def point(self, name: str) -> NamedPoint:
        """Return the point with this name in the file: "winder/position", "press/2008:32".

        Raises InvalidCommand for a name that is not a point of the line.
        """
        node, slash, item = name.partition("/")
        if not slash or node not in self.nodes:
            raise InvalidCommand(f"no such point {name!r}; use NODE/ITEM, with a node of {', '.join(self.nodes)}")
        return self._point(node, item)

    def points_named(self, text: str) -> Iterator[NamedPoint]:
        """Yield the points that `drive4-8/speed,current` names. Raises InvalidCommand for an unknown point."""
        return (self._point(*name) for name in self._names(text))

    def handle(self, node: str, bus: NodeSource | None = None) -> Handle:
        """Return the handle of a node, over `bus` where that is another than the line's own."""
        return self.nodes[node] if bus is None else handle_of(self.file.nodes[node], bus)

    def prepare_write(
        self, name: str, values: Sequence[float], *, bus: NodeSource | None = None, **options: Unpack[WriteOptions]
    ) -> Send:
        """Return a function that writes a value to the named point, or the values of a run, in the point's unit.

        It uses `bus` if that is not the line's own, but that of the program that owns the line. `RequestOptions`
        describes the options. Raises InvalidCommand for values that cannot be sent, or are beyond a limit.
        """
        point = self.point(name)
        if not point.writable:
            raise InvalidCommand(f"{name} is read-only")
        if point.encode is not None and len(values) > 1:
            try:
                point.encode(tuple(values))
            except (ArithmeticError, TypeError, ValueError) as error:
                raise InvalidCommand(
                    f"{name} does not accept {len(values)} values ({error}); write decimals with a point"
                ) from None
        handle = self.handle(point.where, bus)
        # one call for several exchanges: a partial write must not look like none or all
        [send] = ext.prepare_write(handle, point.source.item, list(map(point.unscaled, values)), **options)
        return send

    def audit(self, report: Callable[[str], None] = lambda _: None) -> Distributor:
        """Return the outputs of the file that keep an audit log, for a process that does not poll.

        They are not started, do not report the line's state, and accept no commands. Raises InvalidCommand if an extra
        is missing.
        """
        audit = Distributor(self.bus, report, in_charge=False)
        for kind, settings in self.file.outputs.items():
            if find(kind).keeps_audit:
                with self.file.table.table("outputs").table(kind).at():
                    audit.add(kind, settings)
        return audit

    def members(self, group: str) -> tuple[Point[Any], ...]:
        """Return the points of a poll group of the file."""
        return self._wanted[group]

    def plan(self) -> Plan:
        """Work out whether the file's poll groups fit its line. This is pure arithmetic: nothing is opened."""
        planned = (
            PlannedGroup(
                group.name,
                group.period,
                [(Node.of(point).planned(), point.command) for point in self._wanted[group.name]],
                phase=group.phase,
                priority=group.priority,
            )
            for group in self.file.groups.values()
            if group.name not in self.groups  # one that runs is in the plan of the bus already
        )
        return ext.plan_at_once(self.bus, *planned)

    # inside

    def _report(self, text: str) -> None:
        self.outputs.report(text)

    def _own_nodes(self) -> dict[str, Node]:
        return {name: Node.of(handle) for name, handle in self.nodes.items()}

    def _start_groups(self) -> None:
        """Start the groups that do not run."""
        for group in self.file.groups.values():
            if group.name not in self.groups:
                with group.table.at():
                    self.groups[group.name] = self.bus.poll_group(
                        group.name,
                        period=group.period,
                        phase=group.phase,
                        priority=group.priority,
                        points=self._wanted[group.name],
                    )
        self.groups = {name: self.groups[name] for name in self.file.groups}  # in the file's order

    def _handle(self, node: NodeSection) -> Handle:
        with node.table.at():
            handle = handle_of(node, self.bus, timings=node.timings, retries=node.retries)
            own = Node.of(handle)
            _use_sync_reads(node, handle)
            if node.reply_time is not None:
                ext.set_reply_time(own, node.reply_time)  # until it is measured
            if not is_decimal(node.name):
                ext.rename(own, node.name)  # what messages and the screen call it
        for point in node.points.values():
            with point.table.at(*(["item"] if "item" in point.table else [])):
                source = handle.point(point.item)  # looked up for its complaint, which has the line here
            check_suits(point, source, node.kind)
            _check_bits(node, point, handle)
        return handle

    def _held_limits(self) -> Iterator[tuple[Node, Limit]]:
        """Apply the limits of the file's points to all of their names, and return the limits."""
        for node in self.file.nodes.values():
            for name, section in node.points.items():
                if section.limited:
                    with section.table.part(), section.table.at():
                        point = self._point(node.name, name)
                        limit = point.limit(
                            minimum=section.minimum,
                            maximum=section.maximum,
                            max_step=section.max_step,
                            writable=section.writable,
                        )
                        yield Node.of(point), limit

    def _members_of_groups(self) -> dict[str, tuple[NamedPoint, ...]]:
        """Return the points of each group. Raises FileError where a group names more than are left for it."""
        wanted: dict[str, tuple[NamedPoint, ...]] = {}
        left = MOST_MEMBERS
        for group in self.file.groups.values():
            wanted[group.name] = ()
            with group.table.part():
                members = tuple(islice(self._members(group), left + 1))
                if len(members) > left:
                    raise group.table.error(f"the groups have more than {MOST_MEMBERS} points; remove some", "points")
                left -= len(members)
                wanted[group.name] = members
        return wanted

    def _members(self, group: GroupSection) -> Iterator[NamedPoint]:
        for number, text in enumerate(group.points):
            with group.table.at("points", number):
                for name in self._names(text):
                    point = self._point(*name)
                    point.command.open(point.node.address, Node.of(point).timings)  # refused here, not while it runs
                    yield point
                    yield from (self._point(name[0], bit.item) for bit in point.bits)

    def _names(self, text: str) -> Iterator[tuple[str, str]]:
        """Yield nodes and items of `drive4-8/speed_measured,current`.

        Raises InvalidCommand for names that cannot be read.
        """
        nodes, slash, items = text.partition("/")
        if not slash:
            raise InvalidCommand(f"{text!r} is not a point; write NODE/ITEM")
        count = 0
        for node in (name for part in listed(nodes) for name in expanded(part, self.nodes)):
            if node not in self.nodes:
                raise InvalidCommand(f"no such node {node!r}; {meant(node, self.nodes)}")
            section = self.file.nodes[node]
            bits = (f"{point.name}.{bit}" for point in section.points.values() for bit in point.meaning.bits)
            symbols = section.options.get("symbols", ())
            # a1-3 can be a name, and then it is not a range
            known = {*section.points, *symbols, *bits}
            for item in (name for part in listed(items) for name in _expanded_item(part, known, symbols)):
                count += 1
                if count > MOST_MEMBERS:
                    raise InvalidCommand(f"{text[:SHOWN]!r} expands to more than {MOST_MEMBERS} points")
                yield node, item

    def _point(self, where: str, name: str) -> NamedPoint:
        key = f"{where}/{name}"
        if key not in self._points:
            self._points[key] = self._make_point(where, name)
        return self._points[key]

    def _make_point(self, where: str, name: str) -> NamedPoint:
        node = self.file.nodes[where]
        section = node.points.get(name)
        handle = self.nodes[where]
        if section is None and (word := _word_of(node, name)) is not None:
            return self._point(where, word.name).bit(name.removeprefix(f"{word.name}."))
        if section is None:
            bits = (f"{point.name}.{bit}" for point in node.points.values() for bit in point.meaning.bits)
            source = _known(handle, name, (*node.points, *bits))
            return NamedPoint.of(source, where=where, name=name, unit="", scale=Scale.of())
        rounds = node.kind.takes_decimals and (section.decimals or node.kind.decimals(section.item))
        whole = not rounds and node.kind.whole_numbers(section.item)  # else the handle rounds, to its decimals
        scale = Scale.of(section.factor, section.offset, whole=whole)
        source = handle.point(section.item)
        return NamedPoint.of(
            source,
            where=where,
            name=name,
            unit=section.unit,
            scale=scale,
            declared=section.writable,
            meaning=section.meaning,
            read_after_write=section.read_after_write,
        )

    def _safe_writes(self) -> Iterator[SafeWrite]:
        """Yield the writes of `[safe]`, in their order there."""
        section = self.file.safe
        table = section.table.table("writes")
        known: dict[object, str] = {}
        with section.table.part():
            for name in section.repeatable:
                if name not in table.data:
                    raise section.table.error(f"{name} is not in writes; add it there, or remove it", "repeatable")
        for name, value in section.writes.items():
            with table.part(), table.at(name):
                point = self.point(name)
                other = known.setdefault(point.quantity, name)
                if other != name:
                    raise InvalidCommand(f"is the same quantity as {other}; remove one of them")
                handle = self.nodes[name.partition("/")[0]]
                yield SafeWrite.of(point, handle, value, repeatable=name in section.repeatable)

    def _add_outputs(self) -> None:
        for kind, wanted in self._wanted_outputs():
            table = self.file.table.table("outputs").table(kind)
            with table.part(), table.at():
                wanted.settings.check_files(table.at)  # an error in a file has its key
                self.outputs.add(kind, wanted.settings, commands=wanted.commands)

    def _wanted_outputs(self) -> Iterator[tuple[str, Wanted]]:
        for kind, settings in self.file.outputs.items():
            table = self.file.table.table("outputs").table(kind)
            with table.part():
                for group in settings.groups or self._wanted:
                    points = self._wanted.get(group, ())  # a group with a problem has none
                    check_takes(table, kind, settings, group, {point.key: self._sort(point) for point in points})
                writable: dict[str, Point[Any]] = {}
                key, texts = settings.writable
                for number, text in enumerate(texts):
                    with table.at(key, number):
                        writable |= {point.key: point for point in map(self._writable, self._names(text))}
                yield kind, Wanted(settings, writable)

    def _sort(self, point: NamedPoint) -> str:
        node = self.file.nodes[point.where]
        return sort_of(point.source, node.kind) if _word_of(node, point.item) is None else "bit"

    def _writable(self, name: tuple[str, str]) -> Point[Any]:
        point = self._point(*name)
        if not point.writable:
            raise InvalidCommand(f"{point.key} is read-only")
        return point


def check_same_line(before: LineFile, after: LineFile) -> None:
    """Raise InvalidCommand for changes of the port or of a node that a running line cannot apply."""
    if (before.port, before.strict) != (after.port, after.strict):
        raise InvalidCommand("changes of the port need a restart")
    if before.service != after.service:
        raise InvalidCommand("changes of [service] need a restart")
    own = {_address(node): node for node in before.nodes.values()}
    for node in after.nodes.values():
        known = before.nodes.get(node.name) or own.get(_address(node))  # renamed, it has other settings
        if known is not None and _settings(known) != _settings(node):
            raise InvalidCommand(f"changes of node {node.name!r} need a restart")


def _address(node: NodeSection) -> tuple[str, int]:
    return node.profile.name, node.address


TAKES_EFFECT = {"points", "template", "table"}
"""Fields of a node whose changes take effect when the file is reloaded. Every other one needs a restart."""


def _settings(node: NodeSection) -> tuple[object, ...]:
    decimals = decimals_of(node) if node.kind.takes_decimals else None
    return (decimals, *(getattr(node, each.name) for each in fields(node) if each.name not in TAKES_EFFECT))


def _section(file: LineFile, name: str) -> PointSection | None:
    """Return the section of a point with this name, or of the word to which the named bit belongs.

    None for a point that is named by its item, and for a point of an unknown node.
    """
    node, _, point = name.partition("/")
    section = file.nodes.get(node)
    return None if section is None else section.points.get(point) or _word_of(section, point)


def _expanded_item(part: str, known: Container[str], symbols: Container[str]) -> Iterator[str]:
    """Yield the items that `part` stands for. In a run of a symbol (a1-3:32), the symbol is not a range."""
    symbol, colon, count = part.partition(":")
    if colon and symbol in symbols and part not in known:
        return (f"{symbol}:{number}" for number in expanded(count))
    return expanded(part, known)


def _word_of(node: NodeSection, name: str) -> PointSection | None:
    """Return the word of which `name` is a bit; None where it is none."""
    word, dot, bit = name.rpartition(".")
    section = node.points.get(word) if dot else None
    return section if section is not None and bit in section.meaning.bits else None


def _check_bits(node: NodeSection, word: PointSection, handle: Handle) -> None:
    """Raise FileError for a bit whose name is that of something else."""
    for bit in word.meaning.bits:
        name = f"{word.name}.{bit}"
        if name in node.points or _has(handle, name):
            raise word.table.error(f"{node.name} has another point or item {name}; rename one", "bits", bit)


def _has(handle: Handle, item: str) -> bool:
    try:
        handle.point(item)
    except InvalidCommand:
        return False
    return True


def _known(handle: Handle, item: str, points: Iterable[str]) -> Point[Any]:
    try:
        return handle.point(item)
    except InvalidCommand:
        if near := guess(item, points):
            raise InvalidCommand(f"no such item {item!r}{near}") from None
        raise


def _use_sync_reads(node: NodeSection, handle: Handle) -> None:
    """Set the probe and the sync reads that the file has for a node. Items may be named as its points are."""
    items = {name: point.item for name, point in node.points.items()}
    if node.probe is not None:
        with node.table.at(*(["probe"] if "probe" in node.table else [])):
            handle.use_sync_reads(probe=items.get(node.probe, node.probe))
    if node.sync_reads:
        with node.table.at(*(["sync_reads"] if "sync_reads" in node.table else [])):
            handle.use_sync_reads(sync_reads=[items.get(item, item) for item in node.sync_reads])


def handle_of(node: NodeSection, bus: NodeSource, **options: Any) -> Handle:
    """Return the handle of a node of the file, with the options of its protocol, on a bus. Raises InvalidCommand."""
    options |= node.options
    if node.kind.takes_decimals:
        options["decimals"] = decimals_of(node)
    make: Callable[..., Handle] = node.kind.handle
    return make(bus, node.address, **options)


def open_line(path: str | os.PathLike[str], *, outputs: bool = True, tap: Tap | None = None) -> ConfiguredLine:
    """Return the line that a LINE.toml describes, to be used in `async with`.

        async with open_line("line.toml") as line:
            await line.nodes["winder"].write(1, 123.456)
            async for snapshot in line.groups["axes"]: ...

    Its outputs run too, unless `outputs` is False. Raises OSError if the file cannot be read, and InvalidCommand with
    file, line and key for an error in it, or for an output whose extra is not installed.
    """
    return ConfiguredLine(load(path), outputs=outputs, tap=tap)
