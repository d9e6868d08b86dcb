"""The events of a line for the clients that follow them. Each message is encoded once for all clients."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncGenerator, Callable, Sequence
from typing import Any, Protocol

from busmaster import Bus, Point, PollGroup, Snapshot
from busmaster.app.service.encoding import encode_event, encode_points, encode_sample, encode_snapshot
from busmaster.app.service.messages import encode
from busmaster.app.service.owner_messages import PointsBody
from busmaster.app.service.typed import Raw
from busmaster.ext import Outdated, ReadAfterWrite

READERS_IN_A_TURN = 4
SAMPLES_IN_A_TURN = 50
"""A tenth or two of a millisecond of a turn of the line's loop is taken for them."""


class Reader(Protocol):
    """A client with a stream."""

    def notify(self, stream: int, method: str, body: Raw) -> None:
        """Send a message of a stream; it is dropped if the client does not keep up."""
        ...

    def notify_surely(self, stream: int, method: str, body: Raw, part: int = 0) -> None:
        """Send a message about a part of a stream, which replaces an earlier unsent one."""
        ...


Place = tuple[Reader, int]
"""A client, and the number of the stream there."""


class Broadcast:
    """One source and its readers. It runs while there are readers, and then calls `on_end`."""

    def __init__(self, on_end: Callable[[], None]) -> None:
        self.readers: list[Place] = []
        self._on_end = on_end
        self._task: asyncio.Task[None] | None = None

    def join(self, reader: Reader, stream: int) -> None:
        """Add a client."""
        self.readers.append((reader, stream))
        if self._task is None:
            self._task = asyncio.ensure_future(self._run())

    def leave(self, reader: Reader, stream: int) -> None:
        """Remove a client."""
        if (reader, stream) in self.readers:
            self.readers.remove((reader, stream))
        # One that has ended has called `on_end` already: since then, another one may run for the same source.
        if not self.readers and self._task is not None and not self._task.done():
            self._task.cancel()
            self._on_end()

    async def _run(self) -> None:
        try:
            await self._notify()
        except Exception:  # a value that cannot be encoded, an error of an encoder: the readers get "ended"
            logging.getLogger("busmaster.app.service").exception("a stream ended")
        self._on_end()
        for reader, stream in self.readers:
            reader.notify_surely(stream, "ended", Raw(b"{}"))

    async def _notify(self) -> None:
        async with contextlib.aclosing(self._bodies()) as bodies:
            async for method, body in bodies:
                async for reader, stream in self._in_turns(tuple(self.readers)):
                    reader.notify(stream, method, body)

    async def _in_turns(self, places: Sequence[Place]) -> AsyncGenerator[Place, None]:
        """Yield those of the places that have not left, a few in one turn of the line's loop."""
        for number, place in enumerate(places):
            if number and number % READERS_IN_A_TURN == 0:
                await asyncio.sleep(0)
            if place in self.readers:
                yield place

    def _bodies(self) -> AsyncGenerator[tuple[str, Raw], None]:
        raise NotImplementedError


class GroupBroadcast(Broadcast):
    """The cycles of one poll group."""

    def __init__(self, group: PollGroup, on_end: Callable[[], None]) -> None:
        super().__init__(on_end)
        self.group = group
        self._points: tuple[Point[Any], ...] = group.points
        self._set = 0

    def join(self, reader: Reader, stream: int) -> None:
        """Send the list of points to this client, and then each cycle."""
        self._send_points((reader, stream))
        super().join(reader, stream)

    def _send_points(self, *places: Place) -> None:
        body = Raw(encode(PointsBody(self._set, encode_points(self._points))))
        for reader, stream in places:
            reader.notify_surely(stream, "points", body)

    async def _bodies(self) -> AsyncGenerator[tuple[str, Raw], None]:
        stream = self.group.subscribe(changes=True)
        try:
            async for snapshot in stream:
                if isinstance(snapshot, Outdated):
                    continue  # `touched` reports it, and sooner
                if isinstance(snapshot, ReadAfterWrite) and self.group.latest is not None:
                    snapshot = self.group.latest  # the wire has whole cycles: the last one, with the new value
                points = tuple(snapshot)
                if points != self._points:
                    self._points = points
                    self._set += 1
                    self._send_points(*self.readers)
                yield "snapshot", await self._encode(snapshot)
        finally:
            stream.close()

    async def _encode(self, snapshot: Snapshot) -> Raw:
        """Return a cycle as JSON; of a long one, some samples are encoded in a turn of the loop."""
        samples: list[Raw] = []
        for number, sample in enumerate(snapshot.samples.values()):
            if number and number % SAMPLES_IN_A_TURN == 0:
                await asyncio.sleep(0)
            samples.append(Raw(encode(encode_sample(sample))))
        return Raw(encode(encode_snapshot(snapshot, self._set, samples)))


class EventBroadcast(Broadcast):
    """What happens to line and nodes."""

    def __init__(self, bus: Bus, on_end: Callable[[], None]) -> None:
        super().__init__(on_end)
        self._bus = bus

    async def _bodies(self) -> AsyncGenerator[tuple[str, Raw], None]:
        stream = self._bus.events()
        try:
            async for event in stream:
                if form := encode_event(event):
                    yield "event", Raw(encode(form))
        finally:
            stream.close()
