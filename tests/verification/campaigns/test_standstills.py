"""A network that stands still for up to a second, on a saturated line of equal reads: how soon all nodes are back."""

from __future__ import annotations

import random
from collections.abc import Iterator
from itertools import count, product
from typing import Any

import pytest

from busmaster.arbiter.transaction import Transaction
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.world import World
from busmaster.protocols.msc.device import EmulatedMsc
from busmaster.registry import make_device
from tests.real_wire.kinds import KINDS, Teller
from tests.tiers import one_by_default
from tests.verification.campaigns.mixes import Standstill
from tests.verification.campaigns.standing import Channel

NODES = 4
BEGUN = 2.0
"""Seconds after which the line is in full swing, and stands still."""
PROMPT = Delay(0.003)
LASTING = (0.11, 0.16, 0.52, 0.75, 0.99)
"""Seconds: beyond a window, beyond a maximum reply delay, of most protocols and of MSC."""
PLACES = 4
"""Moments of a round of all nodes at which it begins to stand still."""
BACK = {
    "hcp": (0.20, 0.60),
    "hcp2": (0.20, 0.60),
    "msc": (0.14, 0.55),
    "mentor": (0.32, 1.20),
    "dc104": (0.22, 0.60),
}
"""Seconds from the end of a standstill until all nodes have given a good value, at the most: where all is read, and
where every other request is a write."""


class Network(Line):
    """A line behind a network that keeps the order of what it holds."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.there, self.back = (Channel(0.0, Standstill(), random.Random(1)) for _ in range(2))

    def send(self, data: bytes, now: float) -> None:
        self.there.put(data, now)
        self._pass_on(now)

    def receive(self, now: float) -> bytes:
        self._pass_on(now)
        if data := super().receive(now):
            self.back.put(data, now)
        come = b""
        while data := self.back.take(now) or b"":
            come += data
        return come

    def next_event(self) -> float:
        return min(super().next_event(), self.there.due(), self.back.due())

    def _pass_on(self, now: float) -> None:
        while data := self.there.take(now):
            super().send(data, now)


class Saturated:
    """A line of one protocol on which each node is asked again as soon as it has answered, or failed to."""

    def __init__(self, protocol: str, *, writes: bool = False) -> None:
        """If it `writes`, every other request of a node is a write."""
        self.kind = KINDS[protocol]
        self._writes = writes
        self._numbers = count(1)
        self.said: dict[tuple[str, int, int], float] = {}
        """When a node has said a value, or taken one, last."""
        self.good: dict[int, float] = {}
        """When each node gave a good value last."""
        self.wrong: list[Transaction] = []
        self.failed = 0
        addresses = list(self.kind.addresses)[:NODES]
        devices = [
            make_device(protocol, address, delay=PROMPT, traceable=Teller(address, self.kind.modulus, self._told))
            for address in addresses
        ]
        for device in devices:
            if isinstance(device, EmulatedMsc):
                device.packet_delay = PROMPT
        self.line = Network(self.kind.profile.line, devices, paced=False, chance=random.Random(1))
        self.world = World(self.line, on_event=self._on_event)
        for address in addresses:
            self.world.request(self.world.node(self.kind.profile, address), self.kind.read)

    def _told(self, what: str, node: int, _element: int, value: int) -> None:
        self.said[what, node, value] = self.world.now

    def _on_event(self, event: object) -> None:
        if not isinstance(event, Transaction):
            return
        node = event.node
        what, value = ("took", event.tag) if event.writes else ("said", event.value)
        if event.error is not None:
            self.failed += 1
        elif self.said.get((what, node.address, round(value)), -1.0) < event.queued:
            self.wrong.append(event)
        elif not event.writes:
            self.good[node.address] = self.world.now
        writes_next = self._writes and not event.writes
        number = next(self._numbers)
        following = self.kind.write(number) if writes_next else self.kind.read
        self.world.at(self.world.now, lambda: self.world.request(node, following, tag=number))

    def stand_still(self, lasting: float, ways: tuple[Channel, ...]) -> float:
        """Return how many seconds after it every node had given a good value."""
        ends = self.world.now + lasting
        for way in ways:
            way.still_until = ends
        self.world.run(ends)
        assert self.world.run_until(lambda: all(when > ends for when in self.good.values()), 30.0)
        return self.world.now - ends


def standstills(protocol: str, *, writes: bool) -> Iterator[tuple[Saturated, float]]:
    """Yield a line for each standstill, and how long it took to be back."""
    for lasting, place, requests, replies in product(LASTING, range(PLACES), (True, False), (True, False)):
        if requests or replies:
            line = Saturated(protocol, writes=writes)
            line.world.run(BEGUN + place * (NODES + 1) * 0.007 / PLACES)
            ways = [line.line.there] * requests + [line.line.back] * replies
            yield line, line.stand_still(lasting, tuple(ways))


@pytest.mark.parametrize("writes", one_by_default([True, False]))
@pytest.mark.parametrize("protocol", one_by_default(KINDS))
def test_r15_after_a_standstill_of_up_to_a_second_all_nodes_soon_give_good_values_again(
    protocol: str, writes: bool
) -> None:
    longest = 0.0
    for line, back in standstills(protocol, writes=writes):
        assert not line.wrong
        longest = max(longest, back)
    assert longest <= BACK[protocol][writes]
