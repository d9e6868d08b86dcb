"""Cheaper exchanges: which of those that a protocol proposes are worth their line time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias

from busmaster.exchange import Command
from busmaster.profile import Batch

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
) -> list[Served]:
    """The exchanges that serve all these commands of one node, merged where that saves line time.

    `cost` is the line time of one command, in seconds. The greatest saving is taken first, each command is served
    once, and the exchanges are in the order of the first command that each serves.
    """
    offers = [batch for merge in merges for batch in merge(commands)]
    single = [cost(command) for command in commands] if offers else []
    weighed = [
        Served(batch.command, batch.serves, True, sum(single[i] for i in batch.serves) - cost(batch.command))
        for batch in offers
    ]
    left = set(range(len(commands)))
    chosen: list[Served] = []
    for served in sorted(weighed, key=lambda served: -served.saved):
        if served.saved > 0 and left.issuperset(served.serves):
            left.difference_update(served.serves)
            chosen.append(served)
    chosen += (Served(commands[index], (index,)) for index in left)
    return sorted(chosen, key=lambda served: min(served.serves))
