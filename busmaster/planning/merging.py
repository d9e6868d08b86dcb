"""Selects the cheaper exchanges of a protocol that save line time.

Work that grows with the number of points is a generator. Each step yields the units it took, of about a microsecond, so
that the caller can let the line continue in between.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias, TypeVar

from busmaster.contract.exchange import Command
from busmaster.contract.profile import Batch

T = TypeVar("T")

WEIGHING = 10
"""Units of work for evaluating one exchange."""
Merge: TypeAlias = Callable[[Sequence[Command[Any]]], Sequence[Batch]]
"""Proposes batches for commands of one node: `Profile.merge`, or an option of a poll group."""


class Served(NamedTuple):
    """One exchange, and the indexes of the commands that it replaces.

    A `batch` returns a sequence of their values, and saves this many seconds of line time compared with single
    commands.
    """

    command: Command[Any]
    serves: tuple[int, ...]
    batch: bool = False
    saved: float = 0.0


def cheapest(
    commands: Sequence[Command[Any]], merges: Iterable[Merge], cost: Callable[[Command[Any]], float]
) -> Generator[int, None, list[Served]]:
    """Choose the exchanges for these commands of one node, merged if that saves line time.

    `cost`: line time of one command, in seconds. The largest saving is used first and each command is served once. The
    exchanges are in the order of the first command that each serves.
    """
    offers: list[Batch] = []
    for merge in merges:
        offers += merge(commands)
        yield len(commands)
    single = []
    for command in commands if offers else ():
        single.append(cost(command))
        yield WEIGHING
    weighed = []
    for batch in offers:
        saved = sum(single[i] for i in batch.serves) - cost(batch.command)
        weighed.append(Served(batch.command, batch.serves, True, saved))
        yield WEIGHING
    yield len(commands)
    left = set(range(len(commands)))
    chosen: list[Served] = []
    for served in sorted(weighed, key=lambda served: -served.saved):
        if served.saved > 0 and left.issuperset(served.serves):
            left.difference_update(served.serves)
            chosen.append(served)
    chosen += (Served(commands[index], (index,)) for index in left)
    return sorted(chosen, key=lambda served: min(served.serves))


def without_refused(merge: Merge, refused: Collection[Command[Any]]) -> Merge:
    """Return the merge without refused commands, and with the halves of a divisible one in its place.

    One refused item in a range of n is so separated from the others in about log2(n) further refusals.
    """
    if not refused:
        return merge

    def sound(commands: Sequence[Command[Any]]) -> list[Batch]:
        batches: list[Batch] = []
        for batch in merge(commands):
            if batch.command not in refused:
                batches.append(batch)
            elif batch.divisible:
                middle = len(batch.serves) // 2
                for half in (batch.serves[:middle], batch.serves[middle:]):
                    # One command alone is read as it is.
                    parts = sound([commands[index] for index in half]) if len(half) > 1 else ()
                    batches += (replace(part, serves=tuple(half[i] for i in part.serves)) for part in parts)
        return batches

    return sound


def at_once(steps: Generator[int, None, T]) -> T:
    """Run all steps of a generator, and return its result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: T = end.value
            return result
