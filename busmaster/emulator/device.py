"""The base class of emulated devices: receives bytes, transmits bytes, and gets the time from outside.

A device is implemented separately from the master's readers. It shares checksums with them (`busmaster.wire`) and
nothing else, so that a misreading of a document on one side is not hidden by the same misreading on the other.

How the line uses a device

    Every device receives every byte. Passing each byte to each of 32 devices is slow and mostly useless, so there are
    two ways to receive, which must agree:

    `hear`  bytes as they arrive, from any sender: incomplete, corrupted, joined, or of another device. Always valid.
    `take`  one undisturbed frame of the host that begins with one of the device's `routes`. In mid-frame it refuses.

    An idle device (`attentive` False) ignores what does not begin with one of its routes. A device that is in mid-frame
    or waits for something (MSC: the host's ACK; Mentor: a short command) sets `attentive`. It then receives every byte
    of every sender, except for frames that it takes. After a reset byte that may also have been a checksum, either is
    correct. A device never receives while it transmits.

    `attentive` and `wakeup` change only in `hear`, `take`, `wake` and `restart`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import final

from busmaster.emulator.chance import Chance, NoChance
from busmaster.emulator.faults import Faults
from busmaster.errors import InvalidCommand

NEVER = math.inf
NAK = b"\x15"


@dataclass(frozen=True, slots=True)
class Delay:
    """Seconds from the end of a request to the start of its reply: `low`, or uniformly distributed from `low` to
    `high`.

    A share `late_replies` (0 to 1) of the replies takes `late_reply_delay[0]` to `late_reply_delay[1]` seconds instead.
    Raises InvalidCommand unless 0 <= low <= high, and for an invalid share.
    """

    low: float = 0.002
    high: float | None = None
    late_replies: float = 0.0
    late_reply_delay: tuple[float, float] = (0.1, 0.145)

    def __post_init__(self) -> None:
        high = self.low if self.high is None else self.high
        object.__setattr__(self, "high", None if high == self.low else high)
        if (
            not 0 <= self.low <= high < math.inf
            or not 0 <= self.late_reply_delay[0] <= self.late_reply_delay[1] < math.inf
        ):
            raise InvalidCommand(f"a reply delay is 0 s or more, the lower bound first, not {self.low:g} to {high:g} s")
        if not 0 <= self.late_replies <= 1:
            raise InvalidCommand(f"the share of overdue replies is from 0 to 1, not {self.late_replies:g}")

    @classmethod
    def parse(cls, text: str) -> Delay:
        """Parse milliseconds as on the command line: "2" or "50-100". Raises InvalidCommand."""
        low, dash, high = text.partition("-")
        try:
            return cls(float(low) / 1000, float(high) / 1000 if dash else None)
        except ValueError as error:
            if isinstance(error, InvalidCommand):
                raise
            raise InvalidCommand(f"a reply delay is milliseconds, as 2 or 50-100, not {text!r}") from None

    def draw(self, chance: Chance) -> float:
        """Return a delay in seconds, from `chance` unless it is constant."""
        if self.late_replies and chance.random() < self.late_replies:
            return chance.uniform(*self.late_reply_delay)
        return self.low if self.high is None else chance.uniform(self.low, self.high)


def held(value: float, low: int, high: int, what: str) -> int:
    """Return a value as a whole number that a device can store. Raises InvalidCommand with the name `what`."""
    if not low <= value <= high or value != int(value):
        raise InvalidCommand(f"{what} holds a whole number, {low} to {high}, not {value:g}")
    return int(value)


class Device(ABC):
    """One device on the line. A kind of device implements `hear_byte`, its `routes`, and `take` for speed.

    `delay` can be changed at any time. `tau` (seconds per byte) and `chance` are set when the device joins a line.
    """

    routes: tuple[bytes, ...] = ()
    """First bytes of a request to this device: b"\\x0702" for HCP2 node 2. Several if it also receives broadcasts."""
    refusal: bytes = NAK
    """Its reply in a storm of refusals."""

    def __init__(self, address: int, *, delay: Delay | None = None) -> None:
        self.address = address
        self.delay = Delay() if delay is None else delay
        self.tau = 0.0
        self.chance: Chance = NoChance()
        self.attentive = False
        """True in mid-frame or while waiting: it must receive every byte of every sender."""
        self.wakeup = NEVER
        """When to call `wake` (MSC: no ACK arrived, or the packet was never completed)."""
        self.free_at = 0.0
        """When its own last byte will have left."""
        self.outbox: list[tuple[float, bytes]] = []
        """Pending transmissions with their start times. The line removes them."""
        self.faults = Faults()
        self.driver_release_time = 0.0
        """Seconds for which its driver holds the line after its last byte."""
        self.lag = 0.0
        """Added to every delay: used by a fault that makes one reply late."""
        self.away_until = 0.0
        """A fault has removed it from the line until this time."""
        self.restarted = False
        """It has restarted, and the line has not discarded its pending transmissions yet."""

    # Before it joins a line

    def preset(self, item: str, *values: float) -> None:
        """Set initial `values`: of `item`, written as on the command line, and of those after it.

        A value is the number on the line. Implemented by kinds of device with settable values. Raises InvalidCommand
        for an item that it does not have, or that cannot hold the value.
        """
        raise InvalidCommand(f"{type(self).__name__} takes no initial values")

    # What the line calls

    def hear(self, data: bytes, start: float) -> None:
        """Process contiguous bytes from the line, the first of which began at `start`. Never raises."""
        tau = self.tau
        for number, byte in enumerate(data, 1):
            self.hear_byte(byte, start + number * tau)

    @abstractmethod
    def hear_byte(self, byte: int, now: float) -> None:
        """Process one byte from the line, which ended at `now`. Use `reply` to answer. Never raises."""

    def take(self, frame: bytes, now: float) -> bool:
        """Process a whole undisturbed frame that begins with a route; its last byte ended at `now`.

        Returns True if it was exactly one request and was processed as `hear` would have done. Returns False without
        any effect if it is something else or the device is in mid-frame; the frame is then passed byte by byte.
        """
        return False

    def wake(self, now: float) -> None:
        """Run the timer set in `wakeup`. Must set another `wakeup`, or NEVER."""
        self.wakeup = NEVER

    def restart(self, now: float) -> None:
        """Restart after a power failure: RAM contents and pending transmissions are lost.

        Extended by kinds of device with RAM or a parser.
        """
        self.outbox.clear()
        self.attentive = False
        self.wakeup = NEVER
        self.free_at = now
        self.restarted = True

    def disguise(self, reply: bytes, chance: Chance) -> bytes:
        """Return the reply as if for another element, parameter or unit, with a correct checksum.

        Used by a fault. Unchanged if the reply has no such field (a single ACK). A traceable value becomes that of
        another node.
        """
        return reply

    # What a kind of device calls

    @final
    def reply(self, data: bytes, now: float, delay: float | None = None) -> float:
        """Transmit `data` after its pending transmissions, `delay` seconds after `now` (by default from `self.delay`).

        Returns when its last byte will have left.
        """
        if delay is None:
            delay = self.delay.draw(self.chance)
        start = now + delay + self.lag
        if start < self.free_at:
            start = self.free_at
        self.outbox.append((start, data))
        self.free_at = end = start + len(data) * self.tau
        return end

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.address}>"


__all__ = [
    "NAK",
    "NEVER",
    "Delay",
    "Device",
    "held",
]
