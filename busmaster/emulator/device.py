"""What an emulated device is: it hears bytes, says bytes, and is told the time.

A device is written apart from the master's readers: it shares checksums with them (`busmaster.wire`) and nothing else,
so that a misreading of a document on one side is not hidden by the same misreading on the other.

How the line uses a device
    Every byte on the line is every device's to hear. Handing each byte to each of 32 devices is slow and mostly in
    vain, so there are two ways of hearing, and they must agree:

    `hear`  bytes as they come, whoever sent them: cut, garbled, glued, another device's reply. Always right.
    `take`  one frame of the host's, undisturbed, that begins with one of the device's `routes`. In mid-frame it
            refuses.

    A device in its ground state (`attentive` False) lets pass unheard what does not begin with one of its routes. A
    device that is in mid-frame, or waits for something (MSC: the host's ACK; Mentor: a short command), sets
    `attentive` and then hears every byte of everybody, but for the frames that it takes. After a reset byte that may
    as well have been a checksum, either will do. A device never hears what passes while it talks itself.

    `hear`, `take`, `wake` and `restart` are the only places where `attentive` and `wakeup` may change.
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
    """Seconds from the end of a request to the start of its reply: `low`, or evenly spread from `low` to `high`.

    A share `late_replies` (0 to 1) of the replies takes `late_reply_delay[0]` to `late_reply_delay[1]` seconds instead.
    Raises InvalidCommand unless 0 <= low <= high, and for a share that is none.
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
        """Parse milliseconds as the command line gives them: "2" or "50-100". Raises InvalidCommand."""
        low, dash, high = text.partition("-")
        try:
            return cls(float(low) / 1000, float(high) / 1000 if dash else None)
        except ValueError as error:
            if isinstance(error, InvalidCommand):
                raise
            raise InvalidCommand(f"a reply delay is milliseconds, as 2 or 50-100, not {text!r}") from None

    def draw(self, chance: Chance) -> float:
        """Return a delay in seconds, drawn by `chance` unless it is always the same."""
        if self.late_replies and chance.random() < self.late_replies:
            return chance.uniform(*self.late_reply_delay)
        return self.low if self.high is None else chance.uniform(self.low, self.high)


def held(value: float, low: int, high: int, what: str) -> int:
    """Return a value as the whole number that a device can hold. Raises InvalidCommand, naming it `what`."""
    if not low <= value <= high or value != int(value):
        raise InvalidCommand(f"{what} holds a whole number, {low} to {high}, not {value:g}")
    return int(value)


class Device(ABC):
    """One device on the line. A kind of device writes `hear_byte`, its `routes`, and `take` for speed.

    `delay` may be changed at any time. `tau` (seconds per byte) and `chance` are set when the device joins a line.
    """

    routes: tuple[bytes, ...] = ()
    """What a request to this device begins with: b"\\x0702" for HCP2 node 2. Several if it hears a broadcast too."""
    refusal: bytes = NAK
    """What it says in a storm of refusals."""

    def __init__(self, address: int, *, delay: Delay | None = None) -> None:
        self.address = address
        self.delay = Delay() if delay is None else delay
        self.tau = 0.0
        self.chance: Chance = NoChance()
        self.attentive = False
        """In mid-frame, or waiting: it must hear every byte of everybody."""
        self.wakeup = NEVER
        """When `wake` wants to be called (MSC: no ACK came, or the packet was never completed)."""
        self.free_at = 0.0
        """When its own last byte will have left."""
        self.outbox: list[tuple[float, bytes]] = []
        """What it is going to say, and when the first byte begins. The line empties it."""
        self.faults = Faults()
        self.driver_release_time = 0.0
        """Seconds for which its driver still holds the line after its last byte."""
        self.lag = 0.0
        """Added to every delay: how a fault makes one reply late."""
        self.away_until = 0.0
        """A fault took it off the line until then."""
        self.restarted = False
        """It has restarted, and the line has not yet taken back what it was about to say."""

    # Before it joins a line

    def preset(self, item: str, *values: float) -> None:
        """Hold `values` from the start: in `item`, written as on the command line, and in those after it.

        A value is the number that the line carries. A kind of device whose values can be set writes this. Raises
        InvalidCommand for an item that it does not have, or that cannot hold the value.
        """
        raise InvalidCommand(f"{type(self).__name__} takes no initial values")

    # What the line calls

    def hear(self, data: bytes, start: float) -> None:
        """Take contiguous bytes off the line, the first of which began at `start`. Never raises, whatever they are."""
        tau = self.tau
        for number, byte in enumerate(data, 1):
            self.hear_byte(byte, start + number * tau)

    @abstractmethod
    def hear_byte(self, byte: int, now: float) -> None:
        """Take one byte off the line, which ended at `now`. `reply` answers it. Never raises."""

    def take(self, frame: bytes, now: float) -> bool:
        """Take a frame that begins with a route, whole and undisturbed, whose last byte ended at `now`.

        Returns True if it was exactly one request and has been answered (or rightly not), just as `hear` would have
        done it. Returns False, and nothing has happened, if it is something else, or the device is in mid-frame; it is
        then heard byte by byte.
        """
        return False

    def wake(self, now: float) -> None:
        """Do what is due now that `wakeup` has come. Must set another `wakeup`, or NEVER."""
        self.wakeup = NEVER

    def restart(self, now: float) -> None:
        """Begin anew, as power was lost and is back: what was in RAM is gone, what it was about to say too.

        A kind of device with RAM or a parser extends this.
        """
        self.outbox.clear()
        self.attentive = False
        self.wakeup = NEVER
        self.free_at = now
        self.restarted = True

    def disguise(self, reply: bytes, chance: Chance) -> bytes:
        """Return the same reply as if for another element, parameter or unit, with a right checksum.

        A fault asks for it. It is unchanged if it carries no such thing (a lone ACK). A traceable value becomes another
        node's.
        """
        return reply

    # What a kind of device calls

    @final
    def reply(self, data: bytes, now: float, delay: float | None = None) -> float:
        """Say `data`, `delay` seconds after `now` (drawn from `self.delay` by default), after what is still to be said.

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
