"""The contract between the protocols and the arbiter.

A `Command` is an immutable value ("read element 100"). For each attempt it opens a fresh `Exchange`: the bytes to
send and a reader for what comes back. The arbiter owns the clock and the line; an exchange owns only its frame.

One exchange has one or more *steps*: something is said by the host, something is awaited. Most protocols need one.
MSC needs two (ACK, then the packet) and more when a packet must be sent again.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeAlias, TypeVar

from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import Refused

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


@dataclass(frozen=True, slots=True)
class Sizes:
    """Bytes of one reply step: `typical` for planning, `longest` for the published bounds."""

    typical: int
    longest: int


@dataclass(frozen=True, slots=True)
class LaterStep:
    """One later step of an undisturbed exchange, for planning: what the host says first, then what is awaited."""

    timing: ReplyTiming
    sizes: Sizes
    sent: int = 0


class Need(enum.Enum):
    """`MORE`: not a whole frame yet; the inter-byte timeout is re-armed."""

    MORE = "more"


MORE = Need.MORE


@dataclass(slots=True)
class Expect:
    """This step is over and another follows: MSC's packet after its ACK, a NAKed packet sent again.

    The arbiter sends `send`, then calls `feed(b"")` at once, for bytes that came in the same chunk.
    """

    timing: ReplyTiming
    sizes: Sizes
    send: bytes = b""


@dataclass(slots=True)
class Done(Generic[T_co]):
    """The reply is complete.

    `rest` is what came after the reply: nobody asked for those bytes and the line resynchronises. `send` is the host's
    closing ACK (MSC): the line is free when it has left.
    """

    value: T_co
    rest: bytes = b""
    send: bytes = b""


Progress: TypeAlias = Need | Expect | Done[T_co]


class FrameError(Exception):
    """This is no reply: the attempt failed. Never reaches a caller.

    `whole` is True only for a whole frame with the right echo and a bad checksum: its reply has begun, so the line
    need not wait for overdue replies, only for silence (R3). `send` is a closing ACK overdue to the device all the same
    (MSC), else it retransmits into other exchanges. `heard` is all that came in place of the reply, where it may be
    another request's: it pays what is overdue (R15). `hint` is what to try, where that is not what helps against most
    garbled replies.
    """

    def __init__(
        self, what: str, *, whole: bool = False, send: bytes = b"", heard: bytes = b"", hint: str | None = None
    ) -> None:
        super().__init__(what)
        self.what = what
        self.whole = whole
        self.send = send
        self.heard = heard
        self.hint = hint


class Exchange(Protocol[T_co]):
    """One attempt at one command: the bytes to send and a reader for what comes back. Fresh per attempt."""

    @property
    def request(self) -> bytes:
        """Return the bytes with which it begins."""
        ...

    @property
    def timing(self) -> ReplyTiming:
        """Return the reply times of the first step."""
        ...

    @property
    def sizes(self) -> Sizes:
        """Return the bytes of the first reply step."""
        ...

    @property
    def later(self) -> Sequence[LaterStep]:
        """Return the steps after the first, when nothing goes wrong. Empty for most protocols."""
        ...

    @property
    def closing(self) -> int:
        """Return how many bytes the host's closing ACK has. 0 for most protocols."""
        ...

    @property
    def starts(self) -> bytes:
        """Return the legal first bytes of the first reply step; anything else is a FrameError."""
        ...

    @property
    def answers(self) -> tuple[bytes, ...]:
        """Return what its good replies begin with, or are where they are one byte: one for each reply that decides.

        Two exchanges that share one could be taken for each other (R15); they are compared whole, so one that only
        begins like another is another. Empty for a broadcast.
        """
        ...

    @property
    def overdue(self) -> tuple[bytes, ...]:
        """Return what its node may still say if the attempt ends now, unheard: of the same kind as `answers` (R15)."""
        ...

    @property
    def answered(self) -> bool:
        """Return False for a broadcast: no reply will come, and `expired(False)` is called when the line is free."""
        ...

    def feed(self, data: bytes, /) -> Progress[T_co]:
        """Take the next bytes of the line. Raises FrameError or Refused; anything else is a bug."""
        ...

    def expired(self, started: bool, /) -> Expect | Done[T_co]:
        """Say what becomes of a window (`started` False) or an inter-byte timeout (True) that ran out.

        Raises FrameError to fail the attempt, or returns Expect (NAK a cut packet) or Done (a broadcast).
        """
        ...


class Abandonable(Protocol):
    """An exchange that can be ended where it would say something again: needed where a profile has an
    `exchange_limit` (R9)."""

    def abandon(self) -> FrameError | Refused:
        """Return what to fail the attempt with in place of the last Expect's `send`, which is then not sent.

        A FrameError's own `send` leaves the node with nothing unacknowledged.
        """
        ...


class Command(Protocol[T_co]):
    """What to ask of a node: an immutable, hashable value, checked when it is built (InvalidCommand).

    Encoding cannot fail. `str(command)` is how messages name it: "read element 100".
    """

    @property
    def writes(self) -> bool:
        """Return True if it changes the node: then it is never retried unexpected, and never overtakes a write."""
        ...

    @property
    def idempotent(self) -> bool:
        """Return True if it may be repeated without asking the caller: a read, or a level such as a reference."""
        ...

    def open(self, address: int, timings: Timings, /) -> Exchange[T_co]:
        """Return one attempt at it, with the node at this address. Raises InvalidCommand where that cannot be."""
        ...


class Listener(Protocol):
    """A reader for what arrives while nothing is asked (MSC: a stale packet is ACKed and dropped)."""

    def feed(self, data: bytes, /) -> Need | Done[None]:
        """Take the next bytes. Raises FrameError for what cannot be a stale packet; its `send` is honoured too."""
        ...

    def expired(self) -> Done[None]:
        """Say what becomes of an inter-byte timeout that ran out in mid-frame, or behind noise in which a frame may
        have been."""
        ...


NO_REPLY = "no reply"


def no_reply() -> FrameError:
    """Return the one failure that every exchange shares: the window ran out before a byte came."""
    return FrameError(NO_REPLY)


OTHER_FORMAT = "this is not the wiring: check the protocol, its options and the command against the node's manual"


def other_format(size: int, what: str, *, send: bytes = b"", heard: bytes = b"") -> FrameError:
    """Return the failure of a reply of `size` bytes whose check is right and whose form is not the protocol's.

    `what` says what differs. No noise makes such a reply, so its hint says that wiring is not what is wrong.
    """
    what = f"{size} bytes came, right in their check but of another format: {what}"
    return FrameError(what, send=send, heard=heard, hint=OTHER_FORMAT)


__all__ = [
    "MORE",
    "NO_REPLY",
    "OTHER_FORMAT",
    "Abandonable",
    "Command",
    "Done",
    "Exchange",
    "Expect",
    "FrameError",
    "LaterStep",
    "Listener",
    "Need",
    "Progress",
    "Refused",
    "Sizes",
    "no_reply",
    "other_format",
]
