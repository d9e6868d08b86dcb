"""What the arbiter tells its owner, in the order in which it happened.

Of what happens in one call, the successes may come last: they are noted when the next request has left.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from busmaster.arbiter.health import Health, NodeRecord
    from busmaster.arbiter.schedule import Poll
    from busmaster.arbiter.transaction import Transaction


@dataclass(slots=True)
class Completed:
    """A caller's transaction has ended: its `value` or its `error` is set."""

    transaction: Transaction


@dataclass(slots=True)
class Sampled:
    """One exchange of a poll's cycle is over; told where the poll has a `waiter`, so that it need not wait for all."""

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
    returning: bool = False


@dataclass(frozen=True, slots=True)
class LatenessRaised:
    """A straggler of this node was seen, so its lateness was raised (R3)."""

    node: NodeRecord
    age: float
    lateness: float


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
class Strayed:
    """Bytes came that nobody had asked for, or an echo did not match (`collision`)."""

    data: bytes
    collision: bool = False


Event: TypeAlias = Completed | Sampled | Polled | NodeChanged | LatenessRaised | LineChanged | Strayed
