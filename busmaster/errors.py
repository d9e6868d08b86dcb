"""The exceptions of busmaster.

Each failed request raises a new instance of a `BusError` subclass. It contains the line, the node, the command and the
number of attempts. Its text states in one sentence the event, the place and the remedy. It can be pickled, and so be
sent to another process.

A wrong argument is not a bus error: it raises `InvalidCommand` when the command is created or the request is made.
"""

from __future__ import annotations

from typing import Any, Protocol


class Addressed(Protocol):
    """The node that an error refers to."""

    @property
    def line(self) -> str:
        """Return the name of its line, "" if unknown."""
        ...

    @property
    def label(self) -> str:
        """Return its name in messages, "" for no node."""
        ...

    @property
    def address(self) -> int:
        """Return its address, None for no node."""
        ...


class InvalidCommand(ValueError):
    """An argument is out of range or not allowed by the protocol, or a bus is used in the wrong way. Nothing was sent.

    Wrong uses of a bus are to open it twice, and to use it from another thread or event loop.
    """


class BusError(Exception):
    """A request ended without a value.

    `what`: the event ("no reply within 100 ms"). `hint`: the remedy. `command`: the command as text. `attempts`: number
    of attempts on the wire. `line`: name of the line's port. `label`, `address`: those of the node ("node 5", 5). Each
    is None if it is unknown, or if the error does not refer to one node.
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
        """Set the node and the line of the error."""
        self.line = node.line or None
        self.label = node.label
        self.address = node.address

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep all attributes. A cause that is not a BusError may not be picklable, so only its text is kept."""
        state, cause = dict(self.__dict__), self.__cause__
        if cause is not None:
            is_bus_error = isinstance(cause, BusError)
            state["__cause__"] = cause if is_bus_error else Exception(f"{type(cause).__name__}: {cause}")
        return type(self), (self.what,), state

    def __str__(self) -> str:
        text = self.what if self.label is None else f"{self.label}: {self.what}"
        if self.attempts:
            text += f", {self.attempts} attempt{'' if self.attempts == 1 else 's'}"
        if self.command:
            text += f" ({self.command})"
        return f"{text}; {self.hint}" if self.hint else text


class NoReply(BusError, TimeoutError):
    """No reply arrived within the reply window at any attempt, or before the caller's `finish_within`."""

    hint = "check the node's address, power, baud rate and wiring"


class GarbledReply(BusError):
    """Bytes were received, but no valid reply to this command: bad checksum, incomplete frame, or wrong echo."""

    hint = "check wiring, termination and baud rate, and that no two nodes share an address"


class Refused(BusError):
    """The node understood the request and refused it (NAK; EOT in Mentor II).

    A protocol's exchange raises it with `what` only, and with `confirm=False` if a repetition would give no new
    information. Examples: MSC has already sent the request four times; a multi-value write may have stored a part. The
    arbiter adds the other fields, and repeats the request once if `confirm` is True. `temporary`: the node may accept
    the same request later (a Modbus unit that is busy). Merged reads are then not divided.
    """

    hint = "check that it exists, is writable and within the node's limits"

    def __init__(
        self,
        what: str = "refused",
        *,
        confirm: bool = True,
        temporary: bool = False,
        node: Addressed | None = None,
        command: str | None = None,
        attempts: int = 0,
        hint: str | None = None,
    ) -> None:
        super().__init__(what, node=node, command=command, attempts=attempts, hint=hint)
        self.confirm = confirm
        self.temporary = temporary


class NoSuchParameter(Refused):
    """The node has no such parameter (Mentor II answers EOT)."""

    hint = "check the parameter number against the drive's parameter list"


class WriteUnconfirmed(BusError):
    """A write was sent, and its reply was missing, garbled, or not received before `finish_within`. All or a part of it
    may have been carried out."""

    hint = "read the value back before you write again"


class VerifyFailed(BusError):
    """A write was acknowledged, but the value read back differs."""

    hint = "check limits, rounding, interlocks, and whether a program in the node writes it too"


class Superseded(BusError):
    """A queued write was discarded because an urgent write to the same node overtook it."""

    hint = "decide again after the urgent write"


class NodeDown(BusError):
    """The node is DOWN, and the request was not sent."""

    hint = "it is probed automatically, and node.probe() sends a probe now; node.suspend(0) ends a suspension"


class NotStarted(BusError, TimeoutError):
    """The request was not sent before its `start_within` or `finish_within`. Nothing was sent."""

    hint = "the line is busy: see bus.statistics() or busmaster plan"


class HoldEnded(NotStarted):
    """The exclusive sequence that this request belongs to has ended. Nothing was sent."""

    hint = "do less between two requests of a sequence, or increase max_hold"


class BacklogFull(BusError):
    """Too many requests are queued. This one was not queued."""

    hint = "the line cannot keep up: send fewer requests, or see busmaster plan"


class LineNoisy(BusError):
    """The line has not been silent for a second, so nothing can be sent safely."""

    hint = "look for a babbling node, a second master, a wrong baud rate or missing biasing"


class LineDown(BusError, ConnectionError):
    """The port is lost or not open yet. It is reopened automatically."""

    hint = "check the port or adapter; an open bus reopens a lost port automatically"


class BusClosed(BusError):
    """The bus was closed."""

    hint = "use the bus inside `async with`"


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
