"""Transfers of many values: their exchanges, and their progress."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from busmaster.errors import InvalidCommand
from busmaster.protocols.msc.codec import BLOCK, HIGHEST_ADDRESS, BlockRead, BlockWrite, DataRead, DataWrite

Progress = Callable[[int, int], None]
"""Called with the number of transferred values, and their total."""


def place(address: int, index: int, step: int | None) -> int:
    """Return the address of the value `index` places after the one at `address`.

    Raises InvalidCommand if it does not exist, and if the address step is unknown.
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
    """Return the exchanges that read `count` values."""
    if not 1 <= count <= HIGHEST_ADDRESS:
        raise InvalidCommand(f"there are not {count} values to read")
    if step is not None:
        place(address, count - 1, step)
    starts = ((place(address, i, step), min(BLOCK, count - i)) for i in range(0, count, BLOCK))
    return [Part(BlockRead(at) if size > 1 else DataRead(at), at, size) for at, size in starts]


def reads_back(address: int, count: int, step: int | None) -> list[Part]:
    """Return the exchanges that read values back, in blocks that begin one value later than those of `writes`.

    If the address step is wrong, the written blocks have gaps or overlap. Only blocks that span two of them show it.
    """
    if step is None or count == 1:
        return reads(address, count, step)
    return [*reads(address, 1, step), *reads(place(address, 1, step), count - 1, step)]


def writes(address: int, values: Sequence[int], step: int | None) -> list[tuple[BlockWrite | DataWrite, int]]:
    """Return the exchanges that write `values`, each with its number of values: whole blocks, then single values."""
    if not values:
        raise InvalidCommand("there is no value to write")
    whole = len(values) - len(values) % BLOCK
    blocks = (BlockWrite(place(address, i, step), tuple(values[i : i + BLOCK])) for i in range(0, whole, BLOCK))
    singles = (DataWrite(place(address, i, step), values[i]) for i in range(whole, len(values)))
    return [*((block, BLOCK) for block in blocks), *((single, 1) for single in singles)]


class Count:
    """Reports the progress of a transfer of `total` values."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress = progress
        self._total = total
        self._done = 0

    def add(self, values: int) -> None:
        """Report that this many more values were transferred."""
        self._done += values
        if self._progress is not None:
            self._progress(self._done, self._total)
