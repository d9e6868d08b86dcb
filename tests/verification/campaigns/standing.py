"""What lies between the arbiter and the wire, and stands still now and then: the process, its driver, the network.

Nothing is lost and nothing overtakes, so one request still causes one reply at most; but times are no bound any more.
"""

from __future__ import annotations

import math
from collections import deque
from math import inf
from random import Random
from typing import Any

from busmaster.emulator.world import World
from tests.verification.campaigns.edges import EdgeLine
from tests.verification.campaigns.kinds import refused
from tests.verification.campaigns.mixes import Standstill


def seconds(stands: Standstill, own: Random) -> float:
    """How long: short ones are as frequent as long ones ten times as long."""
    return stands.shortest * math.exp(own.uniform(0.0, math.log(stands.longest / stands.shortest)))


class Channel:
    """Frames on their way, in order, each of which may make it stand still at a `rate`."""

    def __init__(self, rate: float, stands: Standstill, own: Random) -> None:
        self.still_until = -inf
        self.waiting: deque[tuple[float, bytes]] = deque()
        self._rate = rate
        self._stands = stands
        self._own = own

    def put(self, data: bytes, now: float) -> None:
        may_begin = self._rate and not (self._stands.apart and now < self.still_until)
        if may_begin and self._own.random() < self._rate:
            if self._own.random() < self._stands.within and len(data) > 1:
                cut = self._own.randrange(1, len(data))
                self.waiting.append((max(now, self.still_until), data[:cut]))
                data = data[cut:]
            self.still_until = max(self.still_until, now + seconds(self._stands, self._own))
        self.waiting.append((max(now, self.still_until), data))

    def due(self) -> float:
        return self.waiting[0][0] if self.waiting else inf

    def take(self, now: float) -> bytes | None:
        return self.waiting.popleft()[1] if self.waiting and self.waiting[0][0] <= now else None

    def clear(self) -> None:
        self.waiting.clear()
        self.still_until = -inf


class StandingLine(EdgeLine):
    """A line behind a driver that holds output (`held`) and a network that keeps order."""

    def stand_still(self, stands: Standstill, own: Random) -> None:
        """Begin to, from now on. Once, before it is used."""
        self.driver = Channel(stands.held, stands, own)
        self.there = Channel(stands.requests, stands, own)
        self.back = Channel(stands.replies, stands, own)
        self._damaged = stands.damaged

    def heal(self) -> None:
        """What is on its way still comes when it was to come."""
        for channel in (self.driver, self.there, self.back):
            channel._rate = 0.0
        self._damaged = 0.0

    def send(self, data: bytes, now: float) -> None:
        if self._damaged and len(data) > 1 and self._own.random() < self._damaged:
            data = refused(self.kind, data)
        self.driver.put(data, now)
        self._pass_on(now)

    def drop_output(self) -> None:
        """The port is closed: what the driver still holds never leaves."""
        self.driver.clear()

    def unsent(self, now: float) -> int:
        """Bytes that have not left this machine: in the driver, or in a UART that is still sending."""
        leaving = max(0.0, self._sent_by - now) / self.tau if self.paced and self.tau else 0.0
        return sum(len(data) for _, data in self.driver.waiting) + round(leaving)

    def next_event(self) -> float:
        return min(super().next_event(), self.driver.due(), self.there.due(), self.back.due())

    def receive(self, now: float) -> bytes:
        self._pass_on(now)
        data = super().receive(now)
        if data:
            self.back.put(data, now)
        come = b""
        while (data := self.back.take(now) or b"") != b"":
            come += data
        return come

    def _pass_on(self, now: float) -> None:
        while (data := self.driver.take(now)) is not None:
            self.there.put(data, now)
        while (data := self.there.take(now)) is not None:
            super().send(data, now)


class StandingWorld(World):
    """A world whose process stands still now and then; whose port says what has not left, if the arbiter asks.

    What comes meanwhile lies unread; the timer that has become due may run before it is read.
    """

    line: StandingLine

    def __init__(self, line: StandingLine, stands: Standstill, own: Random, **options: Any) -> None:
        self._stands = stands
        self._own = own
        self._unread = b""
        super().__init__(line, **options)

    def plug(self) -> None:
        """What was said to nobody is gone, but for what is still on its way."""
        self._unread = b""
        super().plug()

    def unplug(self, cause: str = "unplugged") -> None:
        self.line.drop_output()
        super().unplug(cause)

    def heal(self) -> None:
        self._stands = Standstill()
        self.line.heal()

    def _step(self, now: float, due_at: float) -> None:
        self._unread += self.line.receive(now)
        if self._own.random() < self._stands.process:
            self._stand_still()
        if due_at <= self.now and self._own.random() < 0.5:
            self._time_out()
        if self._unread:
            data, self._unread = self._unread, b""
            self._hear(data)
        if due_at <= self.now:
            self._time_out()
        super()._step(self.now, inf)

    def _time_out(self) -> None:
        arbiter = self.arbiter
        if self.plugged and arbiter.line_due(self.now):
            arbiter.unsent(self.line.unsent(self.now), self.now)
        arbiter.handle_timeout(self.now, unread=bool(self._unread))
        self._pump()

    def _stand_still(self) -> None:
        """The line goes on."""
        end = self.now + seconds(self._stands, self._own)
        if self._record is not None:
            self._record(f"{self.now:.6f} the process stands still until {end:.6f}")
        while (due := self.line.next_event()) <= end:
            self.now = max(self.now, due)
            self._unread += self.line.receive(self.now)
        self.now = end

    def _send(self, data: bytes) -> None:
        """The driver takes it, late perhaps, and says when it has."""
        if self._own.random() < self._stands.process:
            self._stand_still()
        super()._send(data)
        if self.plugged:
            self.arbiter.transmitted(self.now)
