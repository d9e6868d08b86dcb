"""The faults of a device or a line: zero by default, seeded, changeable while it runs.

The master assumes R3: one request causes at most one reply, which begins within its node's `max_reply_delay`. If all
faults in use are in `WITHIN`, and reply delay plus `late_by` is at most that maximum reply delay, the master must not
deliver a wrong value. With faults in `BEYOND` a wrong value is possible, because replies contain no address or only an
8-bit checksum. The campaigns count how often this happens.

Faults of a line strike every frame on it, including those of the host. Faults of a device strike the frames that it
receives and sends. Two faults are `WITHIN` only as faults of a device:

- `doubled`: two copies of a request cause two replies.
- `truncated`: a device of HCP, HCP2 or Mentor II that misses the last byte of a request waits for it. It processes the
  first byte of the next request as that byte, and replies with a NAK to a request for another device.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeAlias

from busmaster.contract.arguments import Between, guess
from busmaster.errors import InvalidCommand

FORGED = b"\x06\x15\x04"
"""Bytes that are a whole reply by themselves: ACK, NAK, EOT."""
NO_NOISE = bytes(byte | parity for byte in FORGED + b"\x08" for parity in (0x00, 0x80))
"""These, and BS, which is a whole request to a Mentor II; each also with the parity bit of a line of 7 bits."""

HEARING = ("dead", "drop", "deaf", "restart", "flapping", "nak", "late")
SPEAKING = (
    *("lost", "wrong", "truncated", "flip", "unseen", "doubled", "leading", "trailing"),
    *("repeated", "duplicate", "forged", "babble", "split"),
)
BEYOND = frozenset({"repeated", "duplicate", "forged", "unseen"})
WITHIN = frozenset({*HEARING, *SPEAKING}) - BEYOND
SECONDS = ("late_by", "away_for")

Rate: TypeAlias = Annotated[float, Between(0, 1, self_checked=True)]
Seconds: TypeAlias = Annotated[float, Between(0, unit="s", self_checked=True)]


@dataclass(slots=True)
class Faults:
    """Each rate is the probability, from 0 to 1, that a fault strikes one frame. Set them at any time.

    Raises InvalidCommand, on setting too, for a value outside this range.
    """

    lost: Rate = 0.0
    """Not transmitted."""
    late: Rate = 0.0
    """Transmitted up to `late_by` seconds later than usual."""
    flip: Rate = 0.0
    """One bit flipped."""
    unseen: Rate = 0.0
    """The same bit flipped in two bytes: an exclusive-or of all bytes cannot see it."""
    truncated: Rate = 0.0
    """Cut at a random place."""
    doubled: Rate = 0.0
    """Transmitted twice, the second time directly after the first."""
    repeated: Rate = 0.0
    """Transmitted twice, up to 300 ms apart."""
    wrong: Rate = 0.0
    """For another element, parameter or unit than requested, with a correct checksum."""
    duplicate: Rate = 0.0
    """A second device with the same address replies too, after its own delay."""
    leading: Rate = 0.0
    """A few noise bytes before it (a driver switched on): never an ACK, NAK, EOT or BS."""
    trailing: Rate = 0.0
    """A few noise bytes glued to its end: never an ACK, NAK, EOT or BS."""
    forged: Rate = 0.0
    """An unexpected ACK, NAK or EOT in front of it."""
    babble: Rate = 0.0
    """A burst of up to 60 noise bytes at some moment of the next 100 ms."""
    split: Rate = 0.0
    """Delivered to the host in chunks of 1 to 4 bytes."""
    deaf: Rate = 0.0
    """A request is not received."""
    nak: Rate = 0.0
    """A request is refused without being processed; 1 is a storm of refusals."""
    flapping: Rate = 0.0
    """It goes away for up to `away_for` seconds when a request comes."""
    restart: Rate = 0.0
    """It goes away as by `flapping`, and the content of its RAM is lost."""
    dead: Rate = 0.0
    """Above 0: it does not receive or transmit."""
    drop: Rate = 0.0
    """Bytes that it receives while it still has bytes to transmit are lost. At 0 a UART's queue stores them."""
    late_by: Seconds = 0.1
    """The most seconds by which `late` delays a reply."""
    away_for: Seconds = 5.0
    """The most seconds for which `flapping` and `restart` keep it away."""
    hearing: tuple[tuple[str, float], ...] = field(default=(), init=False, repr=False)
    """The faults in use that strike received frames. Updated automatically, like `speaking`."""
    speaking: tuple[tuple[str, float], ...] = field(default=(), init=False, repr=False)

    def __setattr__(self, name: str, value: Any) -> None:
        rate = name in HEARING or name in SPEAKING
        if rate and not 0 <= value <= 1:
            raise InvalidCommand(f"fault {name} is a probability from 0 to 1, not {value:g}")
        if name in SECONDS and not 0 <= value < math.inf:
            raise InvalidCommand(f"fault {name} is a number of seconds, 0 or more, not {value:g}")
        object.__setattr__(self, name, value)
        if rate:
            for group, members in (("hearing", HEARING), ("speaking", SPEAKING)):
                in_use = ((member, getattr(self, member, 0.0)) for member in members)
                object.__setattr__(self, group, tuple(pair for pair in in_use if pair[1]))

    def __post_init__(self) -> None:
        self.lost = self.lost

    @classmethod
    def parse(cls, settings: Iterable[str]) -> Faults:
        """Parse texts such as "lost=0.1". Raises InvalidCommand, naming the nearest fault."""
        faults = cls()
        for setting in settings:
            name, _, text = (part.strip() for part in setting.partition("="))
            if name not in NAMES:
                raise InvalidCommand(f"no such fault {name!r}: use {' '.join(NAMES)}{guess(name, NAMES)}")
            try:
                value = float(text)
            except ValueError:
                raise InvalidCommand(f"fault {name}: {text!r} is not a number; write for example {name}=0.1") from None
            setattr(faults, name, value)
        return faults

    @property
    def beyond(self) -> frozenset[str]:
        """Return the active faults outside R3's assumption. If there are none, no value may be wrong."""
        return frozenset(name for name, _ in self.speaking) & BEYOND

    def __str__(self) -> str:
        return " ".join(
            f"{name}={getattr(self, name):g}" for name in NAMES if getattr(self, name) != getattr(CALM, name)
        )


NAMES = tuple(sorted({*HEARING, *SPEAKING, *SECONDS}))
CALM = Faults()


__all__ = [
    "BEYOND",
    "CALM",
    "FORGED",
    "HEARING",
    "NAMES",
    "NO_NOISE",
    "SECONDS",
    "SPEAKING",
    "WITHIN",
    "Faults",
]
