"""What a program can use of a bus, whether this process or another one owns its line."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable, Sequence
from typing import Any, Protocol, TypeVar

from busmaster.arbiter.counters import LineStatistics
from busmaster.arbiter.transaction import Priority
from busmaster.bus.alarms import BusEvent
from busmaster.bus.points import Point
from busmaster.bus.requester import Requester
from busmaster.bus.samples import Sample
from busmaster.bus.snapshots import Snapshot, Stream
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import InvalidCommand
from busmaster.planning import Plan, PlannedGroup

__all__ = ["BusLike", "GroupLike"]

T = TypeVar("T")


class GroupLike(Protocol):
    """A poll group of a `BusLike`: iterate it for a snapshot per cycle, or look at `latest`."""

    @property
    def name(self) -> str:
        """Return its name, which no other group of the program has."""
        ...

    @property
    def period(self) -> float:
        """Return the seconds from one cycle to the next."""
        ...

    @property
    def points(self) -> tuple[Point[Any], ...]:
        """Return the points that a cycle reads, in their order."""
        ...

    @property
    def latest(self) -> Snapshot | None:
        """Return the snapshot of the last cycle, None before the first."""
        ...

    def subscribe(self, buffer: int = 16) -> Stream[Snapshot]:
        """Return a consumer that buffers this many snapshots. Close it when it is no longer used."""
        ...

    def close(self) -> None:
        """End the group; its consumers end after the snapshots that they hold."""
        ...

    def __aiter__(self) -> AsyncIterator[Snapshot]: ...


class BusLike(Protocol):
    """The interface that `Bus` and `RemoteBus` share: a program that takes a `BusLike` runs on both unchanged.

    Handles accept one, too. Each coroutine is a request to the line's owner on a `RemoteBus`. On a `Bus` it ends at
    once, or calculates. docs/service.md has a table of the remaining differences.
    """

    def node(
        self, profile: Profile, address: int, /, *, timings: Timings | Learned | None = None, retries: int | None = None
    ) -> Requester:
        """Return the node at this address. Raises InvalidCommand."""
        ...

    @property
    def nodes(self) -> Sequence[Requester]:
        """Return the nodes of the line."""
        ...

    @property
    def groups(self) -> Sequence[GroupLike]:
        """Return the poll groups of the line."""
        ...

    def group(self, name: str) -> GroupLike:
        """Return a poll group by its name. Raises InvalidCommand, with the names that exist, for another one."""
        ...

    def poll_group(
        self,
        name: str,
        *,
        period: float,
        points: Iterable[Point[Any]],
        phase: float | None = None,
        priority: Priority = Priority.POLL,
    ) -> GroupLike:
        """Read `points` every `period` seconds from now on, as `Bus.poll_group` does. Raises InvalidCommand."""
        ...

    def latest(self, point: Point[T]) -> Sample[T] | None:
        """Return the newest good sample of a point, unless a write has made it stale."""
        ...

    def now(self) -> float:
        """Return the time of the line's clock, in seconds."""
        ...

    def events(self) -> Stream[BusEvent]:
        """Return a stream of the events of the line and its nodes from now on."""
        ...

    async def plan(self, *more: PlannedGroup) -> Plan:
        """Calculate the load of the running groups and of `more`, with the reply times measured so far."""
        ...

    async def statistics(self) -> LineStatistics:
        """Return an immutable snapshot of the line's counters."""
        ...


G = TypeVar("G", bound=GroupLike)


def find_group(groups: Iterable[G], name: str) -> G:
    """Return the poll group of this name. Raises InvalidCommand, with the names that exist, if there is none."""
    known = {group.name: group for group in groups}
    if name not in known:
        raise InvalidCommand(f"no poll group {name!r}; there are: {', '.join(known) or 'none'}")
    return known[name]
