"""What poll groups were answered last: for points that no group reads under their name, or not by themselves."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from typing import Any, NamedTuple

from busmaster.bus.points import Point
from busmaster.bus.requester import Requester
from busmaster.contract.exchange import Command
from busmaster.contract.places import Changing, Placed, Telling
from busmaster.contract.profile import Profile


class Answer(NamedTuple):
    """What one exchange of a cycle brought, asked for at `started` by the bus's clock.

    `serves` are the points that it is for, each with its place in the value of a batch (None: all of it).
    """

    node: Requester
    command: Command[Any]
    serves: Iterable[tuple[Point[Any], int | None]]
    value: Any
    started: float

    def found(self, command: Command[Any]) -> list[Any]:
        """Return what this command would have returned, alone in a list; an empty one where it was not asked."""
        places = (place for point, place in self.serves if point.command == command)
        return [self.value if place is None else self.value[place] for place in places][:1]


def composed(command: Command[Any], answers: Iterable[Answer], profile: Profile) -> list[Any]:
    """Return what a command would return by what answers, the youngest last, told of each of its places.

    Of a write it is what it changes. It is alone in a list, which is empty where they did not tell all of it.
    """
    held: dict[Hashable, Any] = {}
    for answer in answers:
        if isinstance(answer.command, Telling):
            held |= answer.command.told(answer.value, profile)
    try:
        if isinstance(command, Placed):
            return [command.shown(held)]
        if isinstance(command, Changing):
            changed = tuple(held[place] for place in command.changes(profile))
            return [changed[0] if len(changed) == 1 else changed]
    except KeyError:
        pass
    return []
