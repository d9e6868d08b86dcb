"""What a tap of a line receives: every byte, the attempt it belongs to, and how each attempt ended."""

from __future__ import annotations

import enum
from math import inf
from typing import Any, Protocol

from busmaster.contract.exchange import Command
from busmaster.contract.timing import Timings


class Verdict(enum.Enum):
    """How one attempt ended, whether or not it is retried."""

    OK = "ok"
    NO_REPLY = "no reply"
    GARBLED = "garbled"
    REFUSED = "refused"
    AMBIGUOUS = "ambiguous"
    """A correct reply was not delivered, because it could belong to another request (R15)."""
    SPOILT = "spoilt"
    """The bytes were not parsed: the port's report or their timing shows that they are not a reply."""
    CUT_OFF = "cut off"
    """The line was lost or closed during the attempt."""


class Attempt:
    """One attempt at one command, which is one exchange on the wire. Immutable once its `verdict` is set.

    `protocol`: name of its node's protocol. `transaction`: number of the request on this line, from 1; each cycle of a
    poll has a new one. `number`: number of the attempt. `purpose`: for a request without a caller, the poll's name,
    "probe" or "check" (a sync read, R15). `quiet_time`: total seconds of resynchronisation of the line when it began.
    """

    __slots__ = (
        "address",
        "command",
        "ended_at",
        "heard",
        "late",
        "number",
        "protocol",
        "purpose",
        "quiet_time",
        "result",
        "timings",
        "transaction",
        "verdict",
    )

    def __init__(
        self,
        protocol: str,
        address: int,
        command: Command[Any],
        timings: Timings,
        *,
        transaction: int = 0,
        number: int = 1,
        purpose: str = "",
        quiet_time: float = 0.0,
    ) -> None:
        self.protocol = protocol
        self.address = address
        self.command = command
        self.timings = timings
        self.transaction = transaction
        self.number = number
        self.purpose = purpose
        self.quiet_time = quiet_time
        self.verdict: Verdict | None = None
        self.result: Any = None
        """The value if it is OK, else the cause as text."""
        self.late = False
        """Its reply began after `late_after` and was accepted."""
        self.heard = True
        """False if its caller was cancelled."""
        self.ended_at = -inf

    def end(self, verdict: Verdict, result: Any, now: float) -> None:
        """Set the result of the attempt."""
        self.result = result
        self.ended_at = now
        self.verdict = verdict  # last, so that another thread that sees the verdict sees the result too

    @property
    def request(self) -> bytes:
        """The request bytes. They are the same for every attempt at a command."""
        return self.command.open(self.address, self.timings).request

    def __str__(self) -> str:
        """Return the command and what came of it: "read element 100: 12.5"."""
        ok = self.verdict is Verdict.OK
        result = ("ok" if self.result is None else repr(self.result)) if ok else self.result
        return f"{self.command}: {result}"


class Tap(Protocol):
    """Receives the traffic of a line (for example for a capture). Must not block or raise. Times are on the owner's
    clock.

    `attempt` is the attempt on the wire, or None between requests. Bytes transmitted without one close the previous
    attempt or acknowledge unexpected bytes. With a new attempt, its request comes last, behind the bytes that close the
    previous one. Bytes received without one are unexpected.
    """

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Process bytes that have been handed to the port."""
        ...

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Process received bytes, echo included, before the arbiter does."""
        ...

    def attempted(self, attempt: Attempt, /) -> None:
        """Process an attempt that has ended, possibly after the next one was transmitted."""
        ...
