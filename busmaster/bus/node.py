"""A node: one addressed device of a bus."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Hashable
from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING, Any, TypeVar

from busmaster.arbiter.counters import NodeStatistics
from busmaster.arbiter.health import Health, NodeRecord
from busmaster.arbiter.transaction import COMMAND, Priority, Timeline, Transaction
from busmaster.contract.arguments import seconds, whole_number
from busmaster.contract.exchange import Command
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import BusError, InvalidCommand, Refused
from busmaster.planning import PlannedNode
from busmaster.planning.merging import Merge

if TYPE_CHECKING:
    from busmaster.bus.bus import Bus
    from busmaster.bus.points import Point

T = TypeVar("T")
MOST_RETRIES = 100

__all__ = ["Health", "Node", "NodeStatistics", "Priority", "Timeline"]


class Node:
    """One node, made by `Bus.node` or by a handle. Everything that is asked of it goes through `request`."""

    def __init__(self, bus: Bus, record: NodeRecord) -> None:
        self.bus = bus
        self.record = record
        self.timings = record.timings
        """As they were asked for: its record's lateness may have been raised since."""
        self.kinds: dict[Hashable, Command[Any]] = {}
        """Of each kind of command that was asked of it, the first: the worst case reckons with them."""
        self.touched = -inf
        """When the last write to it, or to one of its points, ended."""
        self.returning = asyncio.Lock()
        """Held while its hook runs."""
        self._on_return: Callable[[Node], Awaitable[None]] | None = None

    @property
    def profile(self) -> Profile:
        return self.record.profile

    @property
    def address(self) -> int:
        return self.record.address

    @property
    def label(self) -> str:
        """Return how messages call it: "node 5"."""
        return self.record.label

    def planned(self) -> PlannedNode:
        """Return the node as the planner sees it, with its reply time as measured so far."""
        record = self.record
        return PlannedNode(record.profile, record.address, record.timings, record.reply_time)

    @property
    def health(self) -> Health:
        return self.record.health

    def __repr__(self) -> str:
        return f"<Node {self.profile.name} {self.address} {self.health.value}>"

    @property
    def on_return(self) -> Callable[[Node], Awaitable[None]] | None:
        """Return the hook that is awaited when the node is back from DOWN, before its polls resume.

        Parameters are re-sent in it. By default nothing is done: a master that enables a drive or repeats a reference
        by itself is a danger.
        """
        return self._on_return

    @on_return.setter
    def on_return(self, hook: Callable[[Node], Awaitable[None]] | None) -> None:
        self._on_return = hook
        self.record.has_hook = hook is not None

    def check_shared(self, profile: Profile, timings: Timings | None, retries: int | None) -> None:
        """Raise InvalidCommand where somebody asks for this node with anything else than it was first asked with.

        What is None was left open: a profile's `merge` too.
        """
        own = self.profile
        wanted = {
            "other timings": timings not in (None, self.timings),
            "other retries": retries not in (None, self.record.retries),
            "another profile": profile != own or profile.merge not in (None, own.merge),
        }
        for what, differs in wanted.items():
            if differs:
                raise InvalidCommand(
                    f"{self.label} is in use already, and now asked for with {what}: "
                    "give all handles of an address the same options, or leave them out in all but the first"
                )

    def merge_reads(self, merge: Merge) -> None:
        """Have poll groups propose `merge` for this node's reads from now on, in place of what its profile had."""
        self.record.profile = replace(self.record.profile, merge=merge)

    async def request(
        self,
        command: Command[T],
        *,
        priority: Priority | None = None,
        start_within: float | None = None,
        retries: int | None = None,
        idempotent: bool | None = None,
        touches: Point[Any] | None = None,
    ) -> T:
        """Run one command and return its value.

        `priority`, a Priority or its number, defaults to COMMAND. `start_within` (seconds) fails the request with
        NotStarted if it could not be sent by then. `retries` (0 to 100) overrides the node's; writes are not retried
        unless the command or `idempotent` says that they may be repeated (R7). `touches` names the point that a write
        changes: samples older than the write are marked stale; without it, all of the node's.

        Raises a BusError subclass. Cancelling it frees the caller at once and never disturbs the line (R6).
        """
        transaction, future = self._start(command, priority, start_within, retries, idempotent, touches=touches)
        try:
            value: T = await future
        except asyncio.CancelledError:
            self._give_up(transaction)
            raise
        return value

    async def timed_request(
        self, command: Command[T], *, priority: Priority | None = None, start_within: float | None = None
    ) -> tuple[T, Timeline]:
        """Do what `request` does, and return beside the value the timeline that says why it took so long."""
        transaction, future = self._start(command, priority, start_within, None, None)
        try:
            return await future, transaction.timeline()
        except asyncio.CancelledError:
            self._give_up(transaction)
            raise

    def _start(
        self,
        command: Command[Any],
        priority: Priority | None,
        start_within: float | None,
        retries: int | None,
        idempotent: bool | None,
        *,
        probe: bool = False,
        touches: Point[Any] | None = None,
    ) -> tuple[Transaction, asyncio.Future[Any]]:
        record = self.record
        profile = record.profile
        if retries is not None:
            retries = checked_retries(retries, self.label)
        if start_within is not None:
            start_within = seconds(start_within, f"{self.label}: start_within")
        if priority is None:
            priority = COMMAND
        elif type(priority) is not Priority:
            priority = checked_priority(priority)
        if record.address == profile.broadcast and not command.writes:
            raise InvalidCommand(f"{profile.name}: address {self.address} is for writes to all; nobody answers a read")
        bus = self.bus
        if not bus.running:
            raise bus.not_open(node=self.label, command=str(command))
        bus.check_loop()
        if type(command) not in self.kinds:
            if not hasattr(command, "open"):
                raise InvalidCommand(f"{self.label}: {command!r} is no command; read it through a handle, or its point")
            self.kinds[type(command)] = command
        start_by = inf if start_within is None else bus.now() + start_within
        transaction = Transaction(record, command, priority, start_by, retries, idempotent, probe)
        transaction.touches = self if touches is None else touches.quantity
        return transaction, bus.pump.transact(transaction)

    def _give_up(self, transaction: Transaction) -> None:
        """Nobody waits for it any more. A write that is on the wire now is over before anything else can be read."""
        self.bus.pump.cancel(transaction)
        # Its end is not told to anyone, but what it may have changed is: samples that were read before it are stale
        # now.
        if transaction.writes and transaction.attempts:
            self.bus.touched(transaction, self.bus.now())

    async def probe(self) -> bool:
        """Ask the node's cheapest read now, once. Return True if it answered (a refusal is an answer), False if not, or
        if it could not be asked."""
        transaction, future = self._start(self.profile.probe, None, None, 0, None, probe=True)
        try:
            await future
        except asyncio.CancelledError:
            self._give_up(transaction)
            raise
        except Refused:
            return True
        except BusError:
            return False
        return True

    def suspend(self, for_: float) -> None:
        """Let it rest for maintenance: no polls, and NodeDown for requests, for so many seconds; 0 ends that now."""
        self.bus.suspend(self, seconds(for_, f"{self.label}: a suspension"))

    @property
    def suspended(self) -> bool:
        return self.bus.now() < self.record.suspended_until

    def statistics(self) -> NodeStatistics:
        """Return counts and latencies since the bus was opened or its statistics were reset."""
        self.bus.check_loop()
        return self.record.counters.snapshot(self.record.lateness)


def checked_priority(value: Priority | int) -> Priority:
    """Return the class that `value` is, or is the number of. Raises InvalidCommand for anything else."""
    return Priority(whole_number(value, min(Priority), max(Priority), "a priority"))


def checked_retries(value: int, label: str) -> int:
    """Return `value` as an int. Raises InvalidCommand, naming the node, unless it is 0 to 100."""
    return whole_number(value, 0, MOST_RETRIES, f"{label}: retries")
