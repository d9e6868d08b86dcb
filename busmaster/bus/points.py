"""Points: the named readable, and possibly writable, quantities of a node."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, Generic, TypeVar, Unpack

from busmaster.bus.limits import Limit
from busmaster.bus.meaning import PLAIN, Meaning, bit_of
from busmaster.bus.requester import CommandOptions, ReadOptions, Requester
from busmaster.contract.arguments import meant, seconds
from busmaster.contract.exchange import Command
from busmaster.errors import GarbledReply, InvalidCommand

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Point(Generic[T]):
    """One quantity of one node: how it is read, what its value means, and how it is written.

    `item`: its name on the command line ("axis0.position", "1.17"). `command`: the read command. `decode`: converts the
    command's result to the value (a number to an IntFlag, a scaled integer to a float). `encode`: makes the write
    command of a value, and raises InvalidCommand for a value out of range. `meaning`: what the value means to people,
    outputs and alarms. `read_after_write`: a poll group that has the point reads it after a confirmed write to it,
    before its next cycle.

    Two points are equal if node, item and command are equal, so a point can be created again each time.
    """

    node: Requester
    item: str
    command: Command[Any]
    unit: str = field(default="", compare=False)
    decode: Callable[[Any], T] | None = field(default=None, compare=False, repr=False)
    encode: Callable[[T], Command[None]] | None = field(default=None, compare=False, repr=False)
    meaning: Meaning = field(default=PLAIN, compare=False, repr=False)
    read_after_write: bool = field(default=False, compare=False, repr=False)

    @property
    def key(self) -> str:
        """Return address and item, as in JSON output: "5/axis0.position"."""
        return f"{self.node.address}/{self.item}"

    @property
    def quantity(self) -> tuple[Requester, Command[Any]]:
        """Return node and command. A write to one point makes all points of the same quantity stale."""
        return self.node, self.command

    def value_of(self, raw: Any) -> T:
        """Return the value for a result of its command. Raises GarbledReply if the result cannot be decoded."""
        value: T = raw
        if self.decode is not None:
            try:
                value = self.decode(raw)
            except Exception as bad:  # a decoder may be code of the application
                raise GarbledReply(
                    f"{raw!r} is not a value of {self.item}: {bad}", node=self.node, command=str(self.command)
                ) from bad
        if self.meaning.names:
            value = self.meaning.named(value)
        return value

    @property
    def writable(self) -> bool:
        """Return True if the protocol has a write for it."""
        return self.encode is not None

    @property
    def bits(self) -> tuple[Point[bool], ...]:
        """Return the points of its named bits: "status.READY".

        They use the same read, so polling them costs nothing extra. They are read-only: no telegram writes one bit
        without the others.
        """
        return tuple(self.bit(name) for name in self.meaning.bits)

    def bit(self, name: str) -> Point[bool]:
        """Return the point of one named bit. Raises InvalidCommand for an unknown name."""
        if name not in self.meaning.bits:
            raise InvalidCommand(f"{self.item} has no bit {name!r}; {meant(name, self.meaning.bits)}")
        number, of_word = self.meaning.bits[name], self.decode

        def decode(raw: Any) -> bool:
            return bit_of(raw if of_word is None else of_word(raw), number)

        of_bit = self.meaning.of_bit(name)
        # For the type checker: `replace` would return a Point[T].
        word: Any = self
        bit: Point[bool] = replace(
            word, item=f"{self.item}.{name}", unit="", decode=decode, encode=None, meaning=of_bit
        )
        return bit

    def limit(
        self,
        *,
        minimum: float | None = None,
        maximum: float | None = None,
        max_step: float | None = None,
        writable: bool = True,
    ) -> Limit:
        """Limit all writes to its quantity. A write outside the limits raises InvalidCommand, and nothing is sent.

        The limits are in the point's unit. They apply to all names of the quantity, to lists, blocks and writes to all
        nodes, and in addition to existing limits. `max_step`: largest change from the last confirmed value, which is
        read first if it is not known; an urgent write may make any step. A stop such as `disable` always passes.
        Returns the limit, for `Node.lift`.
        """
        limit = Limit(
            name=self.item,
            read=self.command,
            decode=self.value_of,
            unit=self.unit,
            minimum=minimum,
            maximum=maximum,
            max_step=max_step,
            writable=writable,
        )
        self.node.limit(limit)
        return limit

    async def read(self, *, max_age: float | None = None, **options: Unpack[ReadOptions]) -> T:
        """Read its value, or, with `max_age` in seconds, use a poll group's latest sample if it is new enough.

        The other options are those of `RequestOptions`.
        """
        if max_age is not None:
            # Infinity is allowed here, unlike for other times: any value of a poll group is new enough.
            if max_age != inf:
                max_age = seconds(max_age, f"{self.node.label}: max_age")
            # from any group: two groups may read one quantity, and a write makes the samples of both stale
            sample = self.node.latest(self)
            if sample is not None and sample.error is None and sample.age(self.node.now()) <= max_age:
                value: T = sample.value
                return value
        return self.value_of(await self.node.request(self.command, **options))

    async def write(self, value: T, **options: Unpack[CommandOptions]) -> None:
        """Write a value. Raises InvalidCommand, before anything is sent, if it is read-only or cannot be sent."""
        if self.encode is None:
            raise InvalidCommand(f"{self.node.label}: {self.item} is read-only")
        # Without `touches`, the write would make all samples of the node stale.
        await self.node.request(self.encode(value), touches=self.command, **options)


__all__ = [
    "Point",
]
