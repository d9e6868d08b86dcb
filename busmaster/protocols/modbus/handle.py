"""The handle of a Modbus unit."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Unpack

from busmaster.bus.handle import Handle, Send, checked_count, item_text, read_each, unknown_item
from busmaster.bus.points import Point
from busmaster.bus.requester import NodeSource, ReadOptions, SeveralRequests, WriteOptions
from busmaster.contract.arguments import is_decimal, whole_number
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import InvalidCommand, VerifyFailed
from busmaster.protocols.modbus.codec import (
    MOST_BITS_READ,
    MOST_BITS_WRITTEN,
    MOST_READ,
    MOST_WRITTEN,
    PROFILE,
    READS,
    Merging,
    ReadBits,
    ReadRegisters,
    WriteCoils,
    WriteRegisters,
)

BITS = ("coil", "discrete")
WRITABLE = ("coil", "holding")
FORM = (
    "holding:100, input:100, coil:5 or discrete:5, with :10 for a run of ten, or :float32 (and :swapped) for a number"
)

FORMS = {
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
"""The kinds of numbers, with their formats for `struct`."""


@dataclass(frozen=True, slots=True)
class Number:
    """The form of a number in registers: most significant word first, or last if `swapped`.

    Within a word the most significant byte is always first. Raises InvalidCommand for a kind that does not exist.
    """

    kind: str = "uint16"
    swapped: bool = False

    def __post_init__(self) -> None:
        if self.kind not in FORMS:
            raise InvalidCommand(f"there is no kind of number {self.kind!r}: use {', '.join(FORMS)}")

    @property
    def registers(self) -> int:
        """Number of registers of one number."""
        return struct.calcsize(f">{FORMS[self.kind]}") // 2

    def decode(self, words: Sequence[int]) -> int | float:
        """Return the number in these words. There must be `registers` of them."""
        if self.swapped:
            words = words[::-1]
        number: int | float = struct.unpack(f">{FORMS[self.kind]}", struct.pack(f">{len(words)}H", *words))[0]
        return number

    def encode(self, value: float) -> tuple[int, ...]:
        """Return the words for a value. Raises InvalidCommand for one that does not fit."""
        if self.kind.startswith("float"):
            data = self._float(value)
        else:
            signed, bits = not self.kind.startswith("u"), 16 * self.registers
            low = -(2 ** (bits - 1)) if signed else 0
            number = whole_number(value, low, low + 2**bits - 1, f"a value of {self.kind}")  # type: ignore[arg-type]  # or refused
            data = number.to_bytes(bits // 8, "big", signed=signed)
        words: tuple[int, ...] = struct.unpack(f">{self.registers}H", data)
        return words[::-1] if self.swapped else words

    def _float(self, value: float) -> bytes:
        try:
            if not isinstance(value, bool) and math.isfinite(value):
                return struct.pack(f">{FORMS[self.kind]}", value)
        except (TypeError, OverflowError):
            pass
        raise InvalidCommand(f"{value!r} cannot be sent as {self.kind}")


@dataclass(frozen=True, slots=True)
class Place:
    """The meaning of an ITEM: a number at an address of a table, or a run of `count` coils or registers there."""

    table: str
    first: int
    count: int | None
    number: Number

    @classmethod
    def parse(cls, item: str) -> Place:
        """Return the place of an item. Raises InvalidCommand for an item that does not exist."""
        table, _, rest = item_text(item).partition(":")
        address, *kind = rest.split(":")
        if table not in READS or not is_decimal(address):
            raise unknown_item(item, READS, FORM)
        first = int(address)
        match kind:
            case []:
                return cls(table, first, None, Number())
            case [count] if is_decimal(count):
                return cls(table, first, int(count), Number())
            case [name] if name in FORMS and table not in BITS:
                return cls(table, first, None, Number(name))
            case [name, "swapped"] if name in FORMS and table not in BITS:
                return cls(table, first, None, Number(name, swapped=True))
        raise unknown_item(item, FORMS, FORM)

    @property
    def is_bit(self) -> bool:
        """True for a table of bits."""
        return self.table in BITS

    @property
    def width(self) -> int:
        """Number of addresses of one value."""
        return 1 if self.is_bit else self.number.registers

    def read(self) -> ReadBits | ReadRegisters:
        """Return the command that reads it."""
        count = self.width if self.count is None else self.count
        return (ReadBits if self.is_bit else ReadRegisters)(self.first, count, self.table)

    def decode(self, raw: Sequence[Any]) -> Any:
        """Return its value, or the tuple of a run."""
        if self.count is not None:
            return tuple(raw)
        return raw[0] if self.is_bit else self.number.decode(raw)

    def reads(self, count: int, most: int, item: str) -> list[ReadBits | ReadRegisters]:
        """Return the commands that read `count` values from here on, each `most` registers or bits at most.

        Raises InvalidCommand.
        """
        if self.count is not None:
            raise InvalidCommand(f"{item} is a run already: read {count} values from {self.table}:{self.first} on")
        kind = ReadBits if self.is_bit else ReadRegisters
        most = max(most - most % self.width, self.width)  # a number is never split: its words would be of two moments
        end = self.first + count * self.width
        return [kind(at, min(most, end - at), self.table) for at in range(self.first, end, most)]

    def decode_each(self, raw: Sequence[Any]) -> tuple[Any, ...]:
        """Return the values from the results of the commands of `reads`."""
        if self.is_bit:
            return tuple(raw)
        return tuple(self.number.decode(raw[at : at + self.width]) for at in range(0, len(raw), self.width))

    def write_at_once(self, value: Any, item: str) -> WriteCoils | WriteRegisters:
        """Return the one command that writes its value, or the values of a run. Raises InvalidCommand."""
        if self.count is not None and not isinstance(value, Iterable):
            raise InvalidCommand(f"{item} takes {self.count} values, not {value!r}")
        command, *further = self.write((value,) if self.count is None else tuple(value))
        if further:  # the first command alone would be confirmed although the other values are not written
            raise InvalidCommand(f"{item} takes more than one exchange to write: use the handle's write")
        return command

    def write(self, values: Sequence[Any]) -> list[WriteCoils | WriteRegisters]:
        """Return the commands that write the values from here on. Raises InvalidCommand."""
        if not values or (self.count is not None and len(values) != self.count):
            wanted = "a value" if self.count is None else f"{self.count} values"
            raise InvalidCommand(f"{self.table} {self.first} takes {wanted}, not {len(values)}")
        if self.is_bit:
            return [
                WriteCoils(self.first + i, tuple(values[i : i + MOST_BITS_WRITTEN]))
                for i in range(0, len(values), MOST_BITS_WRITTEN)
            ]
        words = [word for value in values for word in self.number.encode(value)]
        most = MOST_WRITTEN - MOST_WRITTEN % self.width  # a number is never split
        return [WriteRegisters(self.first + i, tuple(words[i : i + most])) for i in range(0, len(words), most)]


def is_whole(item: str) -> bool:
    """Return True if the values of an item are whole numbers."""
    return not Place.parse(item).number.kind.startswith("float")


def width_of(item: str) -> int:
    """Return the number of bits of an item; 0 for a run."""
    place = Place.parse(item)
    if place.count is not None:
        return 0
    return 1 if place.is_bit else 16 * place.number.registers


class ModbusUnit(Handle):
    """A Modbus unit, 1 to 247, or 0 to write to all. Addresses are those that are sent, 0 to 65535.

        press = ModbusUnit(bus, 17)
        speed = await press.read("holding:40:float32")
        await press.write("holding:100", 215)
        inputs = await press.read("discrete:0:16")

    An item is a table (`coil`, `discrete`, `holding`, `input`), an address, and an optional form. Without a form it is
    a bit or an unsigned register. A count means a run of them. A kind of number (`int16 uint16 int32 uint32 int64
    uint64 float32 float64`) has its most significant word first, or last with `:swapped`.

    Poll groups read neighbouring registers, or bits, in one exchange. `registers_per_read` and `bits_per_read` limit
    one reply, if the unit returns fewer than the 125 registers and 2000 bits of the standard; 1 merges nothing. They
    also limit the exchanges of `read` with a count. All handles of a unit have the same limits.
    """

    profile: ClassVar[Profile] = PROFILE

    def __init__(
        self,
        bus: NodeSource,
        address: int,
        *,
        registers_per_read: int | None = None,
        bits_per_read: int | None = None,
        timings: Timings | Learned | None = None,
        retries: int | None = None,
    ) -> None:
        profile = self.profile
        if registers_per_read is not None or bits_per_read is not None:
            registers = MOST_READ if registers_per_read is None else registers_per_read
            merge = Merging(registers, MOST_BITS_READ if bits_per_read is None else bits_per_read)
            profile = replace(profile, merge=merge)
        super().__init__(bus, address, timings=timings, retries=retries, profile=profile)

    def point(self, item: str) -> Point[Any]:
        """Return the point of an item. The point of a run has a tuple of values. Inputs are read-only.

        A point is written in one exchange: a run of more than 123 registers or 1968 coils only by `write`.
        """
        place = Place.parse(item)

        def encode(value: Any) -> WriteCoils | WriteRegisters:
            return place.write_at_once(value, item)

        return Point(
            self.node,
            item,
            place.read(),
            decode=place.decode,
            encode=encode if place.table in WRITABLE else None,
        )

    @classmethod
    def items(cls) -> tuple[str, ...]:
        return ()

    async def read(self, item: str, count: int | None = None, **options: Unpack[ReadOptions]) -> Any:
        """Return the value of an item; with `count`, a tuple of this many values from there on.

        More than 125 registers or 2000 bits take several exchanges, so their values are not all of one moment. No
        number is split. Raises Refused, with the exception's name, if the unit does not have the addresses.
        """
        if count is None:
            return await self.point(item).read(**options)
        place = Place.parse(item)
        raw = await read_each(self.node, place.reads(checked_count(count), self._most(place.table), item), options)
        return place.decode_each([one for part in raw for one in part])

    async def write(self, item: str, *values: float, **options: Unpack[WriteOptions]) -> None:
        """Write values from an item on, acknowledged. At address 0 all units are written, and none replies.

        More than 123 registers or 1968 coils take several exchanges: if one fails, those before it are stored.
        `verify` reads back, and raises VerifyFailed if a value differs. `idempotent` allows a retry after an unknown
        outcome. Raises InvalidCommand, before anything is sent, for a value that does not fit.
        """
        commands = self._writes(item, values, options)
        requests = SeveralRequests(self.node, options)
        for command in commands:
            await requests.request(command)
        for command in commands if requests.verify else ():
            await self._verify(requests, command)

    def _prepare_write(self, item: str, values: Sequence[Any], **options: Unpack[WriteOptions]) -> list[Send]:
        """Prepare to write consecutive addresses, in as few exchanges as possible."""
        self._writes(item, values, options)
        return [lambda: self.write(item, *values, **options)]

    def _most(self, table: str) -> int:
        """Return how many registers or bits of a table the unit returns in one reply."""
        merge = self.node.profile.merge
        return (merge if isinstance(merge, Merging) else Merging()).most(table)

    def _run_items(self, item: str, count: int) -> tuple[str, ...]:
        """Return the item of each value from an item on, each with its own address."""
        place = Place.parse(item)
        kind = "" if place.count is not None else item.partition(":")[2].partition(":")[2]
        suffix = f":{kind}" if kind else ""
        return tuple(f"{place.table}:{place.first + i * place.width}{suffix}" for i in range(count))

    def _writes(self, item: str, values: Sequence[Any], options: WriteOptions) -> list[WriteCoils | WriteRegisters]:
        place = Place.parse(item)
        if place.table not in WRITABLE:
            raise InvalidCommand(f"{self.node.label}: {item} is read-only")
        commands = place.write(values)
        self.node.check(*commands, stop=options.get("safe"))
        return commands

    async def _verify(self, requests: SeveralRequests, written: WriteCoils | WriteRegisters) -> None:
        count = len(written.values)
        check: ReadBits | ReadRegisters = (
            ReadBits(written.first, count) if isinstance(written, WriteCoils) else ReadRegisters(written.first, count)
        )
        found: tuple[int, ...] = await requests.read_back(check)
        for place, (now, wanted) in enumerate(zip(found, written.values, strict=True), written.first):
            if now != wanted:
                raise VerifyFailed(
                    f"{check.table} {place} reads {int(now)} after {int(wanted)} was written",
                    node=self.node,
                    command=str(check),
                )
