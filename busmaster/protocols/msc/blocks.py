"""Transfers of many MSC values: which exchanges they take, how far they are, and runs of values as points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, NoReturn

from busmaster.errors import InvalidCommand
from busmaster.exchange import Timings
from busmaster.points import Point
from busmaster.protocols.msc.codec import BLOCK, HIGHEST_ADDRESS, BlockRead, BlockWrite, DataRead, DataWrite

if TYPE_CHECKING:
    from busmaster.node import Priority
    from busmaster.protocols.msc.handle import MscController

Progress = Callable[[int, int], None]
"""Called with how many values are done, of how many."""


def place(address: int, index: int, step: int | None) -> int:
    """The address of the value `index` places behind the one at `address`.

    Raises InvalidCommand for one that does not exist, and while the address step is unknown.
    """
    if not index:
        return address
    if step is None:
        raise InvalidCommand(
            f"while the address step is unknown, {BLOCK} values at most can be read, and one or {BLOCK} written: "
            "give address_step (--address-step), or call find_address_step"
        )
    return DataRead(address + index * step).address


class Part(NamedTuple):
    """One exchange of a transfer: the first `size` values that `command` reads, from the address `at` on."""

    command: BlockRead | DataRead
    at: int
    size: int


def reads(address: int, count: int, step: int | None) -> list[Part]:
    """The exchanges that read `count` values."""
    if not 1 <= count <= HIGHEST_ADDRESS:
        raise InvalidCommand(f"there are not {count} values to read")
    if step is not None:
        place(address, count - 1, step)
    starts = ((place(address, i, step), min(BLOCK, count - i)) for i in range(0, count, BLOCK))
    return [Part(BlockRead(at) if size > 1 else DataRead(at), at, size) for at, size in starts]


def reads_back(address: int, count: int, step: int | None) -> list[Part]:
    """The same for values just written, in blocks that begin one value later than `writes` has them.

    Where the address step is wrong, the blocks written lie apart or over each other, and only blocks that span two
    of them show it.
    """
    if step is None or count == 1:
        return reads(address, count, step)
    return [*reads(address, 1, step), *reads(place(address, 1, step), count - 1, step)]


def writes(address: int, values: Sequence[int], step: int | None) -> list[tuple[BlockWrite | DataWrite, int]]:
    """The exchanges that write `values`, and how many each holds: whole blocks, and the rest one by one."""
    if not values:
        raise InvalidCommand("there is no value to write")
    whole = len(values) - len(values) % BLOCK
    blocks = (BlockWrite(place(address, i, step), tuple(values[i : i + BLOCK])) for i in range(0, whole, BLOCK))
    singles = (DataWrite(place(address, i, step), values[i]) for i in range(whole, len(values)))
    return [*((block, BLOCK) for block in blocks), *((single, 1) for single in singles)]


class Count:
    """Tells `progress` how far a transfer of `total` values is."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress = progress
        self._total = total
        self._done = 0

    def add(self, values: int) -> None:
        self._done += values
        if self._progress is not None:
            self._progress(self._done, self._total)


@dataclass(frozen=True, slots=True)
class LongRun:
    """Stands for a run of more than one block, which is more than one exchange and cannot be polled."""

    address: int
    count: int

    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __str__(self) -> str:
        return f"read {self.count} values from data {self.address}"

    def open(self, address: int, timings: Timings, /) -> NoReturn:
        raise InvalidCommand(f"a point that is polled has at most {BLOCK} values, not {self.count}: poll several")


@dataclass(frozen=True, slots=True, kw_only=True)
class Run(Point[tuple[int, ...]]):
    """Consecutive values as one point, of any length. One block of 32 at most can be polled."""

    handle: MscController = field(compare=False)
    address: int
    count: int

    @classmethod
    def of(cls, handle: MscController, item: str, address: int, count: int) -> Run:
        """Raises InvalidCommand for more than one block while the address step is unknown."""
        reads(address, count, handle.address_step)
        command = BlockRead(address) if count <= BLOCK else LongRun(address, count)
        return cls(
            node=handle.node,
            item=item,
            command=command,
            decode=lambda block: block[:count],
            handle=handle,
            address=address,
            count=count,
        )

    @property
    def writable(self) -> bool:
        return True

    async def read(self, *, max_age: float | None = None, **options: Any) -> tuple[int, ...]:
        """As `Point.read`; `MscController.read_block` where it is longer than a block."""
        if self.count <= BLOCK:
            return await Point.read(self, max_age=max_age, **options)
        return await self.handle.read_block(self.address, self.count, **options)

    async def write(self, value: Sequence[int], *, priority: Priority | None = None, **options: Any) -> None:
        """As `MscController.write_block`. Raises InvalidCommand unless there are as many values as in the run."""
        if len(value) != self.count:
            raise InvalidCommand(f"{self.node.label}: {self.item} takes {self.count} values, not {len(value)}")
        await self.handle.write_block(self.address, value, priority=priority, **options)
