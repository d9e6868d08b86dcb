"""The extension interface: for programs that own a line for other programs, as the `busmaster` program does.

An application that embeds a bus does not need it. It is versioned like the public names: docs/public-api.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar, Unpack

from busmaster.arbiter.clients import LEAST_SHARE, MOST_SHARE, Hold, LineClient
from busmaster.arbiter.counters import DriverErrors, LineStatistics, Mark, NodeStatistics, Quantiles, RecentUtilisation
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.learned import LearnedTimes, window_of
from busmaster.arbiter.on_wire import Echo
from busmaster.arbiter.transaction import BACKGROUND, COMMAND, POLL, URGENT, Poll, Timeline, Transaction
from busmaster.arbiter.unexpected import QUIET
from busmaster.bus.bus import Bus
from busmaster.bus.bus_like import find_group
from busmaster.bus.exclusive import HeldNode, checked_hold
from busmaster.bus.handle import Action, Handle, Send
from busmaster.bus.limits import Limit
from busmaster.bus.meaning import MOST_DIGITS, OF_QUANTITIES, PLAIN, MeansNothing, Named
from busmaster.bus.node import Node, Request
from busmaster.bus.parameters import (
    Change,
    Entry,
    Found,
    Left,
    Outcome,
    Parameter,
    ParameterLoad,
    ParameterSet,
    Result,
    Value,
    empty_set,
    walk,
)
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
    Parsed,
    guess,
    host_and_port,
    is_decimal,
    meant,
    seconds,
    whole_number,
)
from busmaster.contract.bounds import (
    LONGEST_FILE,
    LONGEST_HOLD,
    LONGEST_PERIOD,
    LONGEST_SUSPENSION,
    MOST_MEMBERS,
    MOST_RETRIES,
    SHORTEST_PERIOD,
)
from busmaster.contract.driver import Driver
from busmaster.contract.exchange import Command, Exchange, FrameError
from busmaster.contract.items import Bit, Item
from busmaster.contract.learning import Learned, documented
from busmaster.contract.places import Changing, Placed, ReadsPlaces
from busmaster.contract.profile import Profile
from busmaster.contract.renames import TIMES, now_called
from busmaster.contract.tap import Attempt, Tap, Verdict
from busmaster.contract.timing import Timings
from busmaster.planning import Bounds, GroupPlan, Losses, MergedReads, Plan, PlannedGroup, PlannedNode, longest_hold
from busmaster.planning.merging import Merge
from busmaster.registry import NodeKind, Option, Protocol, find, kinds, make_device, protocols
from busmaster.transport import identity
from busmaster.transport.clock import clock_of
from busmaster.transport.endpoints import is_paced, is_served
from busmaster.transport.files import FOLDER_MODE, MODE, check_regular, open_file, read_file
from busmaster.transport.holders import PROC, holders, how_to_open, owning_group, serves
from busmaster.transport.identity import USB, resolve
from busmaster.transport.kernel import OpenPort, cause_text, open_port
from busmaster.transport.pump import Waiter

__all__ = [
    "BACKGROUND",
    "COMMAND",
    "FOLDER_MODE",
    "LEAST_SHARE",
    "LONGEST_FILE",
    "LONGEST_HOLD",
    "LONGEST_NUMBER",
    "LONGEST_PERIOD",
    "LONGEST_SUSPENSION",
    "MODE",
    "MOST_DIGITS",
    "MOST_MEMBERS",
    "MOST_RETRIES",
    "MOST_SHARE",
    "OF_QUANTITIES",
    "ORDINARY",
    "PLAIN",
    "POLL",
    "PROC",
    "QUIET",
    "SHORTEST_PERIOD",
    "TIMES",
    "URGENT",
    "USB",
    "Action",
    "Attempt",
    "Between",
    "Bit",
    "Bounds",
    "Change",
    "Changing",
    "Command",
    "CommandOptions",
    "Cycles",
    "Driver",
    "DriverErrors",
    "Echo",
    "Entry",
    "Exchange",
    "Found",
    "FrameError",
    "GroupPlan",
    "Handle",
    "HeldNode",
    "Hold",
    "Item",
    "Learned",
    "LearnedTimes",
    "Left",
    "Limit",
    "LineClient",
    "LineStatistics",
    "Losses",
    "Mark",
    "MeansNothing",
    "Merge",
    "MergedReads",
    "Named",
    "NodeKind",
    "NodeRecord",
    "NodeSource",
    "NodeStatistics",
    "OpenPort",
    "Option",
    "Outcome",
    "Outdated",
    "Parameter",
    "ParameterLoad",
    "ParameterSet",
    "Parsed",
    "Placed",
    "Plan",
    "PlannedGroup",
    "PlannedNode",
    "Poll",
    "Profile",
    "Protocol",
    "Quantiles",
    "ReadAfterWrite",
    "ReadsAfterWrites",
    "ReadsPlaces",
    "RecentUtilisation",
    "Request",
    "RequestOptions",
    "Requester",
    "Result",
    "Send",
    "SharedLine",
    "Tap",
    "Timeline",
    "Transaction",
    "Value",
    "Verdict",
    "Waiter",
    "WriteOptions",
    "accept_device",
    "actions",
    "add_tap",
    "begin_with",
    "cause_text",
    "check_company",
    "check_regular",
    "check_settings",
    "checked_hold",
    "checked_options",
    "checked_priority",
    "clock_of",
    "counted_items",
    "documented",
    "empty_set",
    "find",
    "find_group",
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
    "kinds",
    "last_value",
    "lend_node",
    "line_of",
    "line_statistics",
    "listed_parameters",
    "longest_hold",
    "lost_seconds",
    "make_device",
    "meant",
    "names_of_items",
    "now_called",
    "open_file",
    "open_port",
    "owning_group",
    "plain_handle",
    "plan_at_once",
    "plan_with_pauses",
    "prepare_write",
    "protocols",
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
    "walk",
    "whole_number",
    "window_of",
]

T = TypeVar("T")

# a line and its clients


def line_of(bus: Bus) -> SharedLine:
    """Return the shared state of a bus: its clients, staleness, and callbacks for stops and writes."""
    return bus._line


def add_tap(bus: Bus, tap: Tap) -> None:
    """Pass all traffic to a tap from now on."""
    bus._taps.add(tap)


def remove_tap(bus: Bus, tap: Tap) -> None:
    """Pass no more traffic to a tap."""
    bus._taps.remove(tap)


def accept_device(bus: Bus) -> None:
    """Accept any device that has the port's name at the next opening, as after a restart of the program.

    By default only the device that the line was opened on is reopened. A port given by a serial number (usb:SERIAL)
    never accepts another one. An open connection is not affected.
    """
    bus._accept_device()


def take_only_safe_writes(bus: Bus) -> Callable[[], None]:
    """Fail every queued write with Superseded, and accept only writes with `safe=True` from now on.

    A write on the wire is finished, and is not repeated. Reads and polls continue. Call the returned function once to
    accept all writes again; it is not needed on a line that will be closed.
    """
    return bus._take_only_safe_writes()


def lost_seconds(bus: Bus) -> float:
    """Return the total time, in seconds, for which the line was lost since the bus was opened."""
    return bus._lost_seconds


def reads_after_writes(bus: Bus) -> ReadsAfterWrites:
    """Return the counters of the reads of points with `read_after_write`."""
    return bus._reads_after_writes


def line_statistics(bus: Bus) -> LineStatistics:
    """Return what `Bus.statistics` does, where nothing can be awaited."""
    return bus._statistics()


def plan_at_once(bus: Bus, *more: PlannedGroup, could_merge: Sequence[Merge] = ()) -> Plan:
    """Do what `Bus.plan` does, where nothing can be awaited: with hundreds of points, for tens of milliseconds."""
    return bus._plan_at_once(more, could_merge)


async def plan_with_pauses(bus: Bus, *more: PlannedGroup, pause: float) -> Plan:
    """Do what `Bus.plan` does for a client, with a pause, in seconds, after each millisecond of calculation."""
    return await bus._plan_in_steps(more, pause=pause)


def take_overheard(bus: Bus, samples: Mapping[Point[Any], Sample[Any]]) -> None:
    """Evaluate alarms for values received by listening to another master."""
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
    """Return a node as `Bus.node` does, for a borrower that will give it back.

    A node that was only lent is removed when all borrowers have given it back. `budgeted`: requests to a new node use
    only the probe budget (R11) until its first reply, as for a node that is DOWN.
    """
    return bus._lend_node(profile, address, timings=timings, retries=retries, budgeted=budgeted)


def give_back(bus: Bus, node: Node) -> None:
    """Return a lent node. The borrower no longer polls it or sends requests to it."""
    bus._give_back(node)


def has_node(bus: Bus, profile: Profile, address: int) -> bool:
    """Return True if the node at this address is on the line."""
    return bus._has_node(profile, address)


def is_kept(node: Node) -> bool:
    """Return True if the program that owns the line has named the node itself, False if it was only lent."""
    return node._kept


def record_of(node: Node) -> NodeRecord:
    """Return the arbiter's record of a node."""
    return node._record


def rename(node: Node, label: str) -> None:
    """Set a node's name in messages."""
    node._rename(label)


def set_reply_time(node: Node, reply_time: float) -> None:
    """Set a node's reply time, in seconds, for plans until poll groups have measured it."""
    node._reply_time = reply_time


def times_to_keep(node: Node) -> tuple[LearnedTimes, ...]:
    """Return the trusted learned reply times, for `begin_with` in the next run."""
    return node._times_to_keep()


def begin_with(node: Node, known: Iterable[LearnedTimes]) -> None:
    """Start with the reply times learned in an earlier run, before the first request to the node.

    They are trusted after twenty replies. Ignored if learning is disabled.
    """
    node._begin_with(known)


def last_value(point: Point[Any]) -> Any:
    """Return the value that a point would have read last, whichever point or batch read it.

    None if it is not known, or may have been written since.
    """
    return Node.of(point)._held(point)


# requests


def checked_options(node: Node, given: CommandOptions) -> RequestOptions:
    """Return the options of a request. Raises InvalidCommand with the node's name for invalid options."""
    return node._options(given)


def start(node: Node, request: Request[Any], waiter: Waiter | None = None) -> Transaction:
    """Start a request that writes nothing. `waiter` gets its value or its error, possibly before this returns.

    Use `run` for writes, which checks the node's limits first. Raises what `Node.request` raises before anything is
    sent, and HoldEnded if the request's sequence has ended.
    """
    return node._start(request, waiter)


def give_up(node: Node, transaction: Transaction) -> None:
    """Cancel a request whose caller no longer waits. A write on the wire ends before the next read."""
    node._give_up(transaction)


async def run(node: Node, request: Request[T]) -> T:
    """Run a request as `Node.request` does. `Request.sent` shows, also after a cancellation, whether anything was
    sent."""
    return await node._run(request)


def hold(node: Node, max_hold: float, client: LineClient | None = None) -> Hold:
    """Return a hold that the requests of one sequence of a client use as their client.

    End it with `SharedLine.release`. Raises InvalidCommand unless `max_hold` is above 0 s and at most 5 s.
    """
    return node._hold(max_hold, client)


# handles


async def read_item(handle: Handle, item: str, **options: Any) -> Any:
    """Read as `handle.point(item).read()` does, with the exchanges that suit the node best."""
    return await handle._read_item(item, **options)


def prepare_write(handle: Handle, item: str, values: Sequence[Any], **options: Unpack[WriteOptions]) -> list[Send]:
    """Return the writes of values to an item and those after it, after all of them were checked.

    Raises InvalidCommand.
    """
    return handle._prepare_write(item, values, **options)


def actions(handle: Handle | type[Handle]) -> Mapping[str, Action]:
    """Return what a node does beyond reads and writes, by name."""
    return handle._actions


def counted_items(handle: Handle, item: str) -> tuple[str, ...]:
    """Return the items of one with a count ("1.01:20", "3000:500"); another item stands for itself.

    Raises InvalidCommand.
    """
    return handle._counted(item)


def listed_parameters(handle: Handle) -> tuple[Parameter, ...]:
    """Return the parameters that the document of a handle's protocol lists, in its order; none if it lists none."""
    return tuple(handle._listed())


def plain_handle(handle: Handle) -> Handle:
    """Return a handle of the same node that reads and writes numbers without decimals of its own: parameter sets have
    these."""
    return handle._plain()


def run_items(handle: Handle, item: str, count: int) -> tuple[str, ...]:
    """Return the names of `count` items from an item on: 1.17, 1.18, ... Raises InvalidCommand."""
    return handle._run_items(item, count)


def names_of_items(handle: type[Handle]) -> Mapping[str, str]:
    """Return the names of items by the keys that a listener reads from the line."""
    return handle._names_of_items()
