"""The cycles of the poll groups of another program's line, for an interface that needs each of them."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Set
from contextlib import suppress

from busmaster import BusError, InvalidCommand, Snapshot
from busmaster.app.interfaces.following import Following
from busmaster.app.service.remote import RemoteBus

ASK_AGAIN = 1.0
"""Seconds after which a poll group is requested again that has ended."""


class FollowedGroups:
    """Follows poll groups, and calls `take` with each cycle and the name of its group.

    A `picture` comes five times a second, and has only the values of that time.
    """

    def __init__(self, line: Following, take: Callable[[str, Snapshot], Awaitable[None]]) -> None:
        self.dropped: dict[str, int] = {}
        """Cycles of each group that were dropped, because `take` was too slow."""
        self._line = line
        self._take = take
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._last_cycles: dict[str, float] = {}
        """When the last cycle of each group ended, by the line's clock."""

    async def follow(self, remote: RemoteBus, names: Set[str]) -> None:
        """Follow these groups of a connection, and no others. A group that ends is requested again."""
        await self.leave(names)
        for name in names - self._tasks.keys():
            self._last_cycles[name] = remote.now()
            self._tasks[name] = asyncio.ensure_future(self._follow(remote, name))

    def old(self, now: float) -> set[str]:
        """Return the groups that had no cycle for some time: they are paused, or the owner is stopped."""
        return self._line.old_groups(self._last_cycles, now)

    async def leave(self, wanted: Set[str] = frozenset()) -> None:
        """Follow no groups but the wanted ones."""
        for name in self._tasks.keys() - wanted:
            task = self._tasks.pop(name)
            self._last_cycles.pop(name, None)
            self.dropped.pop(name, None)
            task.cancel()
            await asyncio.wait([task])

    async def _follow(self, remote: RemoteBus, name: str) -> None:
        while True:
            with suppress(BusError, InvalidCommand):  # values without a cycle become old by their age
                group = remote.group(name)
                try:
                    async for snapshot in group:
                        self._last_cycles[name] = snapshot.finished
                        await self._take(name, snapshot)
                        self.dropped[name] = group.dropped
                finally:
                    group.close()
            await asyncio.sleep(ASK_AGAIN)


__all__ = [
    "FollowedGroups",
]
