"""The base of all interfaces: one line that another program owns, followed over all disconnects.

An interface makes one `Following` and runs its `follow` beside its server. It reads `picture`, is called at each
change, and writes by `write`. docs/adding-an-interface.md describes how to make another interface.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from busmaster import BusError, InvalidCommand, LineDown, NotStarted
from busmaster.app.service.messages import value_of
from busmaster.app.service.picture import CURRENT, Picture, Row, old_after
from busmaster.app.service.remote import RemoteBus, connect
from busmaster.app.service.remote_overview import RemoteOverview

FIRST_PAUSE = 0.25
"""Seconds before it is tried again to connect; each time twice as long, up to `LONGEST_PAUSE`."""
LONGEST_PAUSE = 2.0

Receive = Callable[[str, Mapping[str, Any]], None]


@dataclass(frozen=True, slots=True)
class Connected:
    """The line is connected; `about` is the owner's description of it (`hello` in docs/service.md)."""

    about: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Lost:
    """The line's owner is not connected: the reason, and a hint."""

    why: str
    since: float = field(default_factory=time.time, compare=False)
    """In seconds since 1970."""


class Following:
    """A line that another program owns. `follow` connects, and connects again after each loss, until cancelled.

    `address` is called each time, because the owner may come back at another one. It returns the argument for
    `connect`, and raises BusError or InvalidCommand if no line is found. `read_only`: reject all writes, even if the
    owner permits them. `picture` is the state of the line; while the owner is disconnected it is the last one, and
    `state` is a `Lost`. `clean` prepares received values, see `Picture`.

    All of it belongs to one event loop. Times are of the line's clock, in seconds; `wall_time` converts them.
    """

    def __init__(
        self,
        address: Callable[[], str],
        *,
        token: str | None = None,
        read_only: bool = False,
        clean: Callable[[Any], Any] = value_of,
    ) -> None:
        self._clean = clean
        self.picture = Picture(clean)
        self.state: Connected | Lost = Lost("it was not connected yet")
        self._address = address
        self._token = token
        self._read_only = read_only
        self._listeners: list[Receive] = []
        self._watchers: list[Callable[[], None]] = []
        self._touch_listeners: list[Callable[[Mapping[str, Any]], None]] = []
        self._remote: RemoteBus | None = None
        self._overview: RemoteOverview | None = None

    # notifications for an interface

    def on_picture(self, receive: Receive) -> Callable[[], None]:
        """Call `receive` with the messages of the owner after `picture` has taken them. Returns what stops it.

        These are the messages of an overview: `rows`, `values`, `groups`, `nodes`, and then `frame`. `receive` must not
        block. If it raises, the connection ends.
        """
        self._listeners.append(receive)
        return lambda: self._listeners.remove(receive)

    def on_state(self, watch: Callable[[], None]) -> Callable[[], None]:
        """Call `watch` when `state` has changed; return the function to stop that. It must not block, nor raise."""
        self._watchers.append(watch)
        return lambda: self._watchers.remove(watch)

    def on_touched(self, receive: Callable[[Mapping[str, Any]], None]) -> Callable[[], None]:
        """Call `receive` with the values that a write has made stale, after `picture` has taken them.

        Returns the function to stop it.

        It is called before the write is confirmed. `Touches` takes the message. It must not block, nor raise.
        """
        self._touch_listeners.append(receive)
        return lambda: self._touch_listeners.remove(receive)

    @property
    def is_connected(self) -> bool:
        """Return whether the line's owner is connected, so that `picture` is the present state."""
        return isinstance(self.state, Connected)

    def is_current(self, row: Row) -> bool:
        """Return whether the value of a row is the present one.

        It is an old one if the owner is away, if the last read failed, and after a write to its place. It is also old
        if its group had no cycle for some time, because the group is paused or the owner is stopped.
        """
        if self._remote is None or row.asked is None or row.quality not in CURRENT:
            return False
        return not self.old_groups({row.group: row.asked}, self._remote.now())

    def old_groups(self, last_cycles: Mapping[str, float], now: float) -> set[str]:
        """Return the groups that had no cycle for some time: they are paused, or the owner is stopped.

        `last_cycles` has the time of the last cycle of each group. All times are on the clock of the line, in seconds.
        """
        ages = {group.name: group.old_after for group in self.picture.groups}
        unknown = old_after(0.0, 0.0)
        return {name for name, last in last_cycles.items() if now - last > ages.get(name, unknown)}

    @property
    def read_only(self) -> bool:
        """Return whether nothing can be written: by this interface's settings, its role, or the owner's."""
        frame = self.picture.frame
        by_role = isinstance(self.state, Connected) and bool(self.state.about["read_only"])
        return self._read_only or by_role or (frame is not None and frame.read_only)

    def wall_time(self, moment: float) -> float:
        """Return a time of the line's clock as seconds since 1970, by this machine's time of day.

        Raises LineDown while the owner is away.
        """
        return time.time() - (self.remote.now() - moment)

    # requests of an interface

    @property
    def remote(self) -> RemoteBus:
        """Return the line's bus, for all other requests of a client. Raises LineDown while the owner is away."""
        if self._remote is None:
            raise self._away(LineDown)
        return self._remote

    @property
    def overview(self) -> RemoteOverview:
        """Return the overview of the line, with its commands. Raises LineDown while the owner is away."""
        if self._overview is None:
            raise self._away(LineDown)
        return self._overview

    async def details(self, group: str, key: str) -> Mapping[str, Any]:
        """Return what there is to know of a point: limits, last exchange (`details` in docs/service.md).

        Raises LineDown while the owner is away, and InvalidCommand for a point that is gone.
        """
        return await self.overview.details(group, key)

    async def pause(self, group: str, paused: bool) -> None:
        """Have a poll group rest, or go on, for all who use the line. Raises as `details`."""
        await self.overview.pause(group, paused)

    async def demand(self, group: str) -> None:
        """Have a poll group read now. Raises as `details`."""
        await self.overview.demand(group)

    async def suspend(self, protocol: str, address: int, for_: float) -> None:
        """Let a node rest for so many seconds, 0 for no longer, for all who use the line. Raises as `details`."""
        await self.overview.suspend(protocol, address, for_)

    async def write(self, group: str, key: str, value: Any) -> None:
        """Write a point of a poll group, through the owner's authorisation: its roles, limits and record hold.

        Raises InvalidCommand if that, or this interface, does not allow it, NotStarted while the owner is away, and
        what `Point.write` raises; WriteUnconfirmed if the owner goes meanwhile. Nothing is written later, or again.
        """
        if self._read_only:
            raise InvalidCommand(f"{key} was not written: this interface is read-only")
        if self._overview is None:
            raise self._away(NotStarted)
        await self._overview.write(group, key, value)

    # following

    async def follow(self, *, patient: bool = True) -> None:
        """Follow the line until cancelled. Raises nothing of the line: what ends a connection is in `state`. If it is
        not `patient`, what keeps the first connection from being made is raised all the same.
        """
        pause = FIRST_PAUSE
        while True:
            try:
                # a thread, because it reads folders and may look up the address of a host
                address = await asyncio.to_thread(self._address)
                async with connect(address, token=self._token) as remote:
                    pause, patient = FIRST_PAUSE, True
                    await self._stay(remote)
            except (BusError, InvalidCommand) as error:
                if not patient:
                    raise
                self._change(Lost(str(error)))
            await asyncio.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE)

    async def _stay(self, remote: RemoteBus) -> None:
        """Handle the owner's messages until the connection ends."""
        self.picture = Picture(self._clean)
        try:
            self._remote = remote
            self._change(Connected(remote.about))
            remote.on_access.append(lambda: self._change(Connected(remote.about)))
            remote.on_touched.append(self._receive_touched)
            self._overview = await remote.overview(self._receive)
            await self._overview.over()
        finally:
            self._remote = self._overview = None

    def _receive(self, method: str, params: Mapping[str, Any]) -> None:
        self.picture.receive(method, params)
        for receive in list(self._listeners):
            receive(method, params)

    def _receive_touched(self, params: Mapping[str, Any]) -> None:
        self.picture.receive("touched", params)
        for receive in list(self._touch_listeners):
            receive(params)

    def _change(self, state: Connected | Lost) -> None:
        if isinstance(state, Lost):
            if isinstance(self.state, Lost):  # one loss, though another reason is known now
                state = replace(state, since=self.state.since)
            self.picture.lose(state.why)
        if state != self.state:
            self.state = state
            for watch in list(self._watchers):
                watch()

    def _away(self, kind: type[BusError]) -> BusError:
        why = self.state.why if isinstance(self.state, Lost) else "its program is being connected"
        return kind(f"the program that owns the line is not there: {why}", hint="")


__all__ = [
    "Connected",
    "Following",
    "Lost",
]
