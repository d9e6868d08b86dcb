"""The requests of a program on another's line: a limited number at a time, some of them in a sequence."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, Protocol, TypeVar, Unpack

from busmaster import NotStarted
from busmaster.app.bounds import MOST_UNDER_WAY
from busmaster.app.service.client_messages import HoldParams, SequenceParams
from busmaster.app.service.link import Link
from busmaster.ext import Command, CommandOptions, HeldNode, Requester, RequestOptions

T = TypeVar("T")


class RequestLimit:
    """Limits the number of a program's requests in progress. Others wait here in their order, within their limits."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._free = MOST_UNDER_WAY
        self._waiting: deque[asyncio.Future[None]] = deque()
        self._now = now

    def take(self) -> bool:
        """Take a place, which must be given back, if there is one; return whether there was."""
        if not self._free:
            return False
        self._free -= 1
        return True

    async def wait(self, options: RequestOptions, node: Requester, command: Command[Any]) -> float:
        """Wait for a place, which must be given back, and return the seconds that it took.

        Raises NotStarted if the time of the request is over before.
        """
        began = self._now()
        limits = [limit for limit in (options.start_within, options.finish_within) if limit is not None]
        try:
            async with asyncio.timeout(min(limits, default=None)):
                await self._given()
        except TimeoutError:
            what = f"the time of the request is over, and {MOST_UNDER_WAY} requests of this program have no reply yet"
            raise NotStarted(what, node=node, command=str(command)) from None
        return self._now() - began

    def give_back(self) -> None:
        """Give back a place, to the request that has waited longest."""
        while self._waiting:
            given = self._waiting.popleft()
            if not given.done():
                given.set_result(None)
                return
        self._free += 1

    async def _given(self) -> None:
        given = asyncio.get_running_loop().create_future()
        self._waiting.append(given)
        try:
            await given
        except asyncio.CancelledError:
            if given.done() and not given.cancelled():  # the place was given in the turn of the cancellation
                self.give_back()
            raise


class AsksInSequence(Requester, Protocol):
    """A node of a line that another program owns."""

    async def ask(
        self,
        command: Command[T],
        sequence: int,
        touches: Command[Any] | None,
        stops_seen: int | None,
        stop: bool,
        options: CommandOptions,
        /,
    ) -> T:
        """Run one command within a sequence."""
        ...


class HoldsLine(Protocol):
    """A line that another program owns."""

    @property
    def link(self) -> Link: ...

    def new_sequence(self) -> int:
        """Return the number of one more sequence."""
        ...


@asynccontextmanager
async def held_remotely(node: AsksInSequence, bus: HoldsLine, longest: float) -> AsyncIterator[Requester]:
    """Have the owner of a line hold it for one sequence, `longest` seconds at most, and yield the node for it."""
    sequence, link = bus.new_sequence(), bus.link
    link.notify("hold", HoldParams(sequence, node.profile.name, node.address, longest))
    try:
        yield _HeldRemoteNode(node, sequence)
    finally:
        link.notify("release", SequenceParams(sequence))


class _HeldRemoteNode(HeldNode):
    """A node of a line that another program owns, within one sequence."""

    def __init__(self, asks: AsksInSequence, sequence: int) -> None:
        super().__init__(asks)
        self._asks = asks
        self._sequence = sequence

    async def request(
        self,
        command: Command[T],
        /,
        *,
        touches: Command[Any] | None = None,
        stops_seen: int | None = None,
        stop: bool = False,
        **options: Unpack[CommandOptions],
    ) -> T:
        """Run one command within the sequence, see `HeldNode.request`."""
        return await self._asks.ask(command, self._sequence, touches, stops_seen, stop, options)
