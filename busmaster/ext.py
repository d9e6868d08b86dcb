"""The extension interface: for programs that own a line for others, as the `busmaster` program does.

An application that embeds a bus needs nothing of it. It is versioned like the public names: docs/public-api.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar, Unpack

from busmaster.arbiter.clients import LEAST_SHARE, MOST_SHARE, Hold, LineClient
from busmaster.arbiter.counters import Mark, RecentUtilisation
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.learned import LearnedTimes, window_of
from busmaster.arbiter.on_wire import Echo
from busmaster.arbiter.tap import Attempt, Tap, Verdict
from busmaster.arbiter.transaction import BACKGROUND, COMMAND, POLL, URGENT, Poll, Transaction
from busmaster.arbiter.unexpected import QUIET
from busmaster.bus.bus import Bus
from busmaster.bus.exclusive import HeldNode, checked_hold
from busmaster.bus.handle import Handle, Send
from busmaster.bus.limits import Limit
from busmaster.bus.meaning import MOST_DIGITS, OF_QUANTITIES, PLAIN, MeansNothing, Named
from busmaster.bus.node import Node, Request
from busmaster.bus.points import Point
from busmaster.bus.reads_after_writes import ReadsAfterWrites
from busmaster.bus.requester import (
    ORDINARY,
    CommandOptions,
    NodeSource,
    Requester,
    RequestOptions,
    WriteOptions,
    checked_priority,
)
from busmaster.bus.samples import Sample
from busmaster.bus.shared_line import SharedLine
from busmaster.bus.snapshots import Cycles, Outdated, ReadAfterWrite
from busmaster.bus.suitability import check_company, check_settings
from busmaster.contract.arguments import (
    LONGEST_NUMBER,
    Between,
    guess,
    host_and_port,
    is_decimal,
    meant,
    seconds,
    whole_number,
)
from busmaster.contract.driver import Driver
from busmaster.contract.exchange import Command, Exchange, FrameError
from busmaster.contract.items import Bit, Item
from busmaster.contract.learning import Learned, documented
from busmaster.contract.places import Changing, Placed, Telling
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.files import FOLDER_MODE, MODE, check_regular, open_file, read_file
from busmaster.planning import Plan, PlannedGroup
from busmaster.planning.merging import Merge
from busmaster.renames import TIMES, now_called
from busmaster.transport import identity
from busmaster.transport.clock import clock_of
from busmaster.transport.endpoints import is_paced, is_served
from busmaster.transport.holders import PROC, holders, how_to_open, owning_group, serves
from busmaster.transport.identity import USB, resolve
from busmaster.transport.kernel import OpenPort, open_port
from busmaster.transport.pump import Waiter

__all__ = [
    "BACKGROUND",
    "COMMAND",
    "FOLDER_MODE",
    "LEAST_SHARE",
    "LONGEST_NUMBER",
    "MODE",
    "MOST_DIGITS",
    "MOST_SHARE",
    "OF_QUANTITIES",
    "ORDINARY",
    "PLAIN",
    "POLL",
    "PROC",
    "QUIET",
    "TIMES",
    "URGENT",
    "USB",
    "Attempt",
    "Between",
    "Bit",
    "Changing",
    "Command",
    "CommandOptions",
    "Cycles",
    "Driver",
    "Echo",
    "Exchange",
    "FrameError",
    "Handle",
    "HeldNode",
    "Hold",
    "Item",
    "Learned",
    "LearnedTimes",
    "Limit",
    "LineClient",
    "Mark",
    "MeansNothing",
    "Merge",
    "Named",
    "NodeRecord",
    "NodeSource",
    "OpenPort",
    "Outdated",
    "Placed",
    "Poll",
    "Profile",
    "ReadAfterWrite",
    "ReadsAfterWrites",
    "RecentUtilisation",
    "Request",
    "RequestOptions",
    "Requester",
    "Send",
    "SharedLine",
    "Tap",
    "Telling",
    "Transaction",
    "Verdict",
    "Waiter",
    "WriteOptions",
    "accept_device",
    "add_tap",
    "begin_with",
    "check_company",
    "check_regular",
    "check_settings",
    "checked_hold",
    "checked_options",
    "checked_priority",
    "clock_of",
    "documented",
    "give_back",
    "give_up",
    "guess",
    "has_node",
    "hold",
    "holders",
    "host_and_port",
    "how_to_open",
    "identity",
    "is_decimal",
    "is_kept",
    "is_paced",
    "is_served",
    "last_value",
    "lend_node",
    "line_of",
    "lost_seconds",
    "meant",
    "names_of_items",
    "now_called",
    "open_file",
    "open_port",
    "owning_group",
    "plan_in_steps",
    "prepare_write",
    "read_file",
    "read_item",
    "reads_after_writes",
    "record_of",
    "remove_tap",
    "rename",
    "resolve",
    "run",
    "run_items",
    "seconds",
    "serves",
    "set_reply_time",
    "start",
    "take_only_safe_writes",
    "take_overheard",
    "times_to_keep",
    "whole_number",
    "window_of",
]

T = TypeVar("T")

# a line and who shares it


def line_of(bus: Bus) -> SharedLine:
    """Return what all nodes of a bus share: its clients, staleness, and who is told of stops and writes."""
    return bus._line


def add_tap(bus: Bus, tap: Tap) -> None:
    """Have a tap see every byte from now on."""
    bus._taps.add(tap)


def remove_tap(bus: Bus, tap: Tap) -> None:
    """Have a tap see no more."""
    bus._taps.remove(tap)


def accept_device(bus: Bus) -> None:
    """Let the next opening take whatever device has the port's name then, as if the program were started again.

    Without it, only the device that the line was opened on is opened again. A port that is named by a serial number
    (usb:SERIAL) never takes another one. A connection that is up stays as it is.
    """
    bus._accept_device()


def take_only_safe_writes(bus: Bus) -> Callable[[], None]:
    """End every write that waits as Superseded, and accept only writes with `safe=True` from now on.

    A write that is on the wire runs out, and is not repeated. Reads and polls go on. The function that is returned,
    called once, accepts writes again: not on a line that is about to be left.
    """
    return bus._take_only_safe_writes()


def lost_seconds(bus: Bus) -> float:
    """Return for how long the line was lost since the bus was opened, in all."""
    return bus._lost_seconds


def reads_after_writes(bus: Bus) -> ReadsAfterWrites:
    """Return the counts of the reads of points with `read_after_write`."""
    return bus._reads_after_writes


async def plan_in_steps(bus: Bus, *more: PlannedGroup, could_merge: Sequence[Merge] = ()) -> Plan:
    """Do what `Bus.plan` does, in steps of less than a millisecond between which exchanges go on."""
    return await bus._plan_in_steps(*more, could_merge=could_merge)


def take_overheard(bus: Bus, samples: Mapping[Point[Any], Sample[Any]]) -> None:
    """Take values from another master's exchanges for the alarms that they begin and end."""
    bus._overheard(samples)


# nodes


def lend_node(
    bus: Bus,
    profile: Profile,
    address: int,
    *,
    timings: Timings | Learned | None = None,
    retries: int | None = None,
    budgeted: bool = False,
) -> Node:
    """Return a node as `Bus.node` does, for a client who gives it back.

    A node that was only ever lent leaves the bus when all who borrowed it have given it back. `budgeted`: if the node
    is new, requests to it are within the budget of probes only (R11) until its first reply, as for a node that is down.
    """
    return bus._lend_node(profile, address, timings=timings, retries=retries, budgeted=budgeted)


def give_back(bus: Bus, node: Node) -> None:
    """Take back a node that was lent: whoever gives it back polls and requests nothing more of it."""
    bus._give_back(node)


def has_node(bus: Bus, profile: Profile, address: int) -> bool:
    """Return whether the node at this address is on the line."""
    return bus._has_node(profile, address)


def is_kept(node: Node) -> bool:
    """Return whether the program that owns the line has named a node itself, or has only lent it."""
    return node._kept


def record_of(node: Node) -> NodeRecord:
    """Return what the arbiter knows of a node."""
    return node._record


def rename(node: Node, label: str) -> None:
    """Have messages call a node by another name from now on."""
    node._rename(label)


def set_reply_time(node: Node, reply_time: float) -> None:
    """Set the seconds from a request to its reply by which plans are calculated until poll groups have measured it."""
    node._reply_time = reply_time


def times_to_keep(node: Node) -> tuple[LearnedTimes, ...]:
    """Return the reply times that were learned and are trusted, for `begin_with` in the next run."""
    return node._times_to_keep()


def begin_with(node: Node, known: Iterable[LearnedTimes]) -> None:
    """Begin with the reply times that an earlier run has learned, before anything is requested of the node.

    They are trusted after twenty replies; where nothing is to be learned they are ignored.
    """
    node._begin_with(known)


def last_value(point: Point[Any]) -> Any:
    """Return what a point would have read last, by whatever name it was polled, alone or with others.

    None if that is not known, or may have been written since.
    """
    return Node.of(point)._held(point)


# requests


def checked_options(node: Node, given: CommandOptions) -> RequestOptions:
    """Return the options of a request. Raises InvalidCommand, naming the node, for what is no such option."""
    return node._options(given)


def start(node: Node, request: Request[Any], waiter: Waiter | None = None) -> Transaction:
    """Start a request that writes nothing; `waiter` gets its value or its error, perhaps before this returns.

    `run` starts writes: they pass the limits of the node first. Raises what `Node.request` raises before anything is
    sent, and HoldEnded if the sequence that the request is part of is over.
    """
    return node._start(request, waiter)


def give_up(node: Node, transaction: Transaction) -> None:
    """Cancel a request for which nobody waits any more. A write that is on the wire ends before the next read."""
    node._give_up(transaction)


async def run(node: Node, request: Request[T]) -> T:
    """Do what `Node.request` does. `Request.sent` says, also once this was cancelled, whether anything was sent."""
    return await node._run(request)


def hold(node: Node, max_hold: float, client: LineClient | None = None) -> Hold:
    """Return what the requests of one sequence, of a client of the line, name as their client.

    `SharedLine.release` ends it. Raises InvalidCommand unless `max_hold` is above 0 s, and 5 s at most.
    """
    return node._hold(max_hold, client)


# handles


async def read_item(handle: Handle, item: str, **options: Any) -> Any:
    """Do as `handle.point(item).read()` does, by the exchanges that suit the node best."""
    return await handle._read_item(item, **options)


def prepare_write(handle: Handle, item: str, values: Sequence[Any], **options: Unpack[WriteOptions]) -> list[Send]:
    """Return what writes values to an item and those after it, once it is sure that all of them can be sent.

    Raises InvalidCommand.
    """
    return handle._prepare_write(item, values, **options)


def run_items(handle: Handle, item: str, count: int) -> tuple[str, ...]:
    """Return the names of `count` items from an item on: 1.17, 1.18, ... Raises InvalidCommand."""
    return handle._run_items(item, count)


def names_of_items(handle: type[Handle]) -> Mapping[str, str]:
    """Return the names of those items that have one, by what a listener reads from the line."""
    return handle._names_of_items()
