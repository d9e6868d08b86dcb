"""What lies on the wire, and whose it is."""

from __future__ import annotations

from math import inf
from typing import Any, Final, TypeAlias

from busmaster.arbiter.clients import LineClient

Time: TypeAlias = Any
"""An Instant, or one of the infinities."""

OWN: Final = "own"
"""Caused by the attempt that is on the wire."""
OLD: Final = "old"
"""Caused by an earlier one."""
STRAY: Final = "stray"
"""Caused by nobody."""


class Violation(Exception):
    """A promise is broken."""


class Outside(Exception):
    """What came is outside the assumptions: two faults that make a valid frame, a forged ACK. Nothing follows."""


class Ticket:
    """One request as its caller knows it: what would be true of its outcome."""

    __slots__ = ("client", "node", "place", "sent", "undenied", "writes")

    def __init__(self, node: int, writes: bool, client: LineClient | None = None) -> None:
        self.client = client
        self.node = node
        self.writes = writes
        self.place = -1
        """Of the value with which its last attempt is answered; -1 before any."""
        self.sent = False
        self.undenied = 0
        """How often its node took it and has not refused it: it may have been carried out as often."""


class Overdue:
    """A reply that may still come: its next byte arrives within [lo, hi], or it stops for ever."""

    __slots__ = (
        "begun",
        "data",
        "driver_release_time",
        "faults",
        "gap",
        "hi",
        "kind",
        "left",
        "lo",
        "own",
        "packet",
        "packet_by",
        "request",
        "ticket",
        "unit",
    )

    def __init__(self, data: bytes, lo: Time, hi: Time, gap: float, *, kind: str = "reply", faults: int = 1) -> None:
        self.data = data
        self.lo = lo
        self.hi = hi
        self.gap = gap
        """From a byte to the next, both received, at the most."""
        self.kind = kind
        self.faults = faults
        """How many it may still have."""
        self.begun = False
        self.own = True
        self.driver_release_time = 0.0
        self.ticket: Ticket | None = None
        self.request = b""
        """What it replies to."""
        self.packet = b""
        """Of an MSC: the packet behind the ACK, or the whole one that may be said again."""
        self.packet_by: Time = -inf
        """When that begins at the latest, if the ACK is lost."""
        self.left = 0
        """How often that may be said again."""
        self.unit = 0

    @property
    def origin(self) -> str:
        return OWN if self.own else OLD


class Script:
    """The choices of one run that are none of time: by `wanted`, then the first of each; `asked` tells them."""

    def __init__(self) -> None:
        self.wanted: tuple[int, ...] = ()
        self.asked: list[tuple[int, int]] = []

    def begin(self, wanted: tuple[int, ...]) -> None:
        self.wanted = wanted
        self.asked.clear()

    def choose(self, several: int) -> int:
        if several < 2:
            return 0
        place = len(self.asked)
        chosen = self.wanted[place] % several if place < len(self.wanted) else 0
        self.asked.append((chosen, several))
        return chosen


SCRIPT: Final = Script()
choose = SCRIPT.choose
