"""What the handles of a comms array share (HCP, HCP2, MicroFlex): elements by number or name, written and verified."""

from __future__ import annotations

import typing
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar, overload

from busmaster.bus.handle import Handle, Send, is_decimal, item_text, unknown_item
from busmaster.bus.points import Point
from busmaster.contract.exchange import Command
from busmaster.errors import InvalidCommand, VerifyFailed
from busmaster.protocols._comms.codec import ReadElement, WriteElements, is_read_back, telegrams
from busmaster.protocols._comms.elements import Element

if TYPE_CHECKING:
    from busmaster.bus.node import Priority

T = TypeVar("T")


class CommsHandle(Handle):
    """A handle of a node with a comms array. Each protocol says how an element is read and written, and its names."""

    read_command: ClassVar[type[ReadElement]]
    write_command: ClassVar[type[WriteElements]]
    elements: ClassVar[Mapping[str, Element[object]]] = {}
    form: ClassVar[str]
    """What an item looks like, for the message to someone who mistyped it."""

    @classmethod
    def items(cls) -> tuple[str, ...]:
        return tuple(cls.elements)

    @classmethod
    def names_of_items(cls) -> Mapping[str, str]:
        return {str(element.number): name for name, element in cls.elements.items()}

    def point(self, item: str) -> Point[Any]:
        """An element by its number, decimal, or by its name."""
        if is_decimal(item_text(item)):
            return self.element(int(item))
        return self.named(self._lookup(item))

    def element(self, number: int) -> Point[float]:
        """An element by its number: read and written as it is, for the node to refuse."""
        return Point(
            self.node, str(number), self.read_command(number), encode=lambda value: self.write_command(number, (value,))
        )

    def named(self, element: Element[T]) -> Point[T]:
        """An element by what it stands for: decoded, with its unit, and read-only if the map says so."""

        def encode(value: Any) -> Command[None]:
            return self.write_command(element.number, (value,), idempotent=True)

        return Point(
            self.node,
            element.name,
            self.read_command(element.number),
            unit=element.unit,
            decode=element.decode,
            encode=encode if element.writable else None,
        )

    async def read(
        self,
        element: int | str,
        *,
        priority: Priority | None = None,
        start_within: float | None = None,
        retries: int | None = None,
    ) -> float:
        """The number that an element holds now. Raises Refused for one that the node does not have."""
        number = element if isinstance(element, int) else self._lookup(element).number
        return await self.node.request(
            self.read_command(number), priority=priority, start_within=start_within, retries=retries
        )

    async def write(
        self,
        element: int | str,
        *values: float,
        verify: bool = False,
        idempotent: bool = False,
        priority: Priority | None = None,
        start_within: float | None = None,
    ) -> None:
        """Write values to an element and those after it, acknowledged.

        A list that does not fit one telegram of 60 characters is sent in several; if one of them fails, those before
        it are stored. `verify` reads every element back and compares at single precision and 4 decimals: it raises
        VerifyFailed for the first that differs. `idempotent` allows a retry after an unknown outcome: not for
        elements whose writing starts a Mint event (Comms 1 to 5). `start_within` is for each telegram.

        Raises InvalidCommand before anything is sent for a value that cannot be sent, or a read-only name.
        """
        commands = self.writes(element, values, idempotent)
        for command in commands:
            await self.node.request(command, priority=priority, start_within=start_within)
        if verify:
            for number, value in enumerate(values, commands[0].element):
                await self._verify(number, value, priority)

    def writes(self, element: int | str, values: Sequence[float], idempotent: bool = False) -> list[WriteElements]:
        """What `write` sends. Raises InvalidCommand for a value that cannot be sent; and where the map has names, for a
        name that it calls read-only, or that another value of the list would go to."""
        number = element if isinstance(element, int) else self._lookup(element).number
        if not isinstance(element, int):
            for known in self.elements.values():
                if known.number in range(number, number + max(1, len(values))) and not known.writable:
                    raise InvalidCommand(f"{self.node.label}: {known.name} is read-only")
        if not values:
            raise InvalidCommand(f"{self.node.label}: there is no value to write")
        return [self.write_command(number + offset, part, idempotent) for offset, part in telegrams(values)]

    def prepare_write(self, item: str, values: Sequence[Any], verify: bool = False) -> list[Send]:
        """Consecutive elements, in as many telegrams as it takes."""
        element = int(item) if is_decimal(item) else item
        self.writes(element, values)
        return [lambda: self.write(element, *values, verify=verify)]

    async def _verify(self, number: int, written: float, priority: Priority | None) -> None:
        command = self.read_command(number)
        found = await self.node.request(command, priority=priority)
        if not is_read_back(written, found):
            raise VerifyFailed(
                f"element {number} reads {found!r} after {written!r} was written",
                node=self.node.label,
                command=str(command),
            )

    def _lookup(self, name: str) -> Element[object]:
        element = self.elements.get(name)
        if element is None:
            raise unknown_item(name, self.elements, self.form)
        return element


class HasElements(typing.Protocol):
    """Whatever makes a point of a named element."""

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
