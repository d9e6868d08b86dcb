"""Replies of the last poll cycles, for points that no group reads under their name or separately."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from typing import Any, NamedTuple

from busmaster.bus.points import Point
from busmaster.bus.requester import Requester
from busmaster.contract.exchange import Command
from busmaster.contract.places import Changing, Placed, ReadsPlaces
from busmaster.contract.profile import Profile


class Answer(NamedTuple):
    """The result of one exchange of a cycle, sent at `started` on the bus's clock.

    `serves`: its points, each with its place in the value of a batch (None: the whole value).
    """

    node: Requester
    command: Command[Any]
    serves: Iterable[tuple[Point[Any], int | None]]
    value: Any
    started: float

    def found(self, command: Command[Any]) -> list[Any]:
        """Return the result of this command in a list, which is empty if the exchange did not contain it."""
        places = (place for point, place in self.serves if point.command == command)
        return [self.value if place is None else self.value[place] for place in places][:1]


def composed(command: Command[Any], answers: Iterable[Answer], profile: Profile) -> list[Any]:
    """Return the result of a command composed from replies, the newest last, by the places they contain.

    For a write, the places it changes. The result is in a list, which is empty if the replies do not contain all
    places.
    """
    held: dict[Hashable, Any] = {}
    for answer in answers:
        if isinstance(answer.command, ReadsPlaces):
            held |= answer.command.place_values(answer.value, profile)
    try:
        if isinstance(command, Placed):
            return [command.shown(held)]
        if isinstance(command, Changing):
            changed = tuple(held[place] for place in command.changes(profile))
            return [changed[0] if len(changed) == 1 else changed]
    # Some place was not read, or was written since: then nothing is known.
    except KeyError:
        pass
    return []
