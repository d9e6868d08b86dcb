"""The common base of the handles of a comms array (HCP, HCP2, MicroFlex): elements by number or name."""

from __future__ import annotations

import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, Generic, TypeVar, Unpack, overload

import anyio

from busmaster.bus.handle import Action, Handle, Send, checked_count, item_text, read_each, unknown_item
from busmaster.bus.parameters import Parameter, Value
from busmaster.bus.points import Point
from busmaster.bus.requester import ReadOptions, SeveralRequests, WriteOptions
from busmaster.contract.arguments import is_decimal, seconds, whole_number
from busmaster.contract.exchange import Command
from busmaster.contract.items import Access
from busmaster.errors import BusClosed, BusError, InvalidCommand, NotStarted, VerifyFailed, WriteUnconfirmed
from busmaster.protocols._comms.codec import ReadElement, WriteElements, is_read_back, telegrams
from busmaster.protocols._comms.elements import STARTS_EVENT, Element

T = TypeVar("T")

LAST_OF_PROGRAM = 99
"""The elements up to this number belong to the Mint program."""
COMMAND_ELEMENT = 1
"""The element of the documents' handshake that takes the command. The elements after it have the data."""
LOOK_AGAIN = 0.02
"""Seconds between two reads of an element that is awaited."""
LONGEST_HANDOVER = 2.0
"""Seconds for which a command holds the line: three exchanges, each with its retries."""


def _number_or_name(item: int | str) -> int | str:
    """Return an element's number, also of one that is given as decimal text, or else its name."""
    return int(item) if isinstance(item, str) and is_decimal(item) else item


class CommsHandle(Handle):
    """A handle of a node with a comms array. Each protocol defines the commands and the names of the elements."""

    _read_command: ClassVar[type[ReadElement]]
    _write_command: ClassVar[type[WriteElements]]
    elements: ClassVar[Mapping[str, Element[object]]] = {}
    _definite: ClassVar[bool] = False
    """True if every node has exactly this map: its read-only elements are then rejected by number, too."""
    _form: ClassVar[str]
    """The valid form of an item, for the message after a wrong one."""

    @classmethod
    def items(cls) -> tuple[str, ...]:
        return tuple(cls.elements)

    @classmethod
    def _names_of_items(cls) -> Mapping[str, str]:
        return {str(element.number): name for name, element in cls.elements.items()}

    def point(self, item: str) -> Point[Any]:
        """Return an element as a point, by its number, decimal, or by its name."""
        element = _number_or_name(item_text(item))
        return self.element(element) if isinstance(element, int) else self.named(self._lookup(element))

    def element(self, number: int) -> Point[float]:
        """Return the point of an element number.

        It is read and written without a check, unless the map is definite: the node refuses missing elements.
        """

        def encode(value: float) -> Command[None]:
            return self._write_command(number, (value,))

        read_only = self._definite and any(e.number == number and not e.writable for e in self.elements.values())
        return Point(self.node, str(number), self._read_command(number), encode=None if read_only else encode)

    def named(self, element: Element[T]) -> Point[T]:
        """Return the point of a named element: decoded, with its unit, and read-only if it is so in the map."""

        def encode(value: Any) -> Command[None]:
            # Named elements are levels, which may be written twice (R7). Only Comms 1 to 5 start events.
            return self._write_command(element.number, (value,), idempotent=True)

        return Point(
            self.node,
            element.name,
            self._read_command(element.number),
            unit=element.unit,
            decode=element.decode,
            encode=encode if element.writable else None,
        )

    @overload
    async def read(self, item: int | str, **options: Unpack[ReadOptions]) -> float: ...

    @overload
    async def read(self, item: int | str, count: int, **options: Unpack[ReadOptions]) -> tuple[float, ...]: ...

    async def read(
        self, item: int | str, count: int | None = None, **options: Unpack[ReadOptions]
    ) -> float | tuple[float, ...]:
        """Return the number in an element; with `count`, a tuple of this many from there on, read one by one.

        Raises Refused for an element that the node does not have.
        """
        item = _number_or_name(item)
        number = item if isinstance(item, int) else self._lookup(item).number
        if count is None:
            return await self.node.request(self._read_command(number), **options)
        commands = [self._read_command(one) for one in range(number, number + checked_count(count))]
        return await read_each(self.node, commands, options)

    async def write(self, item: int | str, *values: float, **options: Unpack[WriteOptions]) -> None:
        """Write values to an element and those after it, acknowledged.

        A list that does not fit into one telegram of 60 characters is sent in several; if one of them fails, the values
        before it are stored. `verify` reads every element back, compares at single precision and 4 decimals, and raises
        VerifyFailed for the first difference. `idempotent` allows a retry after an unknown outcome; do not use it for
        elements that start a Mint event (Comms 1 to 5). `start_within` applies to each telegram.

        Raises InvalidCommand before anything is sent for a value that cannot be sent, or a read-only name.
        """
        commands = self._writes(item, values, stop=options.get("safe"))
        requests = SeveralRequests(self.node, options)
        for command in commands:
            await requests.request(command)
        for number, value in enumerate(values if requests.verify else (), commands[0].element):
            await self._verify(requests, number, value)

    def _writes(self, element: int | str, values: Sequence[float], *, stop: bool | None = None) -> list[WriteElements]:
        """Return the commands that `write` sends.

        Raises InvalidCommand for a value that cannot be sent or violates a limit; a `stop` is not limited. Also for a
        read-only name, or a list that reaches one. If the map is definite, this applies to numbers too.
        """
        element = _number_or_name(element)
        number = element if isinstance(element, int) else self._lookup(element).number
        if self._definite or not isinstance(element, int):
            for known in self.elements.values():
                if known.number in range(number, number + max(1, len(values))) and not known.writable:
                    raise InvalidCommand(f"{self.node.label}: {known.name} is read-only")
        if not values:
            raise InvalidCommand(f"{self.node.label}: there is no value to write")
        commands = [self._write_command(number + offset, part) for offset, part in telegrams(values)]
        self.node.check(*commands, stop=stop)
        return commands

    def _prepare_write(self, item: str, values: Sequence[Any], **options: Unpack[WriteOptions]) -> list[Send]:
        """Return the write of consecutive elements, in as many telegrams as necessary."""
        self._writes(item, values, stop=options.get("safe"))
        return [lambda: self.write(item, *values, **options)]

    def _listed(self) -> Iterable[Parameter]:
        """Return the elements of the Mint program, if the map has them, then the named elements."""
        for number in () if self._definite else range(1, LAST_OF_PROGRAM + 1):
            kept = "a write starts an event of the Mint program" if number in STARTS_EVENT else ""
            yield Parameter(item=str(number), kept=kept)
        for element in self.elements.values():
            access: Access = "read/write" if element.writable else "read"
            yield Parameter(item=element.name, unit=element.unit, access=access, kept=element.kept)

    @classmethod
    def _same(cls, item: str, one: Value, other: Value) -> bool:
        return is_read_back(one, other)

    async def _verify(self, requests: SeveralRequests, number: int, written: float) -> None:
        command = self._read_command(number)
        found = await requests.read_back(command)
        if not is_read_back(written, found):
            raise VerifyFailed(
                f"element {number} reads {found!r} after {written!r} was written",
                node=self.node,
                command=str(command),
            )

    def _lookup(self, name: str) -> Element[object]:
        element = self.elements.get(name)
        if element is None:
            raise unknown_item(name, self.elements, self._form)
        return element


class MintHandle(CommsHandle):
    """A handle of a controller that runs a Mint program, which elements 1 to 99 belong to."""

    async def execute(
        self,
        command: float,
        *data: float,
        finish_within: float,
        takes: float = 0.0,
        element: int = COMMAND_ELEMENT,
    ) -> None:
        """Have the Mint program carry out a command, and return when it reports the end: the handshake of AN00110 and
        AN00129.

        The data are written to the elements after `element`, then the command to `element`. The program sets that
        element to 0 when the command is done. All this may take `finish_within` seconds. No other request of any
        program, except an urgent one, goes between the data and the command.

        The program of the documents sets the element to 0 at the end of every loop. A command that arrives between its
        read and that statement is lost, and looks like one that is done. A program that sets the element to 0 only
        after a command has no such gap. For others, `takes` is the shortest time in seconds that the command can take:
        an end before that raises VerifyFailed.

        Raises NotStarted, and does not send the command, while the program carries out another one, or if the time is
        over before. Raises WriteUnconfirmed if it is not known whether the command arrived, or if its end was not
        reported in time: the program may still carry it out. Raises VerifyFailed if another command has replaced it.
        If the caller is cancelled, a command that was sent is carried out. Raises InvalidCommand, before anything is
        sent, for a command of 0 and for values that cannot be sent.
        """
        node, finish_within = self.node, seconds(finish_within, f"{self.node.label}: finish_within")
        seconds(takes, f"{node.label}: takes")
        start = self._command_of(command, data, element)
        finish_by = node.now() + finish_within
        async with self.exclusive(max_hold=LONGEST_HANDOVER) as held:
            await held._hand_over(start, data, finish_by)
            sent = node.now()  # a command that was repeated is not measured from its first attempt
            await held._start(start, finish_by)
        await self._await_end(start, sent, finish_by, takes)

    def _command_of(self, command: float, data: Sequence[float], element: int) -> WriteElements:
        """Return the write that starts a command. Raises InvalidCommand for one that cannot be sent, or its data."""
        start = self._write_command(element, (command,))
        if float(start.text) == 0:
            raise InvalidCommand(f"{self.node.label}: 0 is not a command, but the report that one is done")
        whole_number(start.element + len(data), 1, LAST_OF_PROGRAM, f"{self.node.label}: the last element of a command")
        if data:
            self._writes(start.element + 1, data)
        self.node.check(start)
        return start

    async def _hand_over(self, start: WriteElements, data: Sequence[float], finish_by: float) -> None:
        """Write the data, unless the program carries out a command: it could use them for that."""
        running = await self.read(start.element, finish_within=self._left(finish_by))
        if running != 0:
            raise NotStarted(
                f"element {start.element} is {running:g}: the program still carries out a command",
                node=self.node,
                command=str(start),
                hint="wait until it is 0; if it stays, see whether the program runs",
            )
        if not data:
            return
        first = start.element + 1
        try:
            await self.write(first, *data, finish_within=self._left(finish_by))
        except WriteUnconfirmed:
            # Not written twice, for a write may start an event. If they are all there, nothing needs to be.
            found = await self.read(first, len(data), finish_within=self._left(finish_by))
            if not all(map(is_read_back, data, found)):
                raise

    async def _start(self, start: WriteElements, finish_by: float) -> None:
        """Write the command. If it is not acknowledged, the element shows whether it has arrived."""
        try:
            await self.node.request(start, finish_within=self._left(finish_by))
        except WriteUnconfirmed as error:
            try:
                found = await self.read(start.element, finish_within=self._left(finish_by))
            except BusError:
                raise error from None
            if not is_read_back(start.values[0], found):
                error.hint = "it is lost, or done already: check its effect before you give it again"
                raise

    async def _await_end(self, start: WriteElements, sent: float, finish_by: float, takes: float) -> None:
        """Read the element of a command until it is 0."""
        element, last = start.element, ""
        while (left := self._left(finish_by)) > 0:
            await anyio.sleep(min(LOOK_AGAIN, left))
            try:
                found = await self.read(element, finish_within=self._left(finish_by))
            except BusClosed:
                raise
            except BusError as error:  # the program goes on meanwhile, so it may yet be seen to end
                last = last or error.what
                continue
            last = f"it read {found:g} last"
            if found == 0:
                took = self.node.now() - sent
                if took < takes:
                    raise VerifyFailed(
                        f"element {element} is 0 after {took:.3f} s, and the command takes {takes:g} s at least",
                        node=self.node,
                        command=str(start),
                        hint="the program may have set it to 0 without the command: check its effect",
                    )
                return
            if not is_read_back(start.values[0], found):
                raise VerifyFailed(
                    f"element {element} reads {found:g} after command {start.text}: another one has replaced it",
                    node=self.node,
                    command=str(start),
                    hint="let one program alone give commands to a controller",
                )
        raise WriteUnconfirmed(
            f"the command was sent, and element {element} did not become 0 in time: {last or 'it was not read'}",
            node=self.node,
            command=str(start),
            hint="the program may still carry it out: read the element",
        )

    def _left(self, finish_by: float) -> float:
        return max(0.0, finish_by - self.node.now())

    _actions: ClassVar[Mapping[str, Action]] = {
        "execute": Action(
            "Have the Mint program carry out a command with its data, by the handshake of the Mint notes.",
            execute,
            check=lambda handle, command, *data: handle._command_of(command, data, COMMAND_ELEMENT),
            numbers=("COMMAND", "DATA..."),
            time="finish_within",
            needs_time=True,
            least="takes",
        )
    }


class HasElements(typing.Protocol):
    """An object that makes points of named elements."""

    @property
    def named(self) -> Callable[[Element[T]], Point[T]]: ...


class Named(Generic[T]):
    """A class attribute: the point of one named element."""

    def __init__(self, element: Element[T]) -> None:
        self.element = element

    @overload
    def __get__(self, holder: None, owner: type) -> Named[T]: ...

    @overload
    def __get__(self, holder: HasElements, owner: type) -> Point[T]: ...

    def __get__(self, holder: HasElements | None, owner: type) -> Named[T] | Point[T]:
        return self if holder is None else holder.named(self.element)
