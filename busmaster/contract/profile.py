"""The description of a protocol, as data."""

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
        """Return data bits, parity and stop bits in the usual form: 8N1, 7E1."""
        return f"{self.bytesize}{self.parity}{self.stopbits:g}"

    def at(self, *baudrates: int) -> tuple[LineSettings, ...]:
        """Return the same framing at other baud rates."""
        return tuple(replace(self, baudrate=baudrate) for baudrate in baudrates)


@dataclass(frozen=True, slots=True)
class Batch:
    """A cheaper exchange that serves several commands.

    `command` returns a sequence with one value for each index in `serves`, in that order. `divisible`: if a node
    refuses it, exchanges for each half of `serves` are proposed in its place.
    """

    command: Command[Sequence[Any]]
    serves: tuple[int, ...]
    divisible: bool = False


@dataclass(frozen=True)
class Profile:
    """The properties of a protocol that the arbiter, the planner and the handles need.

    `probe`: its cheapest read, sent to a node that may be dead. `merge`: proposes cheaper exchanges for commands of one
    node; poll groups and the planner choose by line time. `listen`: returns a reader for bytes between exchanges.
    `sync_reads`: further cheap reads that harm no node and whose replies differ. If a reply could belong to another
    request, one that cannot be confused is sent (R15); if a node refuses one, another is sent. `exchange_limit`: limit
    of one exchange in seconds (MSC: after that a bad packet is ACKed); its exchanges are `Abandonable`.
    `shares_line_with`: other protocols whose nodes may be on the same line. `fixed_rate`: its devices support only the
    baud rate of `line`. `other_lines`: further settings of its devices, the most likely first, for a search on an
    unknown line.

    `checked_requests`: a node detects a flipped bit in any request. Without that, a damaged read returns another item,
    and it would be delivered as the requested one if the line has continued. Then reply windows cannot be learned.

    `acks_are_commands`: a node that has just replied takes an ACK or a NAK, even one from another node, for the host's
    request for the next value or a repetition. So the line never continues before the reply to a write is over.
    """

    name: str
    title: str
    addresses: Sequence[int]
    """In ascending order."""
    line: LineSettings
    timings: Timings
    probe: Command[Any] = field(compare=False)
    sync_reads: Sequence[Command[Any]] = field(default=(), compare=False)
    # Compared separately: two kinds of device with one protocol may share a node (Node.check_shared).
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
    """Name of this kind of device as a protocol, if it is not `name`: "microflex" uses hcp2."""
    # Compared separately: a second handle that leaves it out requests the same node (Node.check_shared).
    merge: Callable[[Sequence[Command[Any]]], Sequence[Batch]] | None = field(default=None, compare=False)
    default_merge: Callable[[Sequence[Command[Any]]], Sequence[Batch]] | None = field(default=None, compare=False)
    """`merge` of a node for which no handle specifies one."""

    @property
    def kind_name(self) -> str:
        """Return the name of this kind of device in LINE.toml and on the command line."""
        return self.kind or self.name

    def with_default_merge(self) -> Profile:
        """Return the profile of a node: its `merge`, or the default."""
        return self if self.merge or not self.default_merge else replace(self, merge=self.default_merge)

    def label(self, address: int) -> str:
        """Return the name of a node in messages: "node 5", or "the drive" if the protocol has no address."""
        return f"node {address}" if self.addressed else "the drive"

    def may_share_with(self, other: Profile) -> bool:
        """Return True if both may be on one line. It is enough if one of them lists the other."""
        return other.name == self.name or other.name in self.shares_line_with or self.name in other.shares_line_with

    def wrong_rate(self, baudrate: int) -> str:
        """Return an error text if its devices do not support this baud rate, else ""."""
        if not self.fixed_rate or baudrate == self.line.baudrate:
            return ""
        return f"{self.title} nodes support only {self.line.baudrate} baud, not {baudrate}"

    def check_learnable(self) -> None:
        """Raise InvalidCommand if reply windows cannot be learned."""
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
