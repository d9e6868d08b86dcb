"""What a protocol says of itself, as data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from busmaster.contract.exchange import Command, Listener
from busmaster.contract.timing import Timings
from busmaster.errors import InvalidCommand

START_BIT = 1


@dataclass(frozen=True, slots=True)
class LineSettings:
    """Baud rate and framing of a line."""

    baudrate: int
    bytesize: int = 8
    parity: str = "N"
    stopbits: float = 1

    def __post_init__(self) -> None:
        rate: object = self.baudrate
        if not isinstance(rate, int) or isinstance(rate, bool) or rate <= 0:
            raise InvalidCommand(f"baudrate must be a whole number above 0, not {rate!r}")
        if self.bytesize not in (5, 6, 7, 8) or self.parity not in tuple("NEOMS") or self.stopbits not in (1, 1.5, 2):
            raise InvalidCommand(
                f"no such framing: {self.bytesize}{self.parity}{self.stopbits:g}; use for example 8N1 or 7E1"
            )

    @property
    def byte_time(self) -> float:
        """Return tau, the seconds per byte on the wire."""
        bits = START_BIT + self.bytesize + (self.parity != "N") + self.stopbits
        return bits / self.baudrate

    @property
    def framing(self) -> str:
        """Return bits, parity and stop bits as people write them: 8N1, 7E1."""
        return f"{self.bytesize}{self.parity}{self.stopbits:g}"

    def at(self, *baudrates: int) -> tuple[LineSettings, ...]:
        """Return the same framing at other rates."""
        return tuple(replace(self, baudrate=baudrate) for baudrate in baudrates)


@dataclass(frozen=True, slots=True)
class Batch:
    """A cheaper exchange that serves several commands.

    `command` returns a sequence with one value for each index in `serves`, in that order.
    """

    command: Command[Sequence[Any]]
    serves: tuple[int, ...]


@dataclass(frozen=True)
class Profile:
    """What the arbiter, the planner and the handles need to know of a protocol.

    `probe` is its cheapest read, asked of a node that may be dead. `merge` proposes cheaper exchanges for commands of
    one node; a poll group and the planner weigh them by line time. `listen` reads what arrives while nothing is
    asked. `checks` are further cheap reads that harm no node and whose answers differ: where an answer could be
    another request's, one of those is asked that cannot be (R15); a node that refuses one is asked another.
    `exchange_limit` bounds one exchange as a whole, in seconds (MSC: past it a bad packet is ACKed away); its
    exchanges are `Abandonable`. `shares_line_with` are the other protocols whose nodes may be on the same line.
    `fixed_rate`: its devices have the baud rate of `line` and no other. `other_lines`: further settings that its
    devices are met with, the likeliest first, for whoever looks for one on an unknown line.
    `checked_requests`: a node notices a flipped bit in any request. Without that a damaged read is answered with
    another item, which is taken for that item if the line goes on meanwhile: reply windows cannot be learned.
    `acks_are_commands`: a node that has just replied takes an ACK or a NAK for the host's wish for the next value or
    the same one again, also where another node says it. So the line never goes on before the reply to a write is over.
    """

    name: str
    title: str
    addresses: Sequence[int]
    """In rising order."""
    line: LineSettings
    timings: Timings
    probe: Command[Any] = field(compare=False)
    sync_reads: Sequence[Command[Any]] = field(default=(), compare=False)
    # Both compared apart: two kinds of device that speak one protocol may share a node (Node.check_shared).
    broadcast: int | None = None
    addressed: bool = True
    retries: int = 2
    noise_tolerant: bool = False
    shares_line_with: frozenset[str] = frozenset()
    fixed_rate: bool = False
    other_lines: Sequence[LineSettings] = ()
    exchange_limit: float | None = None
    checked_requests: bool = True
    acks_are_commands: bool = False
    listen: Callable[[], Listener] | None = field(default=None, compare=False)
    kind: str = field(default="", compare=False)
    """What this kind of device is called as a protocol, where that is not `name`: "microflex" speaks hcp2."""
    # Compared apart: a second handle that leaves it open asks for the same node (Node.check_shared).
    merge: Callable[[Sequence[Command[Any]]], Sequence[Batch]] | None = field(default=None, compare=False)

    @property
    def kind_name(self) -> str:
        """Return the name by which LINE.toml and the command line know this kind of device."""
        return self.kind or self.name

    def label(self, address: int) -> str:
        """Return how messages name a node: "node 5", or "the drive" where the protocol has no address."""
        return f"node {address}" if self.addressed else "the drive"

    def may_share_with(self, other: Profile) -> bool:
        """Return whether both may be on one line: it is enough that one of them knows the other."""
        return other.name == self.name or other.name in self.shares_line_with or self.name in other.shares_line_with

    def wrong_rate(self, baudrate: int) -> str:
        """Return what is wrong with a baud rate, in words; nothing unless its devices cannot have it."""
        if not self.fixed_rate or baudrate == self.line.baudrate:
            return ""
        return f"{self.title} nodes speak at {self.line.baudrate} baud alone, not at {baudrate}"

    def check_learnable(self) -> None:
        """Raise InvalidCommand where reply windows cannot be learned."""
        if not self.checked_requests:
            raise InvalidCommand(
                f"{self.name}: reply windows cannot be learned, because a read request carries no checksum: a damaged "
                "one is answered with another element; use the documented windows"
            )

    def check_address(self, address: int) -> None:
        """Raise InvalidCommand unless `address` is a node's, or the broadcast, address."""
        if isinstance(address, bool) or not isinstance(address, int):
            raise InvalidCommand(f"{self.name}: an address is a whole number, not {address!r}")
        if address in self.addresses or address == self.broadcast:
            return
        lowest, highest = self.addresses[0], self.addresses[-1]
        gaps = [str(gap) for gap in range(lowest, highest) if gap not in self.addresses]
        raise InvalidCommand(
            f"{self.name}: address {address} does not exist; use {lowest} to {highest}"
            + (f" without {', '.join(gaps)}" if gaps else "")
            + ("" if self.broadcast is None else f", or {self.broadcast} to write to all")
        )


__all__ = [
    "START_BIT",
    "Batch",
    "LineSettings",
    "Profile",
]
