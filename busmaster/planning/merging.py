"""Cheaper exchanges: which of those that a protocol proposes are worth their line time.

Work that grows with the points of a line is a generator: each step yields how many units it took, of about a
microsecond, and whoever runs it lets the line go on between.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias, TypeVar

from busmaster.contract.exchange import Command
from busmaster.contract.profile import Batch

T = TypeVar("T")

WEIGHING = 10
"""Units of work that it takes to weigh one exchange."""
Merge: TypeAlias = Callable[[Sequence[Command[Any]]], Sequence[Batch]]
"""Proposes batches for commands of one node: `Profile.merge`, or what a poll group opts in to."""


class Served(NamedTuple):
    """One exchange, and the indexes of the commands that it stands for.

    A `batch` brings a sequence of their values, and saves so many seconds of the line compared with single commands.
    """

    command: Command[Any]
    serves: tuple[int, ...]
    batch: bool = False
    saved: float = 0.0


def cheapest(
    commands: Sequence[Command[Any]], merges: Iterable[Merge], cost: Callable[[Command[Any]], float]
) -> Generator[int, None, list[Served]]:
    """Choose the exchanges that serve all these commands of one node, merged where that saves line time.

    `cost` is the line time of one command, in seconds. The greatest saving is taken first, each command is served
    once, and the exchanges are in the order of the first command that each serves.
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


def at_once(steps: Generator[int, None, T]) -> T:
    """Do all steps of a piece of work, and return what comes of it."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: T = end.value
            return result
