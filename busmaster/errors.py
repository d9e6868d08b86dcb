"""What can go wrong, and nothing else.

Every request that fails raises one fresh instance of a `BusError` subclass. It carries the line, the node, the
command and the number of attempts, and its text says in one sentence what happened, where, and what to try. It may be
sent to another process: it pickles.
A wrong argument is not a bus error: it raises `InvalidCommand` when the command is built, or when it is asked for.
"""

from __future__ import annotations

from typing import Any, Protocol


class Addressed(Protocol):
    """What an error is told of the node that it is about."""

    @property
    def line(self) -> str:
        """Return the name of the line on which it happened, "" where that is not known."""
        ...

    @property
    def label(self) -> str:
        """Return what messages call the node, "" where it is about none."""
        ...

    @property
    def address(self) -> int:
        """Return the node's address, None where it is about none."""
        ...


class InvalidCommand(ValueError):
    """An argument is out of range or cannot be written as the protocol demands, or a bus is used as none can be: opened
    twice, or from another thread or event loop than its own. Nothing was sent."""


class BusError(Exception):
    """A request did not end with a value.

    `what` is the happening ("no reply within 100 ms"), `hint` what to try, `command` the command as text, `attempts`
    how often it was on the wire. `line` is the name of the line's port, `label` and `address` are the node's ("node
    5", 5); each is None where it is not known, or where the error is not about one node.
    """

    hint = ""

    def __init__(
        self,
        what: str,
        *,
        node: Addressed | None = None,
        command: str | None = None,
        attempts: int = 0,
        hint: str | None = None,
    ) -> None:
        super().__init__(what)
        self.what = what
        self.line: str | None = None
        self.label: str | None = None
        self.address: int | None = None
        self.command = command
        self.attempts = attempts
        if node is not None:
            self.name(node)
        if hint is not None:
            self.hint = hint

    def name(self, node: Addressed) -> None:
        """Say which node, of which line, it is about."""
        self.line = node.line or None
        self.label = node.label
        self.address = node.address

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep all attributes; of a cause that is no error of the line's, which may not pickle, its text."""
        state, cause = dict(self.__dict__), self.__cause__
        if cause is not None:
            told = isinstance(cause, BusError)
            state["__cause__"] = cause if told else Exception(f"{type(cause).__name__}: {cause}")
        return type(self), (self.what,), state

    def __str__(self) -> str:
        text = self.what if self.label is None else f"{self.label}: {self.what}"
        if self.attempts:
            text += f", {self.attempts} attempt{'' if self.attempts == 1 else 's'}"
        if self.command:
            text += f" ({self.command})"
        return f"{text}; {self.hint}" if self.hint else text


class NoReply(BusError, TimeoutError):
    """Nothing came within the reply window, at any attempt; or not before the caller's `finish_within` ran out."""

    hint = "check the node's address, power, baud rate and wiring"


class GarbledReply(BusError):
    """Bytes came, but no valid reply to this command: a bad checksum, a cut frame, a wrong echo."""

    hint = "check wiring, termination and baud rate, and that no two nodes share an address"


class Refused(BusError):
    """The node understood and said no (NAK; EOT in Mentor II).

    A protocol's exchange raises it with `what` alone, and with `confirm=False` where asking again would say
    nothing new (MSC has already sent it four times; a multi-value write may have stored a prefix). The arbiter
    fills in the rest, and asks once more where `confirm` is True.
    """

    hint = "check that it exists, is writable and within the node's limits"

    def __init__(
        self,
        what: str = "refused",
        *,
        confirm: bool = True,
        node: Addressed | None = None,
        command: str | None = None,
        attempts: int = 0,
        hint: str | None = None,
    ) -> None:
        super().__init__(what, node=node, command=command, attempts=attempts, hint=hint)
        self.confirm = confirm


class NoSuchParameter(Refused):
    """The node has no such parameter (Mentor II answers EOT)."""

    hint = "check the parameter number against the drive's parameter list"


class WriteUnconfirmed(BusError):
    """A write was sent, and its answer never came, or was garbled, or had not come when `finish_within` ran out: all or
    a part of it may have been carried out."""

    hint = "read the value back before you write again"


class VerifyFailed(BusError):
    """A write was acknowledged, but what was read back is something else."""

    hint = "look for limits, rounding, an interlock, or a program in the node that writes it too"


class Superseded(BusError):
    """A queued write was dropped because an urgent write to the same node overtook it."""

    hint = "decide again after what overtook it"


class NodeDown(BusError):
    """The node is known to be dead and this request was not worth line time."""

    hint = "it is probed by itself; node.probe() asks at once"


class NotStarted(BusError, TimeoutError):
    """The request had not been sent when its `start_within` or `finish_within` ran out. Nothing was sent."""

    hint = "the line is busy: see bus.statistics() or busmaster plan"


class HoldEnded(NotStarted):
    """The line was no longer held for the exclusive sequence that this request is of. Nothing was sent."""

    hint = "do less between two requests of a sequence, or hold the line for longer (max_hold)"


class BacklogFull(BusError):
    """Too many requests are waiting. Nothing was queued."""

    hint = "the line cannot keep up: ask less often, or see busmaster plan"


class LineNoisy(BusError):
    """The line has not been silent for a second, so nothing can be sent safely."""

    hint = "look for a babbling node, a second master, a wrong baud rate or missing biasing"


class LineDown(BusError, ConnectionError):
    """The port is gone or not yet open. It is opened again by itself."""

    hint = "check the port or adapter; while a bus is open it opens a lost port again by itself"


class BusClosed(BusError):
    """The bus was closed."""

    hint = "use the bus inside `async with`"


def cause_text(cause: Exception | None, otherwise: str) -> str:
    """Return in words why a connection was lost: `otherwise` where there was no error, never an empty text."""
    if cause is None:
        return otherwise
    if isinstance(cause, BusError):
        return cause.what
    return getattr(cause, "strerror", None) or str(cause) or type(cause).__name__


__all__ = [
    "Addressed",
    "BacklogFull",
    "BusClosed",
    "BusError",
    "GarbledReply",
    "HoldEnded",
    "InvalidCommand",
    "LineDown",
    "LineNoisy",
    "NoReply",
    "NoSuchParameter",
    "NodeDown",
    "NotStarted",
    "Refused",
    "Superseded",
    "VerifyFailed",
    "WriteUnconfirmed",
]
