"""A poll group of a line that another program owns: cycles as its owner sends them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from busmaster import BusError, InvalidCommand, Point, Snapshot
from busmaster.app.service.encoding import FindNode, owners_point_of, snapshot_of
from busmaster.app.service.owner_messages import NoBody, PointsBody, SnapshotBody, StreamMessage
from busmaster.events import Stream
from busmaster.ext import Cycles


class RemoteGroup(Cycles):
    """A poll group of a line that another program owns, of `RemoteBus.poll_group`, `group` or `groups`.

    Iterate it, or look at `latest`; close it when it is not read any more. The request to the owner is sent without
    waiting: if the owner refuses it, for example because of too many groups, iterating it raises that, and `ready`.
    """

    def __init__(
        self,
        name: str,
        points: tuple[Point[Any], ...],
        *,
        period: float,
        find: FindNode,
        begin: Callable[[RemoteGroup], tuple[int, asyncio.Task[None]]],
        end: Callable[[int], None],
    ) -> None:
        super().__init__(name)
        self.period = period
        self.owners_name = name
        """How the line's owner calls it: a program's own group has the program's name behind its own."""
        self.dropped = 0
        """Cycles that this program was too slow for, counted by the line's owner."""
        self._find = find
        self._begin_stream = begin
        self._end_stream = end
        self._own = points
        self._points = points
        self._set: int | None = None
        self._stream: int | None = None
        self._opening: asyncio.Task[None] | None = None

    @property
    def own(self) -> bool:
        """Return whether this program made it: its values are then what this program's points decode."""
        return bool(self._own)

    @property
    def points(self) -> tuple[Point[Any], ...]:
        """Return the points that a cycle reads; of a group of the owner, none before the owner has sent them."""
        return self._points

    @property
    def over(self) -> bool:
        """Return whether no more cycles come: it is closed, the owner has ended it, or it could not begin."""
        return self._over

    @property
    def is_opening(self) -> bool:
        """Return whether the owner has not answered yet."""
        return self._opening is not None and not self._opening.done()

    def begin(self) -> None:
        """Have the owner send its cycles, if it does not yet."""
        if self._stream is None and not self._over:
            self._stream, self._opening = self._begin_stream(self)

    async def ready(self) -> None:
        """Wait until the owner has accepted it. Raises what the owner has against it, or LineDown."""
        self.begin()
        if self._opening is not None:
            await asyncio.wait([self._opening])
        if self._cause is not None:
            raise self._cause

    def subscribe(self, buffer: int = 16, *, changes: bool = False) -> Stream[Snapshot]:
        """Return a consumer with a buffer of so many snapshots. Close it when it is not read any more.

        With `changes` it is the same: between two cycles, the owner sends the whole last cycle with the new values.
        """
        consumer = super().subscribe(buffer, changes=changes)
        self.begin()
        return consumer

    def close(self) -> None:
        """Read it no more; one that this program made ends."""
        if self._over:
            return
        if self._opening is not None:
            self._opening.cancel()
        if self._stream is not None:
            self._end_stream(self._stream)
        self.end()

    def receive(self, method: str, message: StreamMessage[Any]) -> None:
        """Handle a message of the line's owner about the group."""
        for consumer in self._consumers:
            consumer.dropped += message.dropped - self.dropped
        self.dropped = message.dropped
        match message.body:
            case PointsBody() as body:
                self._set = body.set
                # By its own points, a program gets the values that they decode.
                if not self._own:
                    self._take_points(body)
            case SnapshotBody() as body if body.set == self._set:
                self._publish(snapshot_of(body, self.name, self._points))
            case NoBody():
                self.close()

    def _take_points(self, body: PointsBody) -> None:
        """Use the owner's points. One of a protocol that is not installed here ends the group, and nothing else."""
        try:
            self._points = tuple(owners_point_of(form, self._find) for form in body.points)
        except InvalidCommand as error:
            self.end(error)
            if self._stream is not None:
                self._end_stream(self._stream)

    def end(self, cause: BusError | InvalidCommand | None = None) -> None:
        """End its consumers after the snapshots that they hold, with an error if that is the cause."""
        self._end(cause)
