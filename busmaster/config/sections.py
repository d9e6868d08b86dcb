"""What a file says, typed and checked; nothing is opened. `config.line` makes a line of it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from busmaster.arbiter.transaction import Priority
from busmaster.bus.suitability import check_company
from busmaster.config.names import NODE_NAME, POINT_NAME, expanded
from busmaster.config.ports import read_port
from busmaster.config.recording import Outputs, read_outputs
from busmaster.config.source import Source
from busmaster.config.table import Table
from busmaster.config.timing import LEARNED_WORD, read_timings, reads_learned
from busmaster.contract.arguments import meant
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.emulator.device import Delay
from busmaster.emulator.faults import NAMES, Faults
from busmaster.errors import InvalidCommand
from busmaster.registry import NodeKind, Option, find, kinds
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort

PRIORITIES = {"poll": Priority.POLL, "background": Priority.BACKGROUND}


@dataclass(frozen=True, slots=True)
class PointSection:
    """What a point is called, and what its number on the line means."""

    name: str
    item: str
    unit: str
    factor: float
    offset: float
    decimals: int
    table: Table = field(compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class NodeSection:
    """`reply_time`: seconds from a request to its reply, where that is known, for planning. `options` are those of the
    protocol's handle."""

    name: str
    protocol: str
    address: int
    timings: Timings | Learned | None
    retries: int | None
    reply_time: float | None
    options: Mapping[str, Any]
    points: Mapping[str, PointSection]
    table: Table = field(compare=False, repr=False)

    @property
    def kind(self) -> NodeKind:
        return find(self.protocol)

    @property
    def profile(self) -> Profile:
        return self.kind.profile


@dataclass(frozen=True, slots=True)
class GroupSection:
    """`points` as the file has them: `drive4-8/speed_measured,current`."""

    name: str
    period: float
    phase: float | None
    priority: Priority
    points: tuple[str, ...]
    table: Table = field(compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class EmulatorSection:
    """The line's emulation. Node by node: reply delays and faults."""

    paced: bool
    seed: int
    lively: bool
    delays: Mapping[str, Delay]
    faults: Mapping[str, Faults]


@dataclass(frozen=True, slots=True)
class LineFile:
    """All that one file says. `table` is the whole of it, for messages."""

    path: str
    title: str
    port: SerialPort | TcpPort
    strict: bool
    nodes: Mapping[str, NodeSection]
    groups: Mapping[str, GroupSection]
    outputs: Outputs
    emulator: EmulatorSection
    table: Table = field(compare=False, repr=False)


def load(path: str | os.PathLike[str]) -> LineFile:
    """Read a file. Raises OSError if it cannot be read; FileError, naming line and key, for what is wrong in it."""
    return read(Source.read(path))


def read(source: Source) -> LineFile:
    """Raises FileError, naming line and key."""
    top = Table(source)
    top.only("title", "port", "strict", "timing", "protocols", "nodes", "groups", "outputs", "emulator")
    nodes = {node.name: node for node in _nodes(top, _defaults(top))}
    groups = {table.name: _group(table) for table in top.tables("groups")}
    file = LineFile(
        path=source.name,
        title=top.text("title", os.path.basename(source.name)),
        strict=top.flag("strict", False),
        port=read_port(top, [node.profile for node in nodes.values()]),
        nodes=nodes,
        groups=groups,
        outputs=read_outputs(top.table("outputs"), groups),
        emulator=_emulator(top.table("emulator"), nodes),
        table=top,
    )
    if not nodes:
        raise top.error("there are no nodes: describe each in a table of its own, [nodes.NAME]")
    return file


# nodes


def _defaults(top: Table) -> dict[str, Table]:
    """`[protocols.hcp2]`: what holds for all nodes of one protocol that do not say otherwise."""
    tables = {table.name: table for table in top.tables("protocols")}
    top.table("protocols").only(*kinds())
    for protocol, table in tables.items():
        common = (option.name for option in find(protocol).options if option.common)
        table.only("timing", "retries", "reply_time", *common)
    return tables


def _nodes(top: Table, defaults: Mapping[str, Table]) -> Iterator[NodeSection]:
    taken: dict[tuple[str, int], str] = {}
    names: set[str] = set()
    profiles: dict[str, Profile] = {}
    learned = top.choice("timing", (LEARNED_WORD,), None) is not None
    for table in top.tables("nodes"):
        for node in _several(table, defaults, learned):
            with table.at("protocol"):
                check_company(node.profile, profiles.values())
            profiles.setdefault(node.profile.name, node.profile)
            if node.name in names:
                raise table.error(f"there are two nodes {node.name!r}")
            names.add(node.name)
            other = taken.setdefault((node.profile.name, node.address), node.name)
            if other != node.name:
                raise table.error(f"node {other!r} has address {node.address} already", "address")
            yield node


def _several(table: Table, defaults: Mapping[str, Table], learned: bool) -> Iterator[NodeSection]:
    """The nodes of one table: several where its name is a range. `learned`: the line's reply times are."""
    protocol = table.choice("protocol", kinds())
    own = find(protocol).options
    _check_own(table, protocol)
    with table.at():
        names = list(expanded(table.name))
    profile = find(protocol).profile
    addresses = _addresses(table, profile)
    if len(names) != len(addresses):
        raise table.error(f"{len(names)} names need as many addresses, not {len(addresses)}", "address")
    default = defaults.get(protocol, Table(table.source, ("protocols", protocol), {}))
    base = read_timings(default, profile.timings)
    document = read_timings(table, base)
    is_learned = reads_learned(table, reads_learned(default, learned))
    timings = Learned(document) if is_learned else None if document == profile.timings else document
    retries = table.whole("retries", default.whole("retries", None, most=100), most=100)
    reply_time = table.seconds("reply_time", default.seconds("reply_time", None))
    options = {**_options(default, own), **_options(table, own)}
    points = {point.name: _point(point) for point in table.tables("points")}
    for name, address in zip(names, addresses, strict=True):
        if not NODE_NAME.fullmatch(name):
            raise table.error(f"a node's name is of letters, digits, _, . and -, not {name!r}")
        yield NodeSection(
            name=name,
            protocol=protocol,
            address=address,
            timings=timings,
            retries=retries,
            reply_time=reply_time,
            options=options,
            points=points,
            table=table,
        )


def _check_own(table: Table, protocol: str) -> None:
    """Raises FileError for a key that nodes of this kind do not have."""
    names = {kind.name: [option.name for option in kind.options] for kind in kinds().values()}
    for key in table.data:
        holders = [name for name, options in names.items() if key in options]
        if holders and protocol not in holders:
            raise table.error(f"only nodes of {' and '.join(holders)} have this, not those of {protocol}", key)
    table.only("protocol", "address", "timing", "retries", "reply_time", "points", *names[protocol])


def _addresses(table: Table, profile: Profile) -> Sequence[int]:
    """`address = 5`, or `address = "4-8"`."""
    if not profile.addressed:
        if "address" in table:
            raise table.error(f"{profile.name} has no addresses: one drive a line", "address")
        return profile.addresses
    if not isinstance(table.data.get("address"), str):
        addresses = [table.whole("address")]
    else:
        text = table.text("address")
        with table.at("address"):
            addresses = [int(part) if part.isdigit() else _no_address(text) for part in expanded(text.strip())]
    with table.at("address"):
        for address in addresses:
            profile.check_address(address)
            if address == profile.broadcast:
                raise InvalidCommand(f"{address} means all nodes of {profile.name}: it is no node's own")
    return addresses


def _no_address(text: str) -> int:
    raise InvalidCommand(f'an address is a number, or a range such as "4-8", not {text!r}')


def _options(table: Table, known: Sequence[Option]) -> dict[str, Any]:
    """Those of them that the table has."""
    return {option.name: _option(table, option) for option in known if option.name in table}


def _option(table: Table, option: Option) -> Any:
    match option.kind:
        case "addresses":
            named = table.table(option.name)
            return {name: named.whole(name, most=0xFFFF_FFFF) for name in named.data}
        case "flag":
            return table.flag(option.name, False)
        case "text":
            return table.text(option.name)
        case "whole":
            return table.whole(option.name, least=1)


def _point(table: Table) -> PointSection:
    table.only("item", "unit", "factor", "offset", "decimals")
    if not POINT_NAME.fullmatch(table.name):
        raise table.error(f"a point's name has no spaces, commas or slashes: {table.name!r} has")
    factor = table.number("factor", 1)
    if not factor:
        raise table.error("a factor of 0 makes every value the same", "factor")
    return PointSection(
        name=table.name,
        item=table.text("item", table.name),
        unit=table.text("unit", ""),
        factor=factor,
        offset=table.number("offset", 0),
        decimals=table.whole("decimals", 0, most=9),
        table=table,
    )


# groups and the emulator


def _group(table: Table) -> GroupSection:
    table.only("period", "phase", "points", "priority")
    return GroupSection(
        name=table.name,
        period=table.seconds("period"),
        phase=table.seconds("phase", None),
        priority=PRIORITIES[table.choice("priority", PRIORITIES, "poll")],
        points=table.texts("points"),
        table=table,
    )


def _emulator(table: Table, nodes: Mapping[str, NodeSection]) -> EmulatorSection:
    table.only("paced", "seed", "lively", "reply_delay", "faults", "nodes")
    delays = dict.fromkeys(nodes, _delay(table, Delay()))
    shared = table.table("faults")
    shared.only(*NAMES)
    faults = {name: _faults(shared, {}) for name in nodes}
    for one in table.tables("nodes"):
        one.only("reply_delay", "faults")
        with one.at():
            names = list(expanded(one.name, nodes))
        for name in names:
            if name not in nodes:
                raise one.error(f"no such node {name!r}; {meant(name, nodes)}")
            delays[name] = _delay(one, delays[name])
            faults[name] = _faults(one.table("faults"), shared.data)
    return EmulatorSection(
        paced=table.flag("paced", True),
        seed=table.whole("seed", 1),
        lively=table.flag("lively", True),
        delays=delays,
        faults=faults,
    )


def _delay(table: Table, default: Delay) -> Delay:
    """`reply_delay = 0.002`, or `reply_delay = [0.001, 0.004]`."""
    value = table.data.get("reply_delay")
    if value is None:
        return default
    bounds = value if isinstance(value, list) else [value]
    if len(bounds) not in (1, 2) or not all(type(bound) in (int, float) for bound in bounds):
        raise table.error("must be a number of seconds, or two of them: [0.001, 0.004]", "reply_delay")
    with table.at("reply_delay"):
        return Delay(*bounds)


def _faults(table: Table, base: Mapping[str, Any]) -> Faults:
    """Those of the table over `base`."""
    table.only(*NAMES)
    faults = Faults()
    for name, rate in {**base, **{name: table.number(name) for name in table.data}}.items():
        with table.at(name):
            setattr(faults, name, rate)
    return faults
