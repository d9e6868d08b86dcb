"""What a file says, typed and checked; nothing is opened. `config.line` makes a line of it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

from busmaster import Priority, SerialPort, TcpPort, Timings
from busmaster.app.config.emulator import EmulatorSection, read_emulator
from busmaster.app.config.keys import REQUIRED, Key, names_of
from busmaster.app.config.names import NODE_NAME, expanded
from busmaster.app.config.options import check_keys, read_options
from busmaster.app.config.point_section import PointSection
from busmaster.app.config.ports import read_port
from busmaster.app.config.recording import Outputs, read_outputs
from busmaster.app.config.safe import SafeSection, read_safe
from busmaster.app.config.service import ServiceSection, read_service
from busmaster.app.config.source import Source
from busmaster.app.config.table import Table
from busmaster.app.config.templates import read_points
from busmaster.app.config.timing import LEARNED_WORD, read_timings, reads_learned
from busmaster.app.outputs.base import check_folder
from busmaster.bounds import LONGEST_PERIOD, LONGEST_TIMING, LONGEST_TITLE, MOST_RETRIES, SHORTEST_PERIOD
from busmaster.errors import InvalidCommand
from busmaster.ext import Learned, Poll, Profile, check_company, is_decimal
from busmaster.registry import NodeKind, find, kinds

T = TypeVar("T")

NO_PORT = TcpPort("127.0.0.1", 1)
"""Stands for a port that cannot be read, where all problems of a file are collected. It is never opened."""
PRIORITIES = {"poll": Priority.POLL, "background": Priority.BACKGROUND}
KEYS = (
    Key("title", "text", "What the line is called: in lists, views and pages. The file's name by default."),
    Key(
        "port",
        "port",
        "The PORT, as on the command line: a device path, `usb:SERIAL`, `socket://HOST:PORT` or `rfc2217://HOST:PORT`; "
        "or a table: `[port]`.",
        REQUIRED,
    ),
    Key(
        "strict",
        "flag",
        "Whether an answer that could be another request's is held until it is certain (R15).",
        "false",
    ),
    Key(
        "timing",
        "text",
        "The windows of all nodes are learned from their replies, except where a read request carries no checksum.",
        choices=(LEARNED_WORD,),
    ),
    Key("learned", "text", "The file in which learned windows are kept from one run to the next."),
    Key("protocols", "table", "A table for each protocol, of what holds for its nodes: `[protocols.NAME]`."),
    Key("nodes", "table", "A table for each node: `[nodes.NAME]`.", REQUIRED),
    Key("groups", "table", "A table for each poll group: `[groups.NAME]`."),
    Key("outputs", "table", "A table for each output: `[outputs.csv]` and others."),
    Key("safe", "table", "What the line is left at: `[safe]`."),
    Key("service", "table", "Who may use the line beside its owner: `[service]`."),
    Key("emulator", "table", "What `busmaster emulate` makes of the nodes: `[emulator]`."),
)
"""Of the top of a file."""
SHARED_KEYS = (
    Key("timing", "timing", 'Its reply times: a table, or `"learned"`. The protocol\'s by default.'),
    Key(
        "retries",
        "whole",
        "How often a read that failed is tried again.",
        least=0,
        most=MOST_RETRIES,
    ),
    Key(
        "reply_time",
        "seconds",
        "From a request to its reply, where it is known, for `plan`.",
        unit="s",
        least=0,
        most=LONGEST_TIMING,
    ),
    Key("probe", "text", "The item that is read to find out whether a node replies. The protocol's by default."),
    Key(
        "sync_reads",
        "texts",
        "Items that are read where the line must prove that replies match requests: cheap ones that the device has, "
        "at least two. The protocol's by default.",
    ),
)
"""Of nodes, and of all nodes of one protocol."""
NODE_KEYS = (
    Key("protocol", "text", "What it speaks.", REQUIRED),
    Key("address", "address", 'Its address; `"4-7"` where NAME is a range too. Left out where the protocol has none.'),
    *SHARED_KEYS,
    Key("template", "text", "The template of its points: one that is shipped, or a file, from the folder of this one."),
    Key("points", "table", "A table for each point that has a name, a unit, or limits: `[nodes.NAME.points]`."),
)
"""What every node's table may say; its kind's options come to it."""
GROUP_KEYS = (
    Key("period", "seconds", "From one cycle to the next.", REQUIRED, "s", least=SHORTEST_PERIOD, most=LONGEST_PERIOD),
    Key("points", "texts", 'What is read: `"drive4-7/speed_measured,current"` is eight points.', REQUIRED),
    Key(
        "phase",
        "seconds",
        "When in its period, and before its end, it begins. By itself it keeps out of the others' way.",
        unit="s",
        least=0,
        most=LONGEST_PERIOD,
    ),
    Key("priority", "text", "`background`: only in what time the others leave.", '"poll"', choices=tuple(PRIORITIES)),
)
"""Of each poll group."""


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
    probe: str | None
    sync_reads: tuple[str, ...]
    options: Mapping[str, Any]
    points: Mapping[str, PointSection]
    table: Table = field(compare=False, repr=False)

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
class LineFile:
    """All that one file says. `learned` is where learned reply times are kept, if they are.

    `table` is the whole of it, for messages.
    """

    path: str
    title: str
    port: SerialPort | TcpPort
    strict: bool
    learned: str | None
    nodes: Mapping[str, NodeSection]
    groups: Mapping[str, GroupSection]
    outputs: Outputs
    safe: SafeSection
    service: ServiceSection
    emulator: EmulatorSection
    table: Table = field(compare=False, repr=False)


def load(path: str | os.PathLike[str]) -> LineFile:
    """Read a file. Raises OSError if it cannot be read; FileError, naming line and key, for what is wrong in it."""
    return read(Source.read(path))


def read(source: Source) -> LineFile:
    """Read what a source says of a line. Raises FileError, naming line and key, for what is wrong in it."""
    top = Table(source)
    top.only(*names_of(KEYS))
    no_nodes: dict[str, NodeSection] = {}
    nodes = _value(top, _nodes, no_nodes)
    no_port: SerialPort | TcpPort = NO_PORT
    profiles = _profiles(top)
    may_read_port = profiles or not source.unread  # without a protocol it would miss a baud rate
    file = LineFile(
        path=source.name,
        title=_value(top, _title, ""),
        strict=_value(top, lambda top: top.flag("strict", False), False),
        learned=_value(top, partial(_learned, nodes=nodes.values()), None),
        port=_value(top, partial(read_port, profiles=profiles), no_port) if may_read_port else no_port,
        nodes=nodes,
        groups=_value(top, _groups, {}),
        outputs=top.read("outputs", partial(read_outputs, groups=top.table("groups").data)),
        safe=top.read("safe", read_safe),
        service=top.read("service", read_service),
        emulator=top.read("emulator", partial(read_emulator, nodes={node.name: node.kind for node in nodes.values()})),
        table=top,
    )
    if not top.table("nodes").data:
        source.keep((), top.error("there are no nodes: describe each in a table of its own, [nodes.NAME]"))
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


def _title(top: Table) -> str:
    title = top.text("title", os.path.basename(top.source.name))
    if len(title) > LONGEST_TITLE:
        raise top.error(f"a title has {LONGEST_TITLE} characters at most, not {len(title)}", "title")
    return title


def _learned(top: Table, nodes: Iterable[NodeSection]) -> str | None:
    """Read where learned reply times are kept from one run to the next."""
    path = top.text("learned", None)
    if path is not None:
        learns = any(isinstance(node.timings, Learned) for node in nodes)
        if not learns and not top.source.unread:  # a node that could not be read may be one that learns
            raise top.error(f'no reply times are learned: say timing = "{LEARNED_WORD}" too', "learned")
        with top.at("learned"):
            check_folder(path)
    return path


# nodes


def _defaults(top: Table) -> dict[str, Table]:
    """Read `[protocols.hcp2]`: what holds for all nodes of one protocol that do not say otherwise."""
    top.table("protocols").only(*kinds())
    tables = {table.name: table for table in top.tables("protocols") if table.name in kinds()}
    for protocol, table in tables.items():
        common = (option.name for option in find(protocol).options if option.common)
        table.only(*names_of(SHARED_KEYS), *common)
    return tables


def _nodes(top: Table) -> dict[str, NodeSection]:
    """Read `[nodes]`, and return the nodes by name."""
    no_defaults: dict[str, Table] = {}
    defaults = _value(top, _defaults, no_defaults)
    learned = _value(top, lambda top: top.choice("timing", (LEARNED_WORD,), None) is not None, False)
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
                    raise table.error(f"there are two nodes {node.name!r}")
                other = taken.setdefault((node.profile.name, node.address), node.name)
                if other != node.name:
                    raise table.error(f"node {other!r} has address {node.address} already", "address")
                nodes[node.name] = node
    return nodes


def _several(table: Table, defaults: Mapping[str, Table], learned: bool) -> Iterator[NodeSection]:
    """Yield the nodes of one table: several where its name is a range.

    `learned` says whether the reply times of the line are learned.
    """
    protocol = table.choice("protocol", kinds())
    own = find(protocol).options
    check_keys(table, find(protocol), names_of(NODE_KEYS), lambda kind: kind.options)
    with table.at():
        names = list(expanded(table.name))
    profile = find(protocol).profile
    addresses = _addresses(table, profile)
    if len(names) != len(addresses):
        raise table.error(f"{len(names)} names need as many addresses, not {len(addresses)}", "address")
    default = defaults.get(protocol, Table(table.source, ("protocols", protocol), {}))
    base = read_timings(default, profile.timings)
    document = read_timings(table, base)
    is_learned = reads_learned(table, reads_learned(default, learned and profile.checked_requests))
    if is_learned:
        with (table if "timing" in table else default).at("timing"):
            profile.check_learnable()
    timings = Learned(document) if is_learned else None if document == profile.timings else document
    retries = table.whole("retries", default.whole("retries", None, most=MOST_RETRIES), most=MOST_RETRIES)
    reply_time = table.seconds(
        "reply_time", default.seconds("reply_time", None, most=LONGEST_TIMING), most=LONGEST_TIMING
    )
    probe = table.text("probe", default.text("probe", None))
    sync_reads = (table if "sync_reads" in table else default).texts("sync_reads", ())
    if len(sync_reads) == 1:
        raise table.error("one sync read cannot be told from itself: name at least two items", "sync_reads")
    options = {**read_options(default, own), **read_options(table, own)}
    points = read_points(table, find(protocol))
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
            probe=probe,
            sync_reads=sync_reads,
            options=options,
            points=points,
            table=table,
        )


def _addresses(table: Table, profile: Profile) -> Sequence[int]:
    """Read `address = 5`, or `address = "4-8"`."""
    if not profile.addressed:
        if "address" in table:
            raise table.error(f"{profile.name} has no addresses: one drive a line", "address")
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
                raise InvalidCommand(f"{address} means all nodes of {profile.name}: it is no node's own")
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
    table.only(*names_of(GROUP_KEYS))
    period = table.seconds("period", most=LONGEST_PERIOD)
    phase = table.seconds("phase", None, most=LONGEST_PERIOD)
    with table.at("period"):
        Poll(table.name, period)  # made for its complaints alone, which have the line here
    with table.at("phase"):
        Poll(table.name, period, phase=phase)
    group = GroupSection(
        name=table.name,
        period=period,
        phase=phase,
        priority=PRIORITIES[table.choice("priority", PRIORITIES, "poll")],
        points=table.texts("points"),
        table=table,
    )
    if not group.points:
        raise table.error("a group without points polls nothing: name some, or leave the group out", "points")
    return group


def decimals_of(node: NodeSection) -> dict[str, int]:
    """Return the digits of each quantity whose points have decimals, for a handle that scales or rounds by them.

    What is behind a colon only says how it is sent.
    """
    decimals: dict[str, int] = {}
    for point in node.points.values():
        parameter = point.item.partition(":")[0]
        if decimals.setdefault(parameter, point.decimals) != point.decimals:
            raise point.table.error(f"{parameter} has {decimals[parameter]} decimals elsewhere")
    return {parameter: digits for parameter, digits in decimals.items() if digits}
