"""What the arbiter and the transport tell their owner, in the order in which it happened.

Of what happens in one call, the successes may come last: they are noted when the next request has left.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TypeAlias

from busmaster.arbiter.health import Health, NodeRecord
from busmaster.arbiter.tap import Attempt
from busmaster.arbiter.transaction import Poll, Transaction
from busmaster.errors import BusError


@dataclass(slots=True)
class Overdue:
    """A transaction's `finish_by` has passed while it was on the wire: its caller gets this error now.

    The exchange runs out as if its caller had been cancelled (R6), and it is not told again.
    """

    transaction: Transaction
    error: BusError


@dataclass(slots=True)
class Sampled:
    """One exchange of a poll's cycle is over; told where the poll has a `group`, so that it need not wait for all."""

    poll: Poll
    transaction: Transaction


@dataclass(slots=True)
class Polled:
    """A cycle of a poll is over: its transactions hold the values or errors until the next cycle starts."""

    poll: Poll


@dataclass(frozen=True, slots=True)
class NodeChanged:
    """A node's health changed. `returning`: its polls wait until `Dispatcher.release_node` (its hook runs first)."""

    node: NodeRecord
    before: Health
    after: Health
    returning: bool


@dataclass(frozen=True, slots=True)
class MaxReplyDelayRaised:
    """An overdue reply of this node was seen, so its maximum reply delay was raised (R3)."""

    node: NodeRecord
    age: float
    max_reply_delay: float


@dataclass(frozen=True, slots=True)
class MaxReplyDelayLowered:
    """An hour of prompt replies: this node's maximum reply delay is what it was before it was raised."""

    node: NodeRecord
    max_reply_delay: float


@dataclass(frozen=True, slots=True)
class RepliesLate:
    """A reply of this node began `age` seconds after its request, later than its reply `window`, and was delivered.

    Told for the first such reply, and for one that is a quarter later than any told before. A longer window fits.
    """

    node: NodeRecord
    age: float
    window: float


class LineChange(enum.Enum):
    """What became of the line: its port UP or DOWN, the line NOISY (nothing is sent) or QUIET again."""

    UP = "up"
    DOWN = "down"
    NOISY = "noisy"
    QUIET = "quiet"


@dataclass(frozen=True, slots=True)
class LineChanged:
    """The line changed, and why where that is known."""

    change: LineChange
    cause: str = ""


@dataclass(frozen=True, slots=True)
class PortFailed:
    """The port is down and could not be opened again: why, and what to try. Told once until the cause changes.

    It is tried again all the same. `bug` is the exception where it was no fault of the port. The transport tells it.
    """

    cause: str
    hint: str = ""
    bug: BaseException | None = None


@dataclass(frozen=True, slots=True)
class CameUnexpected:
    """Bytes came that nobody had asked for, or an echo did not match (`collision`)."""

    data: bytes
    collision: bool = False


# A caller's transaction is told itself when it has ended: its `value` or its `error` is set then.
Event: TypeAlias = (
    Transaction
    | Overdue
    | Sampled
    | Polled
    | NodeChanged
    | MaxReplyDelayRaised
    | MaxReplyDelayLowered
    | RepliesLate
    | LineChanged
    | PortFailed
    | CameUnexpected
    | Attempt
)
