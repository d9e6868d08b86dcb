"""Frames as a listener receives them, in the form that recording, monitoring and replaying share."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from busmaster.contract.exchange import Command

UNEXPECTED = "unexpected"
"""Fault of a frame from a node without a request."""
UNACKED = "before the ACK"
"""Fault of an MSC packet before the ACK of its request: it may be the reply to an older one."""


class Direction(enum.IntEnum):
    """Sender of a frame."""

    UNKNOWN = 0
    NODE = 1
    HOST = 2


class Kind(enum.StrEnum):
    """Kind of a frame."""

    READ = "read"
    WRITE = "write"
    VALUE = "value"
    ACK = "ack"
    NAK = "nak"
    EOT = "eot"
    NOISE = "noise"
    """Not a frame, or an incomplete one: see `fault`."""


@dataclass(slots=True)
class Frame:
    """One received frame.

    `item`: the quantity as on the command line ("100", "01.17", "2008:32", "flag:5"). `value`: the data as text,
    several values joined by commas. `fault`: description of its fault, or empty. `node`: for a reply that of its
    request, because only MSC's replies contain it.
    """

    kind: Kind
    sender: Direction
    raw: bytes
    node: int | None = None
    command: str = ""
    item: str = ""
    value: str = ""
    fault: str = ""
    answers: bool = False
    """It ends the last request, or one step of it."""
    continues: bool = False
    """The host sent it within an exchange; it does not begin one."""
    joined: bool = False
    """It arrived in one piece with the end of the previous frame."""
    time: float = 0.0
    """When its first byte was received, in seconds on the receiver's clock."""
    ended: float = 0.0
    """When its last byte was received, in seconds on the receiver's clock."""
    earlier: float = 0.0
    """Seconds by which its first byte may have arrived before `time`, because the receiver was stopped."""
    delay: float | None = None
    """For a reply: seconds since the last byte of its request."""

    @property
    def text(self) -> str:
        """Return its contents without the node: "read 100", "100 = 12.5", "NAK"."""
        match self.kind:
            case Kind.READ:
                return f"{self.command} {self.item}".rstrip()
            case Kind.WRITE:
                return f"{self.command} {self.item} = {self.value}"
            case Kind.VALUE:
                return f"{self.item} = {self.value}"
            case Kind.NOISE:
                return f"{len(self.raw)} byte{'' if len(self.raw) == 1 else 's'}"
            case _:
                return self.kind.upper()


class Dialect(Protocol):
    """Separates and reads the frames of one protocol, and infers their senders. It remembers the last request."""

    starts: bytes
    """Bytes that can begin a frame."""

    def size(self, data: bytes, sender: Direction, /, *, quiet: bool = False) -> int:
        """Return the length of the frame at the beginning of `data`, which is never empty.

        0: the frame is incomplete. Negative: this many bytes are not a frame. With `quiet` no more bytes follow, and
        the length is never 0.
        """
        ...

    def explain(self, raw: bytes, sender: Direction, /) -> Frame:
        """Return the contents of a whole frame.

        An UNKNOWN `sender` is inferred from the frame and the requests before it.
        """
        ...

    def command(self, request: Frame, continued: Sequence[Frame], /) -> Command[Any]:
        """Return the command of a request, with what the host sent later in the same exchange.

        Raises InvalidCommand, ValueError or KeyError for a request that no command would send.
        """
        ...


__all__ = [
    "UNACKED",
    "UNEXPECTED",
    "Dialect",
    "Direction",
    "Frame",
    "Kind",
]
