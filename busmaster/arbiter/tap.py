"""What somebody is told who taps a line: every byte, whose exchange it belongs to, and how each exchange ended."""

from __future__ import annotations

import enum
from math import inf
from typing import Any, Protocol

from busmaster.contract.exchange import Command
from busmaster.contract.timing import Timings


class Verdict(enum.Enum):
    """How one attempt ended: what the arbiter made of it, whether or not it is tried again."""

    OK = "ok"
    NO_REPLY = "no reply"
    GARBLED = "garbled"
    REFUSED = "refused"
    AMBIGUOUS = "ambiguous"
    """A good answer came and was not believed: it may have been another request's (R15)."""
    SPOILT = "spoilt"
    """What came was not read at all: the port, or when and how it came, said that it is no answer."""
    CUT_OFF = "cut off"
    """The line was lost, or closed, under it."""


class Attempt:
    """One attempt at one command, which is one exchange on the wire. Nothing of it changes once its `verdict` is set.

    `protocol` is the name of its node's protocol. `transaction` numbers the requests of a line from 1, each cycle of a
    poll anew, and `number` the attempts at one of them. `purpose` says why it is asked, where no caller asks: a poll's
    name, "probe" or "check" (R15). `quiet_time` is for how many seconds the line had resynchronised, ever, when it
    began.
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
        """The value of one that is OK, else what was wrong, in words."""
        self.late = False
        """Its reply began after `late_after`, and is accepted."""
        self.heard = True
        """Somebody still waits for it: False once its caller has gone."""
        self.ended_at = -inf

    def end(self, verdict: Verdict, result: Any, now: float) -> None:
        """Say how the attempt ended."""
        self.result = result
        self.ended_at = now
        self.verdict = verdict  # last: whoever looks from another thread finds the rest

    @property
    def request(self) -> bytes:
        """What it says first: every attempt at a command says the same."""
        return self.command.open(self.address, self.timings).request

    def __str__(self) -> str:
        """Return the command and what came of it: "read element 100: 12.5"."""
        ok = self.verdict is Verdict.OK
        result = ("ok" if self.result is None else repr(self.result)) if ok else self.result
        return f"{self.command}: {result}"


class Tap(Protocol):
    """Sees what passes on a line (a capture). Must not block, nor raise. Times are of the clock of the line's owner.

    `attempt` is what is on the wire: None while nothing is asked. What is transmitted then closes the attempt before,
    or answers what came unexpected; with a new attempt its request comes last, behind what closes the one before. What
    is received with none is nobody's answer.
    """

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Hear of bytes when they have been handed to the port."""
        ...

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Hear of bytes as they come, an echo too, before anything is made of them."""
        ...

    def attempted(self, attempt: Attempt, /) -> None:
        """Hear how an attempt has ended: perhaps after the next one was transmitted."""
        ...
