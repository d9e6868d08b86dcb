"""Events that the arbiter and the transport report to their owner, in order.

Within one call, successes may be reported last, after the next request has left.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TypeAlias

from busmaster.arbiter.health import Health, NodeRecord
from busmaster.arbiter.transaction import Poll, Transaction
from busmaster.contract.tap import Attempt
from busmaster.errors import BusError


@dataclass(slots=True)
class Overdue:
    """A transaction's `finish_by` has passed while it was on the wire. Its caller gets this error now.

    The exchange continues as if its caller had been cancelled (R6). There is no further event for it.
    """

    transaction: Transaction
    error: BusError


@dataclass(slots=True)
class Sampled:
    """One exchange of a poll's cycle has ended. Reported if the poll has a `group`, so that it need not wait for the
    cycle."""

    poll: Poll
    transaction: Transaction


@dataclass(slots=True)
class Polled:
    """A cycle of a poll has ended. Its transactions hold the values or errors until the next cycle starts."""

    poll: Poll


@dataclass(frozen=True, slots=True)
class NodeChanged:
    """A node's health has changed. `returning`: its hook runs first; its polls wait until `Dispatcher.release_node`."""

    node: NodeRecord
    before: Health
    after: Health
    returning: bool


@dataclass(frozen=True, slots=True)
class MaxReplyDelayRaised:
    """An overdue reply of this node was received, so its maximum reply delay was raised (R3)."""

    node: NodeRecord
    age: float
    max_reply_delay: float


@dataclass(frozen=True, slots=True)
class MaxReplyDelayLowered:
    """After an hour of prompt replies this node's maximum reply delay was restored."""

    node: NodeRecord
    max_reply_delay: float


@dataclass(frozen=True, slots=True)
class RepliesLate:
    """A reply of this node began `age` seconds after its request, after its reply `window`, and was delivered.

    Reported for the first such reply, and for one that is a quarter later than the last one reported. A longer window
    suits this node better.
    """

    node: NodeRecord
    age: float
    window: float


class LineChange(enum.Enum):
    """Change of the line: port UP or DOWN, line NOISY (nothing is sent) or QUIET again."""

    UP = "up"
    DOWN = "down"
    NOISY = "noisy"
    QUIET = "quiet"


@dataclass(frozen=True, slots=True)
class LineChanged:
    """The line has changed. `cause` is set if it is known."""

    change: LineChange
    cause: str = ""


@dataclass(frozen=True, slots=True)
class PortFailed:
    """The port could not be reopened: cause and hint. Reported once until the cause changes.

    Reopening continues. `bug`: the exception, if it was not a fault of the port. Reported by the transport.
    """

    cause: str
    hint: str = ""
    bug: BaseException | None = None


@dataclass(frozen=True, slots=True)
class CameUnexpected:
    """Unexpected bytes were received, or an echo did not match (`collision`)."""

    data: bytes
    collision: bool = False


# A caller's transaction is its own event when it has ended: its `value` or its `error` is set then.
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
