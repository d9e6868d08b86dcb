"""The base class of all handles: a node, and points by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeAlias, TypeVar, Unpack, overload

from busmaster.bus.parameters import (
    Change,
    Difference,
    Entry,
    Found,
    Parameter,
    ParameterLoad,
    ParameterSet,
    Prepare,
    Value,
    differences,
    empty_set,
    prepared,
    walk,
)
from busmaster.bus.points import Point
from busmaster.bus.requester import NodeSource, Priority, ReadOptions, Requester, SeveralRequests, WriteOptions
from busmaster.contract.arguments import guess, is_decimal, whole_number
from busmaster.contract.bounds import MOST_MEMBERS
from busmaster.contract.exchange import Command
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import InvalidCommand, VerifyFailed

T = TypeVar("T")

MOST_ITEMS = 65536
"""Size of the largest address space of a protocol."""
Send: TypeAlias = Callable[[], Awaitable[None]]
"""Sends a prepared write."""


@dataclass(frozen=True, slots=True)
class Action:
    """One thing that a handle does beyond reads and writes, for the command line.

    `about`: a sentence for the help. `run`: carries it out; called with the handle and the numbers. `check`: called
    likewise, raises InvalidCommand for numbers that cannot be sent. `numbers`: names of the numbers that it takes; one
    that ends with "..." stands for any count. `time`: the argument of `run` that limits its time, in seconds, or empty.
    `needs_time`: the time has no default. `least`: the argument for the shortest time that it can take, or empty.
    """

    about: str
    run: Callable[..., Awaitable[Any]]
    check: Callable[..., object]
    numbers: tuple[str, ...] = ()
    time: str = ""
    needs_time: bool = False
    least: str = ""


class Handle(ABC):
    """An awaitable handle of one node: thin and typed, over `Requester.request`.

    Raises InvalidCommand for an address that the protocol does not have. All handles with the same protocol and address
    share the node, whatever their class (for example a controller and a drive with the same protocol). Timings, retries
    and protocol options that a handle leaves out are those of the first handle; different ones raise InvalidCommand.
    Another protocol at the same address is another node.
    """

    profile: ClassVar[Profile]
    _identity: ClassVar[tuple[str, ...]] = ()
    """Items that identify a node, such as its firmware."""
    _actions: ClassVar[Mapping[str, Action]] = {}
    """The actions of the node, by their names on the command line."""

    def __init__(
        self,
        bus: NodeSource,
        address: int,
        *,
        timings: Timings | Learned | None = None,
        retries: int | None = None,
        profile: Profile | None = None,
    ) -> None:
        self.bus = bus
        self.node = bus.node(profile or self.profile, address, timings=timings, retries=retries)

    @abstractmethod
    def point(self, item: str) -> Point[Any]:
        """Return the point for an ITEM of the command line. Raises InvalidCommand if it does not exist."""

    @overload
    async def read(self, item: Any, **options: Unpack[ReadOptions]) -> Any: ...

    @overload
    async def read(self, item: Any, count: int, **options: Unpack[ReadOptions]) -> Any: ...

    async def read(self, item: Any, count: int | None = None, **options: Unpack[ReadOptions]) -> Any:
        """Return the value of an item, or with `count` a tuple of the values of this item and those after it.

        Several items may need several exchanges, so their values may not be from the same moment. The options are those
        of `RequestOptions`; `start_within` applies to each exchange. Raises InvalidCommand, before anything is sent,
        for an item that does not exist.
        """
        if count is None:
            return await self.point(item).read(**options)
        points = [self.point(name) for name in self._run_items(item, checked_count(count))]
        read = await read_each(self.node, [point.command for point in points], options)
        return tuple(point.value_of(raw) for point, raw in zip(points, read, strict=True))

    async def write(self, item: Any, *values: Any, **options: Unpack[WriteOptions]) -> None:
        """Write a value to an item, or several values to this item and those after it.

        Several values may need several exchanges: if one fails, the values before it are stored. The options are those
        of `RequestOptions`; `verify` reads back after all are written. Raises InvalidCommand, before anything is sent,
        for a value that cannot be sent.
        """
        points = [self.point(name) for name in self._names(item, values)]
        commands = [encoder(point)(value) for point, value in zip(points, values, strict=True)]
        # All values before the first write: a list must not be stored in part because of its last value.
        self.node.check(*commands, stop=options.get("safe"))
        requests = SeveralRequests(self.node, options)
        for point, command in zip(points, commands, strict=True):
            # With the quantity: otherwise all samples of the node would be stale until their next poll.
            await requests.request(command, touches=point.command)
        for point, value in zip(points, values, strict=True) if requests.verify else ():
            if (found := point.value_of(await requests.read_back(point.command))) != value:
                raise VerifyFailed(f"{point.item} reads {found!r} after {value!r} was written", node=self.node)

    def use_sync_reads(self, *, probe: str | None = None, sync_reads: Sequence[str] = ()) -> None:
        """Set the probe and the sync reads of the node, by items, if the defaults do not suit this device.

        The probe is the read that is sent to a node that may be dead. Sync reads are sent if the line must prove that
        replies match requests: name several cheap items that the device has and whose replies begin differently.
        Omitted ones stay unchanged. The setting applies to all handles of the node. Raises InvalidCommand for an item
        that does not exist, and if another handle has set different ones. On the line of another program it has no
        effect.
        """
        self.node.use_sync_reads(
            None if probe is None else self.point(probe).command, [self.point(item).command for item in sync_reads]
        )

    @asynccontextmanager
    async def exclusive(self, *, max_hold: float = 0.5) -> AsyncIterator[Self]:
        """Return this handle for an exclusive sequence of requests, for `async with`. Only urgent requests go between
        them.

        The line is held from the first request until the block is left, for at most `max_hold` seconds (up to 5). An
        exchange that is then on the wire is finished. Later requests in the block raise HoldEnded and are not sent.
        Only requests of the handle returned for the block belong to the sequence; all other requests, of this program
        too, wait.
        """
        async with self.node.exclusive(max_hold=max_hold) as held:
            # A copy, so that requests of the original handle wait, as those of all other programs do.
            handle = copy(self)
            handle.node = held
            yield handle

    @classmethod
    @abstractmethod
    def items(cls) -> tuple[str, ...]:
        """Return the names (not the numbers) that `point` accepts."""

    @classmethod
    def _names_of_items(cls) -> Mapping[str, str]:
        """Return the names of items by the keys that a listener reads from the line."""
        return {}

    # parameter sets

    def parameters(self, items: Iterable[str] = ()) -> tuple[Parameter, ...]:
        """Return the parameters of the node, in the document's order; with `items`, these.

        An item with a count stands for so many from there on: "1.01:20", "holding:0:500". Raises InvalidCommand for a
        protocol that documents no list, where no items are given; and for more than 20 000 parameters.
        """
        items = tuple(items)
        if not items:
            listed = tuple(self._listed())
            if not listed:
                kind = self.profile.kind_name
                raise InvalidCommand(f"{kind}: this protocol documents no list of parameters: name the items")
            return listed
        # By command: the user may write an item in another form than the list does ("1.1" and "1.01").
        known = {self.point(one.item).command: one for one in self._listed()}
        found: dict[Command[Any], Parameter] = {}
        for name in (name for item in items for name in self._counted(item)):
            command = self.point(name).command
            found.setdefault(command, known.get(command) or Parameter(item=name))
            # Checked while they are counted: a few items with a count can stand for millions.
            if len(found) > MOST_MEMBERS:
                raise InvalidCommand(f"a parameter set has {MOST_MEMBERS} parameters at most")
        return tuple(found.values())

    async def save_parameters(
        self,
        parameters: Iterable[Parameter] | None = None,
        *,
        progress: Callable[[Found], object] = lambda found: None,
        by: str = "",
    ) -> ParameterSet:
        """Read parameters, by default all that the document lists, and return them as a set.

        Each is read in the background of other traffic. Parameters that the node does not have are left out; `progress`
        is called with the result of each. Values are numbers as a handle without decimals reads them. Raises
        InvalidCommand as `parameters` does, BusError if the node does not reply.
        """
        wanted = tuple(self.parameters() if parameters is None else parameters)
        found: dict[str, Entry] = {}
        empty = await empty_set(self, by)
        async for one in walk(self, wanted):
            progress(one)
            if one.value is not None:
                found[one.parameter.item] = Entry(one.parameter, one.value)
        # `walk` yields the values of merged reads first.
        in_order = {one.item: found[one.item] for one in wanted if one.item in found}
        return replace(empty, entries=in_order)

    async def prepare_load(
        self,
        wanted: ParameterSet,
        *,
        parameters: Iterable[Parameter] = (),
        prepare: Prepare | None = None,
        by: str = "",
    ) -> ParameterLoad:
        """Compare a set with the values of the node, and return the changes: `ParameterLoad.write` writes them.

            load = await drive.prepare_load(wanted)
            async for outcome in load.write(): ...
            await drive.prepare_load(load.undo)         # the overwritten values

        Call `in_operation` first. `parameters` adds to the description of the parameters in the document; `prepare`
        replaces how a write is checked and sent. Raises InvalidCommand for a set of another kind of node or an item
        that does not exist, BusError if the node does not reply.
        """
        plain = self._plain()

        def usual(change: Change, item: str) -> Send:
            # A load can have hundreds of writes, which must not delay polls and commands.
            [send] = plain._prepare_write(item, [change.value], priority=Priority.BACKGROUND)
            return send

        own = {one.item: one for one in (*self._listed(), *parameters)}
        return await prepared(plain, wanted, own, prepare or usual, by)

    @classmethod
    def differences(cls, one: ParameterSet, other: ParameterSet) -> tuple[Difference, ...]:
        """Return the parameters that are not the same in two sets of this kind of node.

        Raises InvalidCommand for a set of another kind.
        """
        return tuple(differences(cls, one, other))

    async def in_operation(self, **options: Unpack[ReadOptions]) -> str | None:
        """Return the sign that the node is enabled or runs, "" if it is not, None if its protocol has no such sign."""
        return None

    def _listed(self) -> Iterable[Parameter]:
        """Return the parameters that the protocol's document lists, in its order; nothing if it lists none."""
        return ()

    def _plain(self) -> Self:
        """Return this handle as it reads numbers without decimals of its own."""
        return self

    @classmethod
    def _same(cls, item: str, one: Value, other: Value) -> bool:
        """Return True if two values of an item are the same to the node."""
        return one == other

    def _written_item(self, item: str, before: Value, value: Value) -> str:
        """Return the item by which a value is written where another one was before."""
        return item

    def _counted(self, item: str) -> tuple[str, ...]:
        """Return the items of "1.01:20"; another item stands for itself."""
        first, _, count = item_text(item).rpartition(":")
        if not is_decimal(count) or not first:
            return (item,)
        try:
            self.point(first)
        except InvalidCommand:  # the number is not a count: flag:5
            return (item,)
        return self._run_items(first, whole_number(int(count), 1, MOST_MEMBERS, f"the count of {first}"))

    # ITEM and VALUE on the command line

    async def _read_item(self, item: str, **options: Any) -> Any:
        """Read an ITEM of the command line, in the way that suits a single read best."""
        return await self.point(item).read()

    def _prepare_write(self, item: str, values: Sequence[Any], **options: Unpack[WriteOptions]) -> list[Send]:
        """Return the writes of the values to ITEM and those after it, after all of them were checked.

        The options are those of `RequestOptions`. Raises InvalidCommand.
        """
        names = self._names(item, values)
        return [self._prepare_one(name, value, **options) for name, value in zip(names, values, strict=True)]

    def _names(self, item: str, values: Sequence[Any]) -> tuple[str, ...]:
        """Return the items that the values are written to. Raises InvalidCommand if there are no values."""
        if not values:
            raise InvalidCommand(f"{self.node.label}: there is no value to write to {item}")
        return self._run_items(item, len(values)) if len(values) > 1 else (item,)

    def _prepare_one(self, item: str, value: Any, **options: Unpack[WriteOptions]) -> Send:
        """Return the write of one value to ITEM. Raises InvalidCommand for a value that cannot be sent."""
        self.node.check(encoder(self.point(item))(value), stop=options.get("safe"))
        # Not `self.write`: it may accept fewer items than there are points (MSC: no flags).
        return lambda: Handle.write(self, item, value, **options)

    def _run_items(self, item: str, count: int) -> tuple[str, ...]:
        """Return the names of `count` items from ITEM on: 1.17, 1.18, ... Raises InvalidCommand."""
        first, colon, kind = item_text(item).partition(":")
        # A form, such as ":wide", applies to every item of the run; a number is a count.
        suffix = f":{kind}" if colon and not is_decimal(kind) else ""
        menu, dot, number = first.rpartition(".")
        if not is_decimal(number):
            raise InvalidCommand(f"several values begin at a number, not at {item!r}")
        return tuple(f"{menu}{dot}{int(number) + i:0{len(number)}d}{suffix}" for i in range(count))

    if not TYPE_CHECKING:  # a type checker would accept every name

        def __getattr__(self, name: str) -> Any:
            """Name the replacement of a method of 0.2."""
            if name in ("read_run", "read_block"):
                raise AttributeError(f"{type(self).__name__}.{name} is now read: read(item, count)")
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.node.label}>"


def checked_count(count: int) -> int:
    """Return a number of items. Raises InvalidCommand unless it is a whole number from 1 to 65536."""
    return whole_number(count, 1, MOST_ITEMS, "a count of items")


async def read_each(node: Requester, commands: Iterable[Command[T]], options: ReadOptions) -> tuple[T, ...]:
    """Return the values of several reads that form one call, made one after the other."""
    requests = SeveralRequests(node, options)
    return tuple([await requests.request(command) for command in commands])


def encoder(point: Point[Any]) -> Callable[[Any], Command[None]]:
    """Return the function that makes the write command of a value. Raises InvalidCommand for a read-only point."""
    if point.encode is None:
        raise InvalidCommand(f"{point.node.label}: {point.item} is read-only")
    return point.encode


def item_text(item: str) -> str:
    """Return the item. Raises InvalidCommand for a number: 1.10 would become 1.1, and 7 may mean `element(7)`."""
    if not isinstance(item, str):
        raise InvalidCommand(f"an item is text, such as {str(item)!r}, not {item!r}")
    return item


def unknown_item(item: str, known: Iterable[str], form: str) -> InvalidCommand:
    """Return the error for an item that does not exist, with the valid form and the nearest name."""
    return InvalidCommand(f"no such item {item!r}: use {form}{guess(str(item), known)}")


__all__ = [
    "Action",
    "Handle",
    "Send",
    "checked_count",
    "encoder",
    "item_text",
    "read_each",
    "unknown_item",
]
