"""A bus without a line: nodes answer commands from a table, so that handles can be watched request by request."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any, Unpack

import anyio.lowlevel

from busmaster.bus.limits import Limit
from busmaster.bus.requester import CommandOptions, Priority
from busmaster.contract.exchange import Command
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import Superseded
from busmaster.planning.merging import Merge

Answer = Callable[[Command[Any]], Any]


class FakeNode:
    """Every command goes to the bus's `answer`, which returns its value or raises; `log` keeps what was asked."""

    def __init__(self, bus: FakeBus, profile: Profile, address: int) -> None:
        self.bus = bus
        self.profile = profile
        self.address = address
        self.line = "a fake line"
        self.label = profile.label(address)
        self.stops = 0

    def note_stop(self) -> None:
        self.stops += 1

    def now(self) -> float:
        return self.bus.now()

    def latest(self, point: object, /) -> None:
        """Nothing is polled."""

    def merge_reads(self, merge: Merge) -> None:
        self.profile = replace(self.profile, merge=merge)

    def use_sync_reads(self, probe: Command[Any] | None, sync_reads: Sequence[Command[Any]], /) -> None:
        """Nothing is probed."""

    def limit(self, limit: Limit) -> None:
        """Nothing is limited."""

    def check(self, *commands: Command[Any], stop: bool | None = None) -> None:
        """Nothing is limited."""

    @asynccontextmanager
    async def exclusive(self, *, max_hold: float = 0.5) -> AsyncIterator[FakeNode]:
        yield self

    async def request(
        self,
        command: Command[Any],
        *,
        touches: Command[Any] | None = None,
        stops_seen: int | None = None,
        stop: bool = False,
        **options: Unpack[CommandOptions],
    ) -> Any:
        exchange = command.open(self.address, self.profile.timings)
        assert exchange.request
        if stops_seen not in (None, self.stops):
            raise Superseded("told to stop", node=self)
        priority = options.get("priority")
        self.bus.log.append((self.address, str(command), None if priority is Priority.COMMAND else priority))
        self.bus.options.append(options)
        self.bus.grown.set()
        await anyio.lowlevel.checkpoint()
        return self.bus.answer(command)


class FakeBus:
    def __init__(self, answer: Answer) -> None:
        self.answer = answer
        self.log: list[tuple[int, str, Priority | None]] = []
        self.options: list[CommandOptions] = []
        self.grown = asyncio.Event()
        self.time = 0.0
        self.nodes: dict[tuple[str, int], FakeNode] = {}

    def node(
        self, profile: Profile, address: int, *, timings: Timings | Learned | None = None, retries: int | None = None
    ) -> FakeNode:
        profile.check_address(address)
        return self.nodes.setdefault((profile.name, address), FakeNode(self, profile, address))

    def now(self) -> float:
        self.time += 0.001
        return self.time

    async def requests(self, count: int) -> None:
        """Wait until so many were made."""
        while len(self.log) < count:
            self.grown.clear()
            await self.grown.wait()

    @property
    def asked(self) -> list[str]:
        """The commands so far, in words."""
        return [command for _, command, _ in self.log]
