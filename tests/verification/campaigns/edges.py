"""What happens on a line at the last moment that is allowed: late starts, pauses within frames, ACKs that are lost.

R3's assumption bounds when the start bit of a reply, or of a byte within it, may come. Whatever is heard is heard a
byte time later, and later still behind an adapter that holds bytes back: most mistakes are made in between.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from math import inf
from random import Random
from typing import Any

from busmaster.emulator.chance import Chance
from busmaster.emulator.device import Delay, Device
from busmaster.protocols.dc104.device import EmulatedDc104
from busmaster.protocols.msc.device import EmulatedMsc
from tests.verification.campaigns.kinds import Kind
from tests.verification.campaigns.ledger import Ledger, WatchedLine
from tests.verification.campaigns.mixes import Edges

ACK = b"\x06"
NOISE = bytes(byte for byte in range(256) if byte not in b"\x02\x03\x04\x06\x08\x15")
ROUNDING = 1e-9
AFTERWARDS = (0.0001, 0.3)
"""Seconds after which a reply that is doubled comes again."""


class Crowded(Delay):
    """As `usual`, but for a share of the replies, which begin within the last byte time before one of `edges`.

    A delay that is `first` of two (storing, then answering) leaves nothing of the other when it is at an edge.
    """

    __slots__ = ("_byte_time", "_edges", "_share", "_spent", "_usual")
    _usual: Delay
    _share: float
    _edges: Sequence[float]
    _byte_time: float
    _spent: list[None]
    """Not empty: the first of two delays was at an edge."""

    def __init__(
        self, usual: Delay, share: float, edges: Sequence[float], byte_time: float, first: Crowded | None = None
    ) -> None:
        super().__init__(usual.low, usual.high)
        spent: list[None] = [] if first is None else first._spent
        own = {"_usual": usual, "_share": share, "_edges": edges, "_byte_time": byte_time, "_spent": spent}
        for name, value in own.items():
            object.__setattr__(self, name, value)

    def draw(self, chance: Chance) -> float:
        if self._spent:
            self._spent.clear()
            return 0.0
        if chance.random() >= self._share:
            return self._usual.draw(chance)
        return self.at_edge(chance)

    def at_edge(self, chance: Chance) -> float:
        edge = self._edges[chance.randrange(0, len(self._edges))]
        return edge - ROUNDING - chance.random() * self._byte_time


class Storing(Crowded):
    """How long storing takes, before the ACK takes its own time: what is at an edge here is all of it."""

    __slots__ = ()

    def at_edge(self, chance: Chance) -> float:
        self._spent.append(None)
        return super().at_edge(chance)


def crowd(kind: Kind, device: Device, edges: Edges, usual: Delay) -> None:
    """Let the device answer at the edges of its protocol's times."""
    timings, byte_time = kind.profile.timings, kind.profile.line.byte_time
    read, write, packet = (
        (step.window, step.max_reply_delay) for step in (timings.read, timings.write, timings.packet)
    )
    device.delay = Crowded(usual, edges.late, read, byte_time)
    if isinstance(device, EmulatedMsc):
        device.packet_delay = Crowded(usual, edges.late, packet, byte_time)
    elif isinstance(device, EmulatedDc104):
        device.eeprom = Storing(usual, edges.late, write, byte_time, device.delay)


class EdgeLine(WatchedLine):
    """A line on which frames are struck as `edges` says, and by `double_once`, `second` and `twice`."""

    def __init__(
        self, ledger: Ledger, *args: Any, edges: Edges | None, kind: Kind, own: Random, **options: Any
    ) -> None:
        super().__init__(ledger, *args, **options)
        self.edges = edges
        self.kind = kind
        self.second = self.twice = 0.0
        """Shares of replies that come a second time, and of requests that are received a second time."""
        self._received_again: list[tuple[float, bytes]] = []
        self.on_doubled: Callable[[], None] = lambda: None
        self._own = own
        self._inter_byte_timeout = kind.profile.timings.packet.inter_byte_timeout
        self._byte_time = kind.profile.line.byte_time
        self._double = False

    def double_once(self) -> None:
        """The next reply of a device comes a second time."""
        self._double = True

    def send(self, data: bytes, now: float) -> None:
        super().send(data, now)
        if self.twice and len(data) > 1 and self._own.random() < self.twice:
            heapq.heappush(
                self._received_again, (self._sent_by + self._own.uniform(0.0, self.kind.max_reply_delay), data)
            )

    def receive(self, now: float) -> bytes:
        while self._received_again and self._received_again[0][0] <= now:
            when, data = heapq.heappop(self._received_again)
            self._attached.request(data, when - len(data) * self.tau, when)
        return super().receive(now)

    def next_event(self) -> float:
        again = self._received_again[0][0] if self._received_again else inf
        return min(super().next_event(), again)

    def _transmit(self, talker: Device | None, start: float, data: bytes) -> None:
        if talker is None:
            super()._transmit(talker, start, data)
        elif self.second and self._own.random() < self.second:
            super()._transmit(talker, start, data)
            end = start + len(data) * self.tau
            super()._transmit(talker, end + self._own.uniform(0.0, self.kind.max_reply_delay), data)
        elif self._double:
            self._double = False
            super()._transmit(talker, start, data)
            super()._transmit(talker, start + len(data) * self.tau + self._own.uniform(*AFTERWARDS), data)
            self.on_doubled()
        elif self.edges is None:
            super()._transmit(talker, start, data)
        else:
            self._strike(self.edges, talker, start, data)

    def _strike(self, edges: Edges, talker: Device, start: float, data: bytes) -> None:
        own = self._own
        if len(data) == 1:
            if data != ACK or own.random() >= edges.acks_lost:
                super()._transmit(talker, start, data)
            return
        pushed = own.random() < edges.pushed
        cut = len(data) - 1 if pushed else own.randrange(1, len(data))
        pauses = own.random() < (0.5 if pushed else edges.pauses)
        noise = own.choice(NOISE)
        if (noise ^ data[-1]) & 0x7F == 0:  # not the checksum itself: the frame would be whole, and right
            noise ^= 0x40
        parts = [data[:cut] + (bytes((noise,)) if pushed else b""), data[cut:]]
        pause = self._inter_byte_timeout - ROUNDING - own.random() * self._byte_time if pauses else 0.0
        again = start + len(parts[0]) * self.tau + pause
        end = again + len(parts[1]) * self.tau
        self._say_parts(talker, [(start, b"".join(parts))] if not pauses else [(start, parts[0]), (again, parts[1])])
        talker.free_at = max(talker.free_at, end)
        if pushed:
            self.ledger.spoiled(start, end)

    def _say_parts(self, talker: Device, parts: list[tuple[float, bytes]]) -> None:
        """One frame, in one piece or in two."""
        self.tell(talker, parts[0][0], parts[-1][0] + len(parts[-1][1]) * self.tau, b"".join(part for _, part in parts))
        for start, part in parts:
            self.put(talker, start, part)

    def _arrive(self, data: bytes, when: float) -> None:
        """An adapter holds bytes back for any time up to its latency."""
        held = self._own.choice((0.0, 1.0, self._own.random())) if self.edges is not None and self.latency else 1.0
        super()._arrive(data, when - (1.0 - held) * self.latency)
