"""The typed and checked contents of a file. Nothing is opened. `app.line` makes a line from it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, Literal, TypeVar

from busmaster import InvalidCommand, Priority, SerialPort, TcpPort, Timings
from busmaster.app.bounds import LONGEST_TIMING, LONGEST_TITLE
from busmaster.app.config.emulator import EmulatorSection, read_emulator
from busmaster.app.config.keys import (
    Form,
    Internal,
    keys_of,
    names_of,
    number,
    read_keys,
    read_section,
    table_of,
    tables_of,
)
from busmaster.app.config.names import NODE_NAME, expanded
from busmaster.app.config.options import check_keys, read_options
from busmaster.app.config.point_section import PointSection
from busmaster.app.config.ports import PORT, read_port
from busmaster.app.config.recording import Outputs, read_outputs
from busmaster.app.config.safe import SafeSection, read_safe
from busmaster.app.config.service import ServiceSection, read_service
from busmaster.app.config.source import Source
from busmaster.app.config.table import Table
from busmaster.app.config.templates import read_points
from busmaster.app.config.timing import LEARNED_WORD, TIMING, read_timings, reads_learned
from busmaster.app.outputs.base import check_folder
from busmaster.ext import (
    LONGEST_PERIOD,
    MOST_RETRIES,
    SHORTEST_PERIOD,
    Between,
    Learned,
    NodeKind,
    Parsed,
    Poll,
    Profile,
    check_company,
    find,
    is_decimal,
    kinds,
)

T = TypeVar("T")

NO_PORT = TcpPort("127.0.0.1", 1)
"""Stands for a port that cannot be read, where all problems of a file are collected. It is never opened."""
PRIORITIES = {"poll": Priority.POLL, "background": Priority.BACKGROUND}
PROTOCOL = Form("text", {"$ref": "#/$defs/protocol_name"}, lambda table, key: table.choice(key, kinds()), written=str)
ADDRESS = Form("whole number, or range as text", {"anyOf": [{"type": "integer", "minimum": 0}, {"type": "string"}]})


@dataclass(frozen=True, slots=True, kw_only=True)
class ProtocolSection:
    """Defaults for all nodes of one protocol."""

    timings: Annotated[Timings | Learned | None, TIMING]
    """Its reply times: a table, or `"learned"`. The protocol's by default."""
    retries: Annotated[int | None, Between(0, MOST_RETRIES)] = None
    """How often a failed read is repeated."""
    reply_time: Annotated[float | None, Between(0, LONGEST_TIMING, "s")] = None
    """Time from a request to its reply, if it is known; `plan` uses it."""
    probe: str | None = None
    """The item that is read to find out whether a node replies. The protocol's by default."""
    sync_reads: tuple[str, ...] = ()
    """Items that are read where the line must prove that replies match requests: cheap ones that the device has, at
    least two. The protocol's by default."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeSection(ProtocolSection):
    """The section of one node. `options` are those of the protocol's handle."""

    name: Internal[str]
    protocol: Annotated[str, PROTOCOL]
    """The protocol of the node."""
    address: Annotated[int, ADDRESS]
    """Its address; `"4-7"` where NAME is a range too. Not allowed for a protocol without addresses."""
    template: str | None = None
    """The template of its points: one that is shipped, or a file, from the folder of this one."""
    points: Annotated[Mapping[str, PointSection], tables_of("point")]
    """A table for each point that has a name, a unit, or limits: `[nodes.NAME.points]`."""
    options: Internal[Mapping[str, Any]]
    table: Internal[Table] = field(compare=False, repr=False)

    @property
    def kind(self) -> NodeKind:
        return find(self.protocol)

    @property
    def profile(self) -> Profile:
        return self.kind.profile

    @property
    def could_learn(self) -> bool:
        """Whether reply times could be learned of it, and are not."""
        return self.profile.checked_requests and not isinstance(self.timings, Learned)


PRIORITY = Parsed(
    {"poll": Priority.POLL, "background": Priority.BACKGROUND}.__getitem__,
    Literal["poll", "background"],
    written=lambda priority: priority.name.lower(),
)


def _read_period(table: Table, key: str) -> float:
    period = table.seconds(key, most=LONGEST_PERIOD)
    with table.at(key):
        Poll(table.name, period)  # made for its message alone, which has the line here
    return period


PERIOD = replace(number(Between(SHORTEST_PERIOD, LONGEST_PERIOD, "s")), read=_read_period)


@dataclass(frozen=True, slots=True, kw_only=True)
class GroupSection:
    """The section of one poll group. `points` are in the form of the file: `drive4-8/speed_measured,current`."""

    name: Internal[str]
    period: Annotated[float, PERIOD]
    """From one cycle to the next."""
    points: tuple[str, ...]
    """Points to read: `"drive4-7/speed_measured,current"` is eight points."""
    phase: Annotated[float | None, Between(0, LONGEST_PERIOD, "s")] = None
    """Start of each cycle within the period. By default the group avoids the cycles of the others."""
    priority: Annotated[Priority, PRIORITY] = Priority.POLL
    """`background`: only in the time that the other groups leave."""
    table: Internal[Table] = field(compare=False, repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class LineFile:
    """The contents of one file. `table` is the whole file, for messages."""

    path: Internal[str]
    title: Annotated[str, Between(most=LONGEST_TITLE)] = ""
    """The name of the line in lists, views and pages. By default the file's name."""
    port: Annotated[SerialPort | TcpPort, PORT]
    """The PORT, as on the command line: a device path, `usb:SERIAL`, or `socket://HOST:PORT`; or a table: `[port]`."""
    strict: bool = False
    """Whether a reply that could belong to another request is held until it is certain (R15)."""
    timing: Literal["learned"] | None = None
    """The windows of all nodes are learned from their replies, except where a read request carries no checksum."""
    learned: str | None = None
    """The file in which learned windows are kept from one run to the next."""
    protocols: Annotated[Mapping[str, Table], table_of("protocols")] = field(compare=False)
    """A table for each protocol, of what holds for its nodes: `[protocols.NAME]`."""
    nodes: Annotated[Mapping[str, NodeSection], tables_of("node", required=True)]
    """A table for each node: `[nodes.NAME]`."""
    groups: Annotated[Mapping[str, GroupSection], tables_of("group")]
    """A table for each poll group: `[groups.NAME]`."""
    outputs: Annotated[Outputs, table_of("outputs")]
    """A table for each output: `[outputs.csv]` and others."""
    safe: Annotated[SafeSection, table_of("safe")]
    """The safe state, written when the line is left: `[safe]`."""
    service: Annotated[ServiceSection, table_of("service")]
    """Other programs that can use the line: `[service]`."""
    emulator: Annotated[EmulatorSection, table_of("emulator")]
    """What `busmaster emulate` makes of the nodes: `[emulator]`."""
    table: Internal[Table] = field(compare=False, repr=False)


def load(path: str | os.PathLike[str]) -> LineFile:
    """Read a file. Raises OSError if it cannot be read; FileError with line and key for an error in it."""
    return read(Source.read(path))


def read(source: Source) -> LineFile:
    """Read a line from a source. Raises FileError with line and key for an error in it."""
    top = Table(source)
    top.only(*names_of(keys_of(LineFile)))
    values: dict[str, Any] = {}
    for key in keys_of(LineFile):
        with top.part():
            values |= read_keys(top, [key])
    no_protocols: dict[str, Table] = {}
    protocols = _value(top, _protocols, no_protocols)
    no_nodes: dict[str, NodeSection] = {}
    nodes = _value(top, partial(_nodes, defaults=protocols, learned="timing" in values), no_nodes)
    port: SerialPort | TcpPort = NO_PORT
    profiles = _profiles(top)
    if profiles or not source.unread:  # without a protocol it would miss a baud rate
        port = _value(top, partial(read_port, profiles=profiles), port)
    with top.part():
        _check_learned(top, values.get("learned"), nodes.values())
    file = LineFile(
        **{"title": os.path.basename(source.name), **values},
        path=source.name,
        port=port,
        protocols=protocols,
        nodes=nodes,
        groups=_value(top, _groups, {}),
        outputs=top.read("outputs", partial(read_outputs, groups=top.table("groups").data)),
        safe=top.read("safe", read_safe),
        service=top.read("service", read_service),
        emulator=top.read("emulator", partial(read_emulator, nodes={node.name: node.kind for node in nodes.values()})),
        table=top,
    )
    if not top.table("nodes").data:
        source.keep(top.error("the file has no nodes; define each in a table of its own, [nodes.NAME]"))
    return file


def _value(top: Table, read: Callable[[Table], T], instead: T) -> T:
    """Return what `read` makes of a part of the file; `instead` if it has a problem and problems are collected."""
    found = [instead]
    with top.part():
        found.append(read(top))
    return found[-1]


def _profiles(top: Table) -> list[Profile]:
    """Return the profiles of the protocols that the file's nodes name."""
    named = {node.get("protocol") for node in top.table("nodes").data.values() if isinstance(node, dict)}
    return [kind.profile for name, kind in kinds().items() if name in named]


def _check_learned(top: Table, path: str | None, nodes: Iterable[NodeSection]) -> None:
    """Raise FileError for a file of learned reply times that is not used, or whose folder does not exist."""
    if path is None:
        return
    learns = any(isinstance(node.timings, Learned) for node in nodes)
    if not learns and not top.source.unread:  # a node that could not be read may be one that learns
        raise top.error(f'has no effect, because reply times are not learned; add timing = "{LEARNED_WORD}"', "learned")
    with top.at("learned"):
        check_folder(path)


# nodes


def _protocols(top: Table) -> dict[str, Table]:
    """Read `[protocols.hcp2]`: defaults for all nodes of one protocol."""
    top.table("protocols").only(*kinds())
    tables = {table.name: table for table in top.tables("protocols") if table.name in kinds()}
    for protocol, table in tables.items():
        common = (option.name for option in find(protocol).options if option.common)
        table.only(*names_of(keys_of(ProtocolSection)), *common)
    return tables


def _nodes(top: Table, defaults: Mapping[str, Table], learned: bool) -> dict[str, NodeSection]:
    """Read `[nodes]`, and return the nodes by name."""
    nodes: dict[str, NodeSection] = {}
    taken: dict[tuple[str, int], str] = {}
    profiles: dict[str, Profile] = {}
    for table in top.tables("nodes"):
        with table.part():
            for node in _several(table, defaults, learned):
                with table.at("protocol"):
                    check_company(node.profile, profiles.values())
                profiles.setdefault(node.profile.name, node.profile)
                if node.name in nodes:
                    raise table.error(f"two nodes have the name {node.name!r}; rename one")
                other = taken.setdefault((node.profile.name, node.address), node.name)
                if other != node.name:
                    raise table.error(f"node {other!r} already has address {node.address}; use another one", "address")
                nodes[node.name] = node
    return nodes


def _several(table: Table, defaults: Mapping[str, Table], learned: bool) -> Iterator[NodeSection]:
    """Yield the nodes of one table: several if its name is a range.

    `learned`: whether the reply times of the line are learned.
    """
    kind = find(table.choice("protocol", kinds()))
    check_keys(table, kind, names_of(keys_of(NodeSection)), lambda kind: kind.options)
    with table.at():
        names = list(expanded(table.name))
    profile = kind.profile
    addresses = _addresses(table, profile)
    if len(names) != len(addresses):
        raise table.error(f"{len(names)} names need {len(names)} addresses, not {len(addresses)}", "address")
    default = defaults.get(kind.name, Table(table.source, ("protocols", kind.name), {}))
    base = read_timings(default, profile.timings)
    document = read_timings(table, base)
    is_learned = reads_learned(table, reads_learned(default, learned and profile.checked_requests))
    if is_learned:
        with (table if "timing" in table else default).at("timing"):
            profile.check_learnable()
    values = {**read_keys(default, keys_of(ProtocolSection)), **read_keys(table, keys_of(NodeSection))}
    if len(values.get("sync_reads", ())) == 1:
        raise table.error("needs at least two items, because the replies to one sync read are all alike", "sync_reads")
    options = {**read_options(default, kind.options), **read_options(table, kind.options)}
    points = read_points(table, kind)
    for name, address in zip(names, addresses, strict=True):
        if not NODE_NAME.fullmatch(name):
            raise table.error(f"a node's name can contain letters, digits, _, . and -, not {name!r}")
        yield NodeSection(
            **values,
            name=name,
            address=address,
            timings=Learned(document) if is_learned else None if document == profile.timings else document,
            options=options,
            points=points,
            table=table,
        )


def _addresses(table: Table, profile: Profile) -> Sequence[int]:
    """Read `address = 5`, or `address = "4-8"`."""
    if not profile.addressed:
        if "address" in table:
            raise table.error(f"{profile.name} has no addresses (one drive per line); leave it out", "address")
        return profile.addresses
    if not isinstance(table.data.get("address"), str):
        addresses = [table.whole("address")]
    else:
        text = table.text("address")
        with table.at("address"):
            addresses = [int(part) if is_decimal(part) else _no_address(text) for part in expanded(text.strip())]
    with table.at("address"):
        for address in addresses:
            profile.check_address(address)
            if address == profile.broadcast:
                raise InvalidCommand(
                    f"{address} is the broadcast address of {profile.name}; use the node's own address"
                )
    return addresses


def _no_address(text: str) -> int:
    raise InvalidCommand(f'an address is a number, or a range such as "4-8", not {text!r}')


# groups


def _groups(top: Table) -> dict[str, GroupSection]:
    """Read `[groups]`, and return the poll groups by name."""
    groups: dict[str, GroupSection] = {}
    for table in top.tables("groups"):
        with table.part():
            groups[table.name] = _group(table)
    return groups


def _group(table: Table) -> GroupSection:
    group = GroupSection(**read_section(table, GroupSection), name=table.name, table=table)
    with table.at("phase"):
        Poll(table.name, group.period, phase=group.phase)
    if not group.points:
        raise table.error("a group without points polls nothing; add points, or remove the group", "points")
    return group


def decimals_of(node: NodeSection) -> dict[str, int]:
    """Return the decimals of each quantity whose points have them, for a handle that scales or rounds by them.

    The text after a colon only selects the form on the line, so it is ignored.
    """
    decimals: dict[str, int] = {}
    for point in node.points.values():
        parameter = point.item.partition(":")[0]
        if decimals.setdefault(parameter, point.decimals) != point.decimals:
            raise point.table.error(
                f"{parameter} has {decimals[parameter]} decimals at another point; use the same number"
            )
    return {parameter: digits for parameter, digits in decimals.items() if digits}
