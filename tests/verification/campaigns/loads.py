"""A line under load in virtual time: nodes, poll groups, commands, and what became of them."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from math import inf
from typing import Any

from busmaster.arbiter.events import Event, NodeChanged, Polled
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.schedule import line_time, set_members
from busmaster.arbiter.transaction import Poll, Priority, Transaction
from busmaster.contract.exchange import Command
from busmaster.contract.learning import Learned
from busmaster.contract.profile import LineSettings, Profile
from busmaster.contract.timing import Timings
from busmaster.emulator.device import Delay, Device
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.emulator.world import World
from busmaster.planning import Bounds, PlannedNode, bounds
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2

VALUE = 123.0
"""Three characters, as short as most real values."""
REPLY_TIME = 0.002
LINE = LineSettings(57600)
EXCHANGE = (8 + 8) * LINE.byte_time + REPLY_TIME
"""Seconds of one read: 8 bytes there, 8 back."""


class Load:
    """One line of HCP2 controllers (or `devices` of one's own), and the figures of a campaign.

    `spread`: reply times vary by that share, evenly.
    """

    def __init__(
        self,
        nodes: int = 8,
        *,
        seed: int = 1,
        spread: float = 0.0,
        devices: Sequence[Device] | None = None,
        profile: Profile = hcp2.PROFILE,
        settings: LineSettings = LINE,
        timings: Timings | Learned | None = None,
        faults: Faults | None = None,
    ) -> None:
        self.random = random.Random(seed)
        delay = Delay(REPLY_TIME * (1 - spread), REPLY_TIME * (1 + spread))
        if devices is None:
            devices = [EmulatedMint(address, delay=delay) for address in range(1, nodes + 1)]
            for device in devices:
                device.comms = [VALUE] * len(device.comms)  # type: ignore[attr-defined]  # all are MintControllers
        line = Line(settings, devices, chance=random.Random(seed), faults=faults)
        self.devices = {device.address: device for device in devices}
        self.world = World(line, on_event=self._on_event, jitter=self.random.random)
        self.nodes = [self.world.node(profile, device.address, timings=timings) for device in devices]
        self.polls: list[Poll] = []
        self.cycles: dict[str, list[tuple[float, float, float]]] = {}
        """Of each poll: due, started, finished; started is -inf if nothing was asked."""
        self.good: dict[int, int] = {node.address: 0 for node in self.nodes}
        """Values that polls brought, by node."""
        self.completed: list[Transaction] = []
        self.changes: list[tuple[float, NodeChanged]] = []
        self.on_completed: Callable[[Transaction], None] = self.completed.append
        self.on_change: Callable[[NodeChanged], None] = lambda change: None

    @property
    def now(self) -> float:
        return self.world.now

    def poll(
        self,
        name: str,
        period: float,
        nodes: Sequence[NodeRecord],
        elements: int = 1,
        *,
        priority: Priority = Priority.POLL,
        phase: float | None = None,
    ) -> Poll:
        """Each of the nodes, so many elements of each."""
        members = [Transaction(node, hcp2.Read(e + 1)) for e in range(elements) for node in nodes]
        return self.poll_of(name, period, members, priority=priority, phase=phase)

    def poll_of(
        self,
        name: str,
        period: float,
        members: Sequence[Transaction],
        *,
        priority: Priority = Priority.POLL,
        phase: float | None = None,
    ) -> Poll:
        tau = self.world.arbiter.byte_time
        cost = sum(line_time(t.command.open(t.node.address, t.node.timings), tau) for t in members)
        poll = Poll(name, period, phase=phase, cost=cost)
        set_members(poll, members, priority)
        self.polls.append(poll)
        self.cycles[name] = []
        self.world.arbiter.add_poll(poll, self.now)
        return poll

    def ask(
        self, node: NodeRecord, command: Command[Any] | None = None, priority: Priority = Priority.COMMAND, **how: Any
    ) -> Transaction:
        return self.world.request(node, hcp2.Read(1) if command is None else command, priority, **how)

    def every(self, interval: Callable[[], float], action: Callable[[], object], until: float = inf) -> None:
        """Call it again and again, so many seconds apart."""

        def again() -> None:
            action()
            if self.now < until:
                self.world.at(self.now + interval(), again)

        self.world.at(self.now + interval(), again)

    def run(self, seconds: float) -> None:
        self.world.run(self.now + seconds)

    def rate(self, seconds: float, addresses: Sequence[int]) -> float:
        """Values a second that polls bring of these nodes, from now on."""
        before = sum(self.good[address] for address in addresses)
        self.run(seconds)
        return (sum(self.good[address] for address in addresses) - before) / seconds

    def _on_event(self, event: Event) -> None:
        if isinstance(event, Polled):
            poll = event.poll
            self.cycles[poll.name].append((poll.due, poll.started, poll.finished))
            for transaction in poll.results:
                self.good[transaction.node.address] += transaction.error is None
        elif isinstance(event, Transaction):
            self.on_completed(event)
        elif isinstance(event, NodeChanged):
            self.changes.append((self.now, event))
            self.on_change(event)

    def bounds(self) -> Bounds:
        """The published bounds of this line: of its polls and its nodes' probes."""
        polled = [(poll, t) for poll in self.polls for t in (*poll.results, *(poll.fresh or ()))]
        low = sum(poll.priority is Priority.BACKGROUND for poll, _ in polled)
        reads = [(PlannedNode(t.node.profile, t.node.address, t.node.timings), t.command) for _, t in polled]
        return bounds(reads, self.world.arbiter.byte_time, polls=len(polled) - low, background=low)


def quantile(values: Sequence[float], q: float) -> float:
    return sorted(values)[min(len(values) - 1, int(q * len(values)))]
