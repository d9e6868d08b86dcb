"""What a frame on the line says: the one form in which recording, monitoring and replaying speak of it."""

from __future__ import annotations

import enum
from dataclasses import dataclass

UNEXPECTED = "unexpected"
"""The fault of a frame from a node that nobody had asked."""
UNACKED = "before the ACK"
"""The fault of an MSC packet whose request was not yet acknowledged: it may answer an older one."""


class Direction(enum.IntEnum):
    """Who spoke."""

    UNKNOWN = 0
    NODE = 1
    HOST = 2


class Kind(enum.StrEnum):
    """What sort of frame it is."""

    READ = "read"
    WRITE = "write"
    VALUE = "value"
    ACK = "ack"
    NAK = "nak"
    EOT = "eot"
    NOISE = "noise"
    """No frame at all, or one that was cut short: `fault` says which."""


@dataclass(slots=True)
class Frame:
    """One frame as it was heard.

    `item` names the quantity as the command line does ("100", "01.17", "2008:32", "flag:5"); `value` is the data as
    text, several joined by commas; `fault` says what is wrong with the frame and is empty if nothing is. `node` of a
    reply is that of the request it answers, since no reply but MSC's carries one.
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
    """It ends what the last request asked for, or one step of it."""
    continues: bool = False
    """It is what the host says in the midst of an exchange, and begins none."""
    joined: bool = False
    """It came in one piece with the end of the frame before."""
    time: float = 0.0
    """Seconds, when its first byte was heard, on the clock of whoever heard it."""
    ended: float = 0.0
    """Seconds, when its last byte was heard, likewise."""
    earlier: float = 0.0
    """Seconds by which its first byte may have come before `time`, as the listener stood still."""
    delay: float | None = None
    """Of an answer: seconds since the last byte of what it answers was heard."""

    @property
    def text(self) -> str:
        """Return what it says, without the node: "read 100", "100 = 12.5", "NAK"."""
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


__all__ = [
    "UNACKED",
    "UNEXPECTED",
    "Direction",
    "Frame",
    "Kind",
]
