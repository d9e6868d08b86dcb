"""Parameter sets: the values of a node, item by item, to be saved, compared, and written to a node again."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from enum import Enum
from math import isclose, isfinite
from typing import Any, ClassVar, NamedTuple, Protocol, TypeAlias

from busmaster.arbiter.transaction import BACKGROUND
from busmaster.bus.points import Point
from busmaster.bus.requester import Requester
from busmaster.contract.exchange import Command
from busmaster.contract.items import Access
from busmaster.contract.profile import Profile
from busmaster.errors import (
    BusError,
    GarbledReply,
    InvalidCommand,
    NoReply,
    NoSuchParameter,
    NotStarted,
    Refused,
    VerifyFailed,
    WriteUnconfirmed,
)

Value: TypeAlias = bool | int | float

FIRST, USUAL, LAST = -1, 0, 1
"""When a load writes a parameter: before all others (a mode on which they depend), in the document's order, or after
all others (a command that stores them)."""
ROUNDS = 3
"""How often a request is made that gets no reply while the node replies to others, each time with its retries. On a
line that loses 2 % of all telegrams one request in some 10 000 fails, and a list may have as many parameters."""
AT_A_TIME = 128
"""Number of reads that are merged together into cheaper exchanges."""
ROUNDING = 1e-12
"""Relative difference of two numbers that is caused only by the conversion to and from a unit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """One parameter of a node.

    `item`: its item for the handle's `point`. `name`: its name in the document. `access`: the access that the document
    states, or empty. A number on the line means number / 10**decimals * factor + offset in `unit`; `minimum` and
    `maximum` are in that unit. `kept`: the reason why a load never writes it, or empty. `stage`: when a load writes it,
    FIRST, USUAL or LAST.
    """

    item: str
    name: str = ""
    unit: str = ""
    access: Access = ""
    decimals: int = 0
    factor: float = 1
    offset: float = 0
    minimum: float | None = None
    maximum: float | None = None
    kept: str = ""
    stage: int = USUAL


class Entry(NamedTuple):
    """A parameter and its value, as a handle without decimals reads it."""

    parameter: Parameter
    value: Value


class Difference(NamedTuple):
    """A parameter of two sets; None is the value of the set that does not have it."""

    parameter: Parameter
    one: Value | None
    other: Value | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterSet:
    """The parameters of one node at one time, by item, in the order of the document.

    `protocol`: the kind of node, as in LINE.toml. `line`: the name of the port. `identity`: the items that identify the
    node, if its protocol has any. `by`: the user who saved it.
    """

    protocol: str
    address: int
    label: str = ""
    line: str = ""
    saved: datetime
    by: str = ""
    identity: Mapping[str, Value] = field(default_factory=dict)
    entries: Mapping[str, Entry] = field(default_factory=dict)


class Found(NamedTuple):
    """The result of reading one parameter: its value, or the reason. `gap`: the node reports that it does not exist."""

    parameter: Parameter
    value: Value | None = None
    why: str = ""
    gap: bool = False


class Change(NamedTuple):
    """One write of a load: the value before, and the value to be written."""

    parameter: Parameter
    before: Value
    value: Value


class Left(NamedTuple):
    """A parameter that a load does not write, and why. `before` is None if it could not be read.

    `expected`: it is not written according to the document or LINE.toml.
    """

    parameter: Parameter
    before: Value | None
    value: Value
    why: str
    expected: bool


class Result(Enum):
    """Result of one change."""

    WRITTEN = "written"
    """It was written and read back."""
    REFUSED = "refused"
    """The node, or a limit, refused it: the value is as before."""
    DIFFERS = "differs"
    """It was written, but something else was read back."""
    UNCONFIRMED = "unconfirmed"
    """It was sent, and the value in the node is not known."""
    NOT_WRITTEN = "not written"
    """Nothing was sent."""


class Outcome(NamedTuple):
    """A change, its result, and the reason."""

    change: Change
    result: Result
    why: str = ""


Prepare: TypeAlias = Callable[[Change, str], Callable[[], Awaitable[None]]]
"""Returns the function that carries out a change, for the item to write to. Raises InvalidCommand for a value that must
not be written."""
Around: TypeAlias = Callable[[Change], AbstractContextManager[object]]
"""Returns the context in which a change is written, for example one that keeps an audit log."""


class Holder(Protocol):
    """The part of a handle that parameter sets use."""

    profile: ClassVar[Profile]
    node: Requester
    _identity: ClassVar[tuple[str, ...]]

    def point(self, item: str, /) -> Point[Any]: ...

    def _plain(self) -> Holder: ...

    @classmethod
    def _same(cls, item: str, one: Value, other: Value) -> bool: ...

    def _written_item(self, item: str, before: Value, value: Value) -> str: ...


def alike(handle: type[Holder], item: str, one: Value, other: Value) -> bool:
    """Return True if two values of an item are the same to a node of this kind."""
    return isclose(one, other, rel_tol=ROUNDING) or handle._same(item, one, other)


def differences(handle: type[Holder], one: ParameterSet, other: ParameterSet) -> Iterator[Difference]:
    """Yield the parameters that differ in two sets of this kind of node, in the order of the first set.

    Raises InvalidCommand for a set of another kind.
    """
    kind = handle.profile.kind_name
    for each in (one, other):
        if each.protocol != kind:
            raise InvalidCommand(f"a set of a {each.protocol} cannot be compared with one of a {kind}")
    for item, entry in one.entries.items():
        found = other.entries.get(item)
        if found is None or not alike(handle, item, entry.value, found.value):
            yield Difference(entry.parameter, entry.value, None if found is None else found.value)
    for item, entry in other.entries.items():
        if item not in one.entries:
            yield Difference(entry.parameter, None, entry.value)


async def walk(handle: Holder, parameters: Sequence[Parameter]) -> AsyncIterator[Found]:
    """Read parameters one after the other in the background of other traffic, and yield the result of each.

    If the node's profile merges reads, merged ones are read together. A refused parameter is a gap. Raises the BusError
    of a node that does not reply any more, InvalidCommand for an item that does not exist.
    """
    handle = handle._plain()
    merge = handle.node.profile.merge
    commands = [handle.point(parameter.item).command for parameter in parameters]
    for start in range(0, len(parameters), AT_A_TIME):
        part = commands[start : start + AT_A_TIME]
        # A dict as an ordered set: reads that no batch serves are sent in the given order.
        left = dict.fromkeys(range(len(part)))
        # The largest first: it saves most, and those that overlap with it are skipped.
        for batch in sorted(merge(part) if merge else (), key=lambda batch: -len(batch.serves)):
            if not left.keys() >= set(batch.serves):
                continue
            try:
                values = await _answer(handle.node, batch.command)
            except (Refused, _Unanswered):
                continue  # one of them does not exist: they are read one by one
            for index, raw in zip(batch.serves, values, strict=True):
                del left[index]
                yield _found(handle, parameters[start + index], raw)
        for index in left:
            yield await read_one(handle, parameters[start + index], part[index])


async def read_one(handle: Holder, parameter: Parameter, command: Command[Any] | None = None) -> Found:
    """Read one parameter. Raises as `walk`."""
    handle = handle._plain()
    command = handle.point(parameter.item).command if command is None else command
    try:
        return _found(handle, parameter, await _answer(handle.node, command))
    except NoSuchParameter:
        return Found(parameter, why="no such parameter", gap=True)
    except Refused as refusal:
        return Found(parameter, why=refusal.what, gap=True)
    except _Unanswered as error:
        return Found(parameter, why=f"{error}, though the node replies to other reads")


class _Unanswered(Exception):
    """A read has no valid reply, and the node replies to its probe."""


async def _answer(node: Requester, command: Command[Any]) -> Any:
    """Return the value of a read. Raises _Unanswered if the node replies to its probe only, else its BusError."""
    why = ""
    for _ in range(ROUNDS):
        try:
            return await node.request(command, priority=BACKGROUND)
        except (NoReply, GarbledReply) as error:
            why = error.what
        try:
            # A dead node would otherwise take three rounds for each of hundreds of parameters.
            await node.request(node.profile.probe, priority=BACKGROUND)
        except Refused:
            pass  # it replies
    raise _Unanswered(why)


def _found(handle: Holder, parameter: Parameter, raw: Any) -> Found:
    try:
        value = handle.point(parameter.item).value_of(raw)
    except GarbledReply as error:
        return Found(parameter, why=error.what)
    # First, because a bool is an int too and would become 0 or 1 in the set.
    if isinstance(value, bool):
        return Found(parameter, value)
    if isinstance(value, int):
        return Found(parameter, int(value))  # the number of a word, without its names
    if isinstance(value, float) and isfinite(value):
        return Found(parameter, value)
    return Found(parameter, why=f"it holds {value!r}, which is not one finite number")


class ParameterLoad:
    """The writes that would give a node the values of a set. Nothing is written yet.

    `changes`: the differences that `write` writes, in that order. `left`: those that it does not write, with reasons.
    `equal`: number of parameters that have the value already. `undo`: the values that the changes overwrite. `prepare`
    checks all changes before the first is written.
    """

    def __init__(self, handle: Holder, before: ParameterSet, prepare: Prepare) -> None:
        self.changes: tuple[Change, ...] = ()
        self.left: tuple[Left, ...] = ()
        self.equal = 0
        self.undo = before
        self._handle = handle
        self._prepare = prepare

    def _take(self, found: Iterable[tuple[Entry, Found]]) -> None:
        """Sort the values that were read: equal, to be written, or not writable."""
        changes, left = [], []
        for (own, value), now in found:
            if now.value is None:
                left.append(Left(own, None, value, now.why, False))
            # Before the checks: a read-only parameter that has the value already is equal, and not one that could not
            # be written.
            elif alike(type(self._handle), own.item, now.value, value):
                self.equal += 1
            elif why := self._why_never(own):
                left.append(Left(own, now.value, value, why, True))
            elif why := self._why_not(Change(own, now.value, value)):
                left.append(Left(own, now.value, value, why, False))
            else:
                changes.append(Change(own, now.value, value))
        # `sorted` is stable, so the document's order remains within each stage.
        self.changes = tuple(sorted(changes, key=lambda change: change.parameter.stage))
        self.left = tuple(left)
        entries = {change.parameter.item: Entry(change.parameter, change.before) for change in self.changes}
        self.undo = replace(self.undo, entries=entries)

    def _why_never(self, parameter: Parameter) -> str:
        if parameter.kept:
            return parameter.kept
        read_only = parameter.access == "read" or not self._handle.point(parameter.item).writable
        return "it is read-only" if read_only else ""

    def _why_not(self, change: Change) -> str:
        try:
            self._sending(change)
        except InvalidCommand as error:
            return str(error)
        return ""

    def _sending(self, change: Change) -> Callable[[], Awaitable[None]]:
        item = self._handle._written_item(change.parameter.item, change.before, change.value)
        return self._prepare(change, item)

    async def write(self, *, around: Around = lambda change: nullcontext()) -> AsyncIterator[Outcome]:
        """Write the changes one after the other, verify each by reading it back, and yield the result of each.

        A refusal does not stop the others. After a write with an unknown outcome, or if nothing can be sent, nothing
        more is written. `around` returns the context in which each change is written.
        """
        stopped = ""
        for change in self.changes:
            if stopped:
                yield Outcome(change, Result.NOT_WRITTEN, stopped)
                continue
            outcome = await self._outcome(change, around)
            # Later parameters may depend on this one, for example on a mode.
            if outcome.result in (Result.UNCONFIRMED, Result.NOT_WRITTEN):
                stopped = f"nothing is written after {change.parameter.item}, whose write did not succeed"
            yield outcome

    async def _outcome(self, change: Change, around: Around) -> Outcome:
        try:
            # The exception passes through the context, so that an audit log gets the outcome too.
            with around(change):
                await self._write(change)
        except (Refused, InvalidCommand) as error:
            return Outcome(change, Result.REFUSED, error.what if isinstance(error, BusError) else str(error))
        except VerifyFailed as error:
            return Outcome(change, Result.DIFFERS, error.what)
        except NotStarted as error:
            return Outcome(change, Result.NOT_WRITTEN, error.what)
        except BusError as error:
            return Outcome(change, Result.UNCONFIRMED, error.what)
        return Outcome(change, Result.WRITTEN)

    async def _write(self, change: Change) -> None:
        """Write and read back. A write with an unknown outcome is repeated if the old value is read back: then it was
        not carried out."""
        unconfirmed: BusError | None = None
        for _ in range(ROUNDS):
            try:
                # Checked again: a limit can have been added since the load was prepared.
                await self._sending(change)()
                unconfirmed = None
            except (WriteUnconfirmed, NoReply, GarbledReply) as error:
                unconfirmed = error
            found = await self._read_back(change, unconfirmed)
            if alike(type(self._handle), change.parameter.item, found, change.value):
                return
            # A third value: something else writes to this parameter.
            if unconfirmed is None or not alike(type(self._handle), change.parameter.item, found, change.before):
                raise VerifyFailed(f"it reads {found!r} after {change.value!r} was written", node=self._handle.node)
        assert unconfirmed is not None
        raise unconfirmed

    async def _read_back(self, change: Change, unconfirmed: BusError | None) -> Value:
        try:
            found = await read_one(self._handle, change.parameter)
        except BusError as error:
            what = "sent, and not answered" if unconfirmed is not None else "acknowledged, but not read back"
            raise WriteUnconfirmed(f"{what}: {error.what}", node=self._handle.node) from error
        if found.value is None:
            raise WriteUnconfirmed(f"it cannot be read back: {found.why}", node=self._handle.node)
        return found.value


async def identity_of(handle: Holder) -> dict[str, Value]:
    """Return the values that identify a node, by item, without items that it does not have. Raises as `walk`."""
    found = [await read_one(handle, Parameter(item=item)) for item in handle._identity]
    return {one.parameter.item: one.value for one in found if one.value is not None}


async def empty_set(handle: Holder, by: str = "") -> ParameterSet:
    """Return a set of a node without parameters, with the values that identify it. Raises as `walk`."""
    node = handle.node
    return ParameterSet(
        protocol=handle.profile.kind_name,
        address=node.address,
        label=node.label,
        line=node.line,
        saved=datetime.now(UTC).replace(microsecond=0),
        by=by,
        identity=await identity_of(handle),
    )


async def prepared(
    handle: Holder, wanted: ParameterSet, own: Mapping[str, Parameter], prepare: Prepare, by: str
) -> ParameterLoad:
    """Read the parameters of a set from a node, and return the load that writes the differences.

    `own`: the parameters of the node. `handle`: a plain one.

    Raises InvalidCommand for a set of another kind of node, BusError for a node that does not reply.
    """
    kind = handle.profile.kind_name
    if wanted.protocol != kind:
        raise InvalidCommand(f"{handle.node.label} is a {kind}: a set of a {wanted.protocol} is not for it")
    load = ParameterLoad(handle, await empty_set(handle, by), prepare)
    asked = [own.get(item, entry.parameter) for item, entry in wanted.entries.items()]
    found = {one.parameter.item: one async for one in walk(handle, asked)}
    order = {item: number for number, item in enumerate(own)}
    # In the document's order. Parameters that the document does not list follow, in the order of the set.
    items = sorted(wanted.entries, key=lambda item: order.get(item, len(order)))
    load._take((Entry(found[item].parameter, wanted.entries[item].value), found[item]) for item in items)
    return load


__all__ = [
    "FIRST",
    "LAST",
    "USUAL",
    "Change",
    "Difference",
    "Entry",
    "Found",
    "Left",
    "Outcome",
    "Parameter",
    "ParameterLoad",
    "ParameterSet",
    "Result",
    "Value",
]
