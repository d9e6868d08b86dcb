"""The contract between the protocols and the arbiter.

A `Command` is an immutable value ("read element 100"). For each attempt it opens a new `Exchange`: the bytes to send
and a reader for the reply. The arbiter owns the clock and the line; an exchange handles only its frames.

An exchange has one or more *steps*: the host sends bytes, then expects bytes. Most protocols need one step. MSC needs
two (ACK, then the packet), and more if a packet must be sent again.
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
    """Length of a reply step in bytes: `typical` for planning, `longest` for the published bounds."""

    typical: int
    longest: int


@dataclass(frozen=True, slots=True)
class LaterStep:
    """A later step of an undisturbed exchange, for planning: the bytes that the host sends, then the expected reply."""

    timing: ReplyTiming
    sizes: Sizes
    sent: int = 0


class Need(enum.Enum):
    """`MORE`: the frame is incomplete; the inter-byte timeout starts again."""

    MORE = "more"


MORE = Need.MORE


@dataclass(slots=True)
class Expect:
    """This step has ended and another follows: MSC's packet after its ACK, or a packet repeated after a NAK.

    The arbiter sends `send`, then immediately calls `feed(b"")` for bytes that arrived in the same chunk.
    """

    timing: ReplyTiming
    sizes: Sizes
    send: bytes = b""


@dataclass(slots=True)
class Done(Generic[T_co]):
    """The reply is complete.

    `rest`: bytes after the reply. They are unexpected, and the line resynchronises. `send`: the host's closing ACK
    (MSC); the line is free when it has left.
    """

    value: T_co
    rest: bytes = b""
    send: bytes = b""


Progress: TypeAlias = Need | Expect | Done[T_co]


class FrameError(Exception):
    """The received bytes are not a reply: the attempt failed. Callers never get this exception.

    `whole`: True only for a whole frame with the right echo and a bad checksum. Its reply has begun, so the line does
    not wait for overdue replies, only for silence (R3). `send`: a closing ACK that the device needs nevertheless (MSC);
    otherwise it retransmits into other exchanges. `heard`: all bytes received in place of the reply, if they may belong
    to another request: they can clear overdue replies (R15). `hint`: the remedy, if it differs from the hint for most
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
    """One attempt at one command: the bytes to send and a reader for the reply. Created for each attempt."""

    @property
    def request(self) -> bytes:
        """Return the first bytes to send."""
        ...

    @property
    def timing(self) -> ReplyTiming:
        """Return the reply times of the first step."""
        ...

    @property
    def sizes(self) -> Sizes:
        """Return the length of the first reply step."""
        ...

    @property
    def later(self) -> Sequence[LaterStep]:
        """Return the steps after the first in an undisturbed exchange. Empty for most protocols."""
        ...

    @property
    def closing(self) -> int:
        """Return the length of the host's closing ACK in bytes. 0 for most protocols."""
        ...

    @property
    def starts(self) -> bytes:
        """Return the valid first bytes of the first reply step. Other bytes are a FrameError."""
        ...

    @property
    def answers(self) -> tuple[bytes, ...]:
        """Return the keys of its good replies: the first bytes, or the byte of a one-byte reply. One for each deciding
        reply.

        Two exchanges with a common key could be confused (R15). Keys are compared as a whole: one that only begins like
        another is different. Empty for a broadcast.
        """
        ...

    @property
    def overdue(self) -> tuple[bytes, ...]:
        """Return the keys of replies that may still arrive if the attempt ends now without one (R15); see `answers`."""
        ...

    @property
    def answered(self) -> bool:
        """Return False for a broadcast: it has no reply, and `expired(False)` is called when the line is free."""
        ...

    def feed(self, data: bytes, /) -> Progress[T_co]:
        """Process the next received bytes. Raises FrameError or Refused; any other exception is a bug."""
        ...

    def expired(self, started: bool, /) -> Expect | Done[T_co]:
        """Handle an expired window (`started` False) or inter-byte timeout (True).

        Raises FrameError to fail the attempt, or returns Expect (NAK to an incomplete packet) or Done (a broadcast).
        """
        ...


class Abandonable(Protocol):
    """An exchange that can be ended instead of sending again. Required if a profile has an `exchange_limit` (R9)."""

    def abandon(self) -> FrameError | Refused:
        """Return the error that fails the attempt. The last Expect's `send` is not sent.

        A FrameError's own `send` leaves the node with nothing unacknowledged.
        """
        ...


class Command(Protocol[T_co]):
    """A request to a node: an immutable, hashable value, checked when it is created (InvalidCommand).

    Encoding cannot fail. `str(command)` is its name in messages: "read element 100".
    """

    @property
    def writes(self) -> bool:
        """Return True if it changes the node. Then it is not retried by default, and never overtakes a write."""
        ...

    @property
    def idempotent(self) -> bool:
        """Return True if it may be repeated without a decision of the caller: a read, or a level such as a
        reference."""
        ...

    def open(self, address: int, timings: Timings, /) -> Exchange[T_co]:
        """Return one attempt at it with the node at this address. Raises InvalidCommand if that is not possible."""
        ...


class Listener(Protocol):
    """A reader for bytes received between exchanges (MSC: a stale packet is ACKed and dropped)."""

    def feed(self, data: bytes, /) -> Need | Done[None]:
        """Process the next bytes. Raises FrameError if they cannot be a stale packet; its `send` is sent too."""
        ...

    def expired(self) -> Done[None]:
        """Handle an inter-byte timeout in mid-frame, or after noise that may contain a frame."""
        ...


NO_REPLY = "no reply"


def no_reply() -> FrameError:
    """Return the failure that all exchanges share: the window expired before a byte arrived."""
    return FrameError(NO_REPLY)


OTHER_FORMAT = "this is not the wiring: check the protocol, its options and the command against the node's manual"


def other_format(size: int, what: str, *, send: bytes = b"", heard: bytes = b"") -> FrameError:
    """Return the failure of a reply of `size` bytes with a correct checksum but an unknown format.

    `what` describes the difference. Noise does not cause such replies, so the hint does not mention wiring.
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
