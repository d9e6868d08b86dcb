"""What a world is made of: the line, what is asked, what its adversary may do, and what is assumed of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from tests.verification.proof.kinds import READ, WRITE

FLIPS: Final = "flips"
"""Any bit of any byte of a reply is another, once a reply."""
LOST: Final = "lost"
"""Any byte of a reply does not arrive, once a reply."""
MARKS: Final = "marks"
"""The port says that a byte of a reply came damaged, once a reply."""
NAKS: Final = "naks"
"""A node says NAK in place of its reply."""
STRAYS: Final = "strays"
"""A byte that nobody said comes at any time, once an exchange."""
CANCELS: Final = "cancels"
"""The caller of what is on the wire goes away."""
URGENT: Final = "urgent"
"""An urgent write at any time."""
IDLE: Final = "idle"
"""Requests come at any time; without it something always waits."""
LOSS: Final = "loss"
"""The port goes and comes back at any time."""
STALLS: Final = "stalls"
"""The loop stands still: bytes lie unread, timers are late."""
HELD: Final = "held"
"""The port holds what was written, for as long as it likes."""
FROZEN: Final = "frozen"
"""The process stands still between the arbiter's word and the write."""
ECHO_FAULTS: Final = "echo faults"
"""The echo is lost or differs."""
RAISED: Final = "raised"
"""An overdue reply raises its node's maximum reply delay, to any of two values."""
HEALTH: Final = "health"
"""A failure may make a node suspect, or dead and probed."""
HOLDS: Final = "holds"
"""An answer may be held until another could have come, as it is while things are said twice."""
NOISE: Final = "noise"
"""Any stray byte may be the one after which the line is NOISY."""
BEYOND: Final = "beyond"
"""Replies come after their maximum reply delay, in order, within `Setup.beyond`: only R15 is left to keep them
apart."""

ALL = (
    *(FLIPS, LOST, MARKS, NAKS, STRAYS, CANCELS, URGENT, IDLE),
    *(LOSS, STALLS, HELD, FROZEN, RAISED, HEALTH, HOLDS, NOISE),
)


@dataclass(frozen=True)
class Assumptions:
    """What is assumed of the nodes, as it is told to users."""

    max_reply_delay_to: str = "start bit"
    """What falls within the maximum reply delay: a reply's "start bit", or its first "received byte"."""
    gap_to: str = "start bit"
    """What ends a pause within `inter_byte_timeout`: the next byte's "start bit", or its being a "received byte"."""

    pauses_hold_the_lost: bool = True
    """A pause within a reply ends within `inter_byte_timeout`, whatever was lost in it; so does the time before its
    first byte end within the maximum reply delay. Else two pauses look like one."""
    held_until_asked: bool = True
    """Output that a port holds is held until the port is asked for it: one that lets go before, unseen, is not noticed,
    and the maximum reply delay of what was asked counts from when it was written."""

    @property
    def edge(self) -> bool:
        return self.max_reply_delay_to == "start bit"

    @property
    def gap_edge(self) -> bool:
        return self.gap_to == "start bit"


@dataclass(frozen=True)
class Setup:
    """One world. Times are in seconds."""

    kind: str = "hcp2"
    commands: tuple[int, ...] = (READ, WRITE)
    """Places in the kind's commands: what may be asked."""
    adversary: tuple[str, ...] = ()
    paced: bool = False
    echo: bool = False
    receive_latency: float = 0.0
    late_echo: float = 0.0
    retries: int = 0
    depth: int = 0
    """Requests that wait; 0 if one is asked whenever the line is free, which is the same where only one would."""
    clients: int = 0
    """Programs that share the line with its owner, in any order of their turns."""
    longest_hold: float = 0.0
    """Seconds for which the line may be held for a sequence of requests; 0 if nobody holds it."""
    second_timing: bool = False
    """The second node has times of its own, shorter ones, and a driver release time."""
    in_sync: bool = False
    """What is overdue is told by the shipping code; else it may be anything (see shipped.py)."""
    strict: bool = False
    assumptions: Assumptions = field(default_factory=Assumptions)
    stray_bytes: bytes = b"\x06\x15\x04\x02\x31"
    bits: tuple[int, ...] = tuple(range(8))
    stall: float = 0.030
    beyond: float = 0.0
    """Seconds after its request within which all of a reply comes, where the line may have gone on before: later than
    its maximum reply delay, or than a learned window."""
    lapse: float = 0.4
    """In place of LAPSE: fewer overdue replies at a time."""
    alike: int = 2
    """In place of LONGEST_ALIKE."""
    doubt: float = 0.2
    """In place of AMBIGUITY_PERIOD."""
    said_memory: float = 0.1
    """In place of ANSWER_MEMORY."""
    slowest: tuple[float, ...] = (0.0,)
    """What a node's slowest reply may be known to be, each time that it is asked for; 0 if it was never timed."""
    learned: tuple[float, float] | None = None
    """The least and the longest window that may have been learned of a node's replies: any between them is awaited."""
    lost_acknowledgements: int = 0
    """Of an MSC's packets: how many closing ACKs of the host are lost in an exchange."""
    retransmissions: int = 1
    whole: bool = False
    """Replies come whole, in one chunk."""
    pauses: tuple[int, ...] = ()
    """After so many bytes such a reply may pause once, for as long as its document allows."""
    cuts: bool = False
    """What lies in an adapter or the kernel may be read in two pieces; else all of it is read at once."""
    max_reply_delay: float = 0.0
    """Seconds: the maximum reply delay of every node, in place of its document's, with a window of two thirds; 0 if it
    is that."""
    bytewise: bool = False
    """An MSC's packets come byte by byte too, not all at once alone."""
    damage: tuple[tuple[int, int | None], ...] = ()
    """Of an MSC's packets: (place, bit) of what may be flipped; None for a byte that is lost."""

    @property
    def name(self) -> str:
        parts = [self.kind, "commands " + ",".join(str(place) for place in self.commands)]
        parts += [word for word in ("in_sync", "whole", "paced", "echo", "strict") if getattr(self, word)]
        if self.receive_latency:
            parts.append(f"latency {self.receive_latency * 1000:g} ms")
        if self.second_timing:
            parts.append("two timings")
        parts += [f"{name} {value}" for name, value in (("retries", self.retries),) if value]
        parts += [f"{name} {value}" for name, value in (("clients", self.clients),) if value]
        if self.longest_hold:
            parts.append("sequences")
        if self.depth:
            parts.append(f"depth {self.depth}")
        if not (self.assumptions.edge and self.assumptions.gap_edge):
            parts.append(
                f"maximum reply delay to {self.assumptions.max_reply_delay_to}, gap to {self.assumptions.gap_to}"
            )
        if not self.assumptions.pauses_hold_the_lost:
            parts.append("lost bytes lengthen pauses")
        if not self.assumptions.held_until_asked:
            parts.append("let go unseen")
        if self.slowest != (0.0,):
            parts.append("replies timed")
        if self.learned is not None:
            parts.append("learned windows")
        if self.lost_acknowledgements:
            parts.append(f"lost ACKs {self.lost_acknowledgements}")
        parts += [f"maximum reply delay {self.max_reply_delay * 1000:g} ms"] if self.max_reply_delay else []
        parts += ["pauses"] if self.pauses else []
        parts += ["cuts"] if self.cuts else []
        parts += ["bytewise"] if self.bytewise else []
        parts += ["damage"] if self.damage else []
        return "; ".join((*parts, *self.adversary))

    def may(self, feature: str) -> bool:
        return feature in self.adversary
